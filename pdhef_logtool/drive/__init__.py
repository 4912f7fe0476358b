"""From a log to aligned signals and truth."""
