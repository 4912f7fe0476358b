"""Numba code: the cache of machine code, and kernels in LLVM vectors."""
