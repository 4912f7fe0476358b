"""A format of logs in one file: NumPy archives with a time and columns by topic, ``imu/ax [g]``."""

import numpy as np

from pdhef_logtool.logs.formats import LogFormat
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.logs.table_log import Table, TableLog


def open_npz(file: LogFile) -> TableLog:
    """Open an archive; each topic has a column ``t [s]`` in seconds since 1970."""
    tables = []
    with np.load(file.path) as archive:
        for topic in sorted({name.partition("/")[0] for name in archive.files}):
            columns = {n.partition("/")[2]: archive[n] for n in archive.files if n.startswith(f"{topic}/")}
            stamps_ns = np.round(columns.pop("t [s]") * 1e9).astype(np.int64)
            split = {name: name.rstrip("]").split(" [") for name in columns}
            values = {path: columns[name] for name, (path, _) in split.items()}
            tables.append(Table.of_arrays(topic, stamps_ns, values, dict(split.values())))
    return TableLog(file, "npz", tables)


FORMAT = LogFormat("a NumPy archive", "npz_log:open_npz", (".npz",), b"PK\x03\x04", needs_suffix=True)
