"""Tuning of filter noise."""
