"""Reading and writing drive logs as columns."""
