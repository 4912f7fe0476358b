"""Residual models: features, networks, the ladder of linear models, and the folders in which they are stored.

:mod:`~.interface` is their interface to a filter, :mod:`~.features` their inputs, the same for training and
service. It must not import estimators; only :mod:`~.network`, for training, imports PyTorch.
"""
