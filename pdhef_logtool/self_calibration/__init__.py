"""A car that calibrates itself on a log without truth (METHOD §17)."""
