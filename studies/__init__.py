"""Studies that write the results pages in docs/."""
