"""Cache of machine code that numba compiles."""
