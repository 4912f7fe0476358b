"""Everything that drives with truth can teach of a car, step by step."""
