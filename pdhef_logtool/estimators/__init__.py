"""Estimators: from aligned signals to a state track, window by window with carried state."""
