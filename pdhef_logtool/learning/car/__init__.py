"""Identification of a vehicle."""
