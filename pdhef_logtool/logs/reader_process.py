"""The boundary of foreign readers: a reader of tables runs with an open file and its limits, and no path."""

from __future__ import annotations

import pkgutil

from pdhef_logtool.logs.log_file import LogFile
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import TableLog


def open_tables(file: LogFile, reader: str) -> TableLog:
    """Open a file by a reader of tables, named ``package.module:function``."""
    stream = file.path.open("rb")
    with file.meter.running(size := file.path.stat().st_size):
        tables: Tables = pkgutil.resolve_name(reader)(TableFile(stream, size, str(file.place), file.meter.limits))
    return TableLog(file, tables.kind, tables.tables, tables.losses)
