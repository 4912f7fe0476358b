"""Table reader with faults. Its input file selects the fault: ``PLANTED deed argument``."""

import ctypes
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np

from pdhef_logtool.logs.formats import LogFormat
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError

FORMAT = LogFormat("a planted file", f"{__name__}:open_planted", (".planted",), b"PLANTED ", libraries=())


def open_planted(file: TableFile) -> Tables:
    """Return one table of 5 rows; the name of a column selects its fault."""
    _, deed, argument = file.stream.read().decode().split()
    before = _do(deed, file, argument)
    fields = tuple(FieldInfo(name, "number", unit="m/s") for name in ("good", "segv", "bad", "better"))

    def load(path: str, rows: slice) -> np.ndarray:
        _do(path, file, argument)
        return np.arange(5.0)[rows] + before

    return Tables("planted", [Table("t", np.arange(5) * 10 + 10**18, fields, load)])


def _do(deed: str, file: TableFile, argument: str) -> float:
    match deed:
        case "segv":
            ctypes.string_at(0)
        case "exit":
            os._exit(0)
        case "bad":
            raise ValueError("a block of it is damaged")
        case "refuse":
            raise LogError(expected="a planted file", got="a weed", where=file.name, remedy="plant another")
        case "hang":
            while True:
                pass
        case "memory":
            return float(np.ones(1 << 32).sum())
        case "interrupt":
            raise SystemExit(0)
        case "read":
            Path(argument).read_bytes()
        case "link":
            Path("here").symlink_to(argument)
            Path("here").read_bytes()
        case "write":
            Path(argument).write_text("written")
        case "run":
            subprocess.run([sys.executable, "-c", "pass"], check=True)
        case "connect":
            socket.create_connection(("127.0.0.1", int(argument)))
        case "kill":
            os.kill(os.getppid(), 0)
        case "print":
            os.write(1, b"noise on stdout\n")
            os.write(2, b"noise on stderr\n")
        case "leave":
            Path("left_behind").write_text("private")
            return float(len(list(Path.cwd().iterdir())))
    return 0.0
