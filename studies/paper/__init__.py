"""The paper's experiment, repeated: scenarios A and B, all schemes, and the figures of the page."""
