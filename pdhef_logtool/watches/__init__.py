"""Monitors of signals and estimates beside the estimators: faults, wheel slip, divergence, confidence intervals."""
