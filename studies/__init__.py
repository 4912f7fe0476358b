"""What writes the pages of results in docs/."""
