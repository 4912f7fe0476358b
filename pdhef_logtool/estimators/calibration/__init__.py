"""A car that calibrates itself on a log without ground truth (docs/method.md#self-calibration)."""
