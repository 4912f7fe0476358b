"""Trained residual models: features, networks, and model bundles."""
