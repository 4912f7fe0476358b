"""Simulator of a car: vehicle, driver, sensors, and logs as a recorder would leave them.

It shares no code with the estimators and their nominal model: a shared model would hide its own error.
"""
