"""Logs through estimators to outputs."""
