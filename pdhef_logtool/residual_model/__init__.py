"""The learned residual: features, network, and the bundle that keeps them together."""
