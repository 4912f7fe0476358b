"""Dates of stamps. Times that count from the start of a log or a simulation have none."""

from __future__ import annotations

#: The first date, 1973: earlier stamps, in ns since 1970, count from another start.
FIRST_DATE_NS = 10**17


def is_dated(stamp_ns: float) -> bool:
    """Return whether a stamp in ns is a date."""
    return stamp_ns >= FIRST_DATE_NS
