"""Mutants of every table and CAN format through ``pdhef inspect``, every third through ``pdhef convert``."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from studies.torture.outside import measured
from studies.torture.table_damage import table_mutant
from studies.torture.table_seeds import FORMATS, table_seeds
from studies.torture.workers import LIMIT_BYTES, Verdict, judge

#: A command that runs for longer hangs; the machine may do other work beside it.
HANG_S = 60.0
CONVERT_EVERY = 3
#: Content of a file of the machine, which no output may contain.
_CANARY = struct.pack("<d", 424_242.125)


def format_judge(work: Path, name: str, seed: int) -> Any:
    """Return a function that judges a mutant of a format by its number. Writes the seeds and the canary files."""
    import h5py

    folder = work / "seeds" / name
    folder.mkdir(parents=True, exist_ok=True)
    canary = work / "canary"
    canary.write_bytes(_CANARY * 150)
    with h5py.File(f"{canary}.h5", "w") as file:
        file["x"] = [[424_242.125] * 150]
    return partial(judge_mutant, work, name, table_seeds(name, folder), seed, canary)


def judge_mutant(work: Path, name: str, seeds: Sequence[bytes], seed: int, canary: Path, number: int) -> Verdict:
    """Read a mutant in a separate process with an empty working folder and TMPDIR, and judge its end and its traces."""
    folder = work / "cases" / f"{name}-{number}"
    places = [folder / "cwd", folder / "tmp"]
    for place in places:
        place.mkdir(parents=True, exist_ok=True)
    log, out = folder / f"drive.{FORMATS[name][0]}", folder / "out.mcap"
    try:
        log.write_bytes(table_mutant(name, seeds, seed, number, canary))
        arguments = ["inspect"] if number % CONVERT_EVERY else ["convert", "-o", str(out)]
        env = {**os.environ, "TMPDIR": str(places[1])}
        process = measured(arguments[0], str(log), *arguments[1:], limit_s=HANG_S, cwd=places[0], env=env)
        verdict = judge(process, (0, 1, 3))
        problems = [verdict.problem] if verdict.problem else []
        problems += ["a traceback"] if "Traceback" in process.err else []
        problems += [f"more than {HANG_S:g} s"] if process.late else []
        problems += [f"{process.peak_bytes >> 20} MiB"] if process.peak_bytes > LIMIT_BYTES else []
        problems += ["left a process"] if process.left else []
        problems += [f"left {path.name}" for place in places for path in place.iterdir()]
        problems += ["contains another file"] if out.is_file() and _has_canary(out) else []
        return Verdict(verdict.end, "; ".join(problems), {"s": process.wall_s, "bytes": process.peak_bytes})
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _has_canary(path: Path) -> bool:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return any(_CANARY in message.data for _, _, message in make_reader(file).iter_messages())
