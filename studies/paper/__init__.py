"""The paper's experiment, run again: scenarios A and B, all schemes, and what Figures 9 to 23 show."""
