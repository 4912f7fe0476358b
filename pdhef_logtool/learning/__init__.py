"""What drives with truth can teach."""
