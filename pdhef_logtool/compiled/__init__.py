"""Numba code: where machine code is kept."""
