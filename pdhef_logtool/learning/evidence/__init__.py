"""Trust in a network, and calibrated intervals."""
