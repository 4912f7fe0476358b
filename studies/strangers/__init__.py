"""Third-party logs and synthetic ones with known signals: how many signals the tool recognises."""
