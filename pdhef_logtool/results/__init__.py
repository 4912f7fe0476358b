"""Finished runs, read back: their figures, tracks and reports, compared and searched."""
