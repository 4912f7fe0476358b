"""Learning from drives with truth: vehicle identification."""
