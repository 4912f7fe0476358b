"""A car that calibrates itself on a log without truth (docs/method.md#self-calibration)."""
