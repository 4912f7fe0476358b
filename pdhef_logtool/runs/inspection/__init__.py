"""Contents of a log, its mapping to signals, and plausibility checks."""
