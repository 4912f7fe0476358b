"""Offline sideslip estimation, scoring and annotation of drive logs."""

__version__ = "0.1.0"
