"""The model of one drive: how its log is read, its sensors and its car, and the uncertainty of its estimates.

:mod:`~.fit` calibrates the car on the drive's own sensors, :mod:`~.drive_model` corrects the signals once for all
estimators, :mod:`~.intervals` widens their intervals. It must not import the outputs of runs.
"""
