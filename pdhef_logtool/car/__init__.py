"""Parameters and identified parts of one vehicle."""
