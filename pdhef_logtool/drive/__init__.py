"""From a log to aligned signals and ground truth."""
