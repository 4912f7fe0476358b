"""The paper's experiment, repeated: scenarios A and B, all schemes, and the data of Figures 9 to 23."""
