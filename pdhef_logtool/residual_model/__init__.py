"""Residual models: features, networks, the ladder of linear models, and the folders in which they are stored.

:mod:`~.interface` defines what a filter needs of them, :mod:`~.features` their inputs, the same for training and
service. It must not import estimators; only :mod:`~.network`, for training, imports PyTorch.
"""
