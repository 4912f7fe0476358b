"""Argument and result of a reader of tables.

A reader of a table format (CSV, Parquet, MAT, MDF, BLF, ...) is a function ``TableFile -> Tables``. It runs in a
separate process (:mod:`~pdhef_logtool.logs.reader_process`), which has an open file and limits, and no path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, BinaryIO

from pdhef_logtool.logs.resource_limits import ResourceLimits
from pdhef_logtool.records.signals import Loss

if TYPE_CHECKING:
    from pdhef_logtool.logs.table_log import Table


@dataclass(frozen=True, slots=True, eq=False)
class TableFile:
    """An open file.

    Attributes
    ----------
    stream : read-only, seekable, at its start. size : bytes of the file.
    name : as the user named the file, for messages.
    limits : resource limits of reading.
    """

    stream: BinaryIO
    size: int
    name: str
    limits: ResourceLimits


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """Contents of a file: its kind for reports (``csv``, ``mdf-4``, ...), its tables, and its losses."""

    kind: str
    tables: Sequence[Table]
    losses: Sequence[Loss] = field(default=())
