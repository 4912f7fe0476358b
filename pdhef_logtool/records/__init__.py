"""Records that every layer shares: signals, tracks, errors, geometry, reasons."""
