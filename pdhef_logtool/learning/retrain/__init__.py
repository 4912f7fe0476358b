"""The network of a car trained again on the drives of a fleet, and a gate that states whether it may take its place."""
