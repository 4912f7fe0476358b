"""Finding a run's recording and opening it in the Rerun viewer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from pdhef_logtool.records.errors import OutputError

RECORDING = "recording.rrd"


def find_recording(output: Path, log: str | None) -> Path:
    """Return the recording of one log of a run.

    Parameters
    ----------
    output : output folder of a run, the folder of one log, or the recording itself.
    log : stem of the log; None takes the first in alphabetical order.

    Raises
    ------
    OutputError
        There is no such recording; the ones that there are get named.
    """
    if output.is_file():
        return output
    if log is None and (output / RECORDING).is_file():
        return output / RECORDING
    recordings = {p.parent.name: p for p in sorted((output / "logs").glob(f"*/{RECORDING}"))}
    if log is None and recordings:
        return next(iter(recordings.values()))
    if log is not None and log in recordings:
        return recordings[log]
    raise OutputError(
        expected=RECORDING if log is None else f"a log named {log}",
        got=", ".join(recordings) or "none",
        where=str(output),
        remedy="" if recordings else "pdhef run LOG -o OUT writes one",
    )


def open_viewer(recording: Path) -> int:
    """Open the recording in Rerun's viewer and return its exit code."""
    return subprocess.call([sys.executable, "-m", "rerun", str(recording)])  # noqa: S603 (our own interpreter)
