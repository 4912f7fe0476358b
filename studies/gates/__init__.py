"""Frozen figures of the tool: ``python -m studies.gates`` recomputes them and prints the rows that moved."""
