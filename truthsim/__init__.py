"""Simulator of a car: vehicle, driver, sensors, and logs in the format of a recorder.

It shares no code with the estimators and their nominal model, so that common errors cannot remain hidden.
"""
