"""Logs of strangers, of our own making and with known answers, and how many of their signals the tool gets right."""
