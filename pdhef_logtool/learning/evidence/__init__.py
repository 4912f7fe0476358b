"""Residual gain of a network, and calibrated intervals."""
