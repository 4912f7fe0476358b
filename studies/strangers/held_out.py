"""Layouts that are built last and run once."""

from __future__ import annotations

from collections.abc import Iterator

from studies.strangers.recordings import Recording


def held_out_layouts() -> Iterator[Recording]:
    """Yield all of them."""
    yield from ()
