"""MCAP files that the mcap library writes."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.writer import Writer


@contextmanager
def mcap_writer(path: Path, *, profile: str = "", library: str = "test", **options: Any) -> Iterator[Writer]:
    """Return a started writer, and finish the file at the end."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=profile, library=library)
        yield writer
        writer.finish()
