"""Torture: damaged, hostile and odd input, kills, full disks; counts go to ``docs/reliability.md``."""
