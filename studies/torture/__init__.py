"""Fuzz and fault-injection tests: damaged, hostile and unusual input, kills, full disks (docs/reliability.md)."""
