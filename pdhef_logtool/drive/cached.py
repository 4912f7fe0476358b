"""Logs that are read more than once: their reduced logs, where a cache of these is named, else the logs themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Drive, read_drive
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping

Warn = Callable[[str], None]


def _silent(_text: str) -> None:
    pass


@contextmanager
def cached(
    log: LogInput, mapping: Mapping | None, options: ReadOptions, warn: Warn = _silent
) -> Iterator[tuple[LogInput, Mapping | None]]:
    """Yield what to read in place of a log, and with which mapping; a reduced log has its own."""
    if options.cache is None:
        yield log, mapping
        return
    from pdhef_logtool.drive.slim_cache import SlimCache

    with SlimCache(options.cache, mapping, options).standing_in(log, warn) as substitute:
        yield substitute, mapping if substitute.path == log.path else None


@contextmanager
def read_cached(
    log: LogInput, car: Car, mapping: Mapping | None, options: ReadOptions, warn: Warn = _silent
) -> Iterator[Drive]:
    """Open a log as :func:`~pdhef_logtool.drive.reading.read_drive` does, or what represents it."""
    with (
        cached(log, mapping, options, warn) as (substitute, mapping_of_it),
        read_drive(substitute, car, mapping_of_it, options, tell=warn) as drive,
    ):
        yield drive
