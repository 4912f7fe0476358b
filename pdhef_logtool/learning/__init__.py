"""Identification, tuning, training and calibration of cars."""
