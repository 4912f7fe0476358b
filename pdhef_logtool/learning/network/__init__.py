"""Residual datasets and training."""
