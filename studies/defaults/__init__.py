"""What made the frozen constants and the shipped car."""
