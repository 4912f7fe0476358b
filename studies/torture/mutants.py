"""Mutants of recordings, tables and CAN logs through the command line; tables in a separate process each."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from studies.mcap_logs import messages
from studies.torture.damage import mutant, table_mutant
from studies.torture.seeds import FORMATS, table_seeds, write_seeds
from studies.torture.workers import Verdict, command, judge, judge_process, measured

RUN_EVERY = 100
_RUN = ("--car", "saloon", "--estimators", "zero,kinematic,phy-ukf")
#: Containers in which a checksum covers every message: a message may not go without a loss.
_CHECKED = ("zstd.mcap", "lz4.mcap", "plain.mcap", "unchunked.mcap", "noindex.mcap", "json.mcap", "protobuf.mcap")


def log_judge(work: Path, seed: int):  # type: ignore[no-untyped-def]
    """Make the seeds, compile the code for runs, and return a function that judges one mutated log by its number."""
    seeds = write_seeds(work / "seeds")
    counts = {}
    for name in seeds:
        ended = command("inspect", str(work / "seeds" / name), "--json")
        counts[name] = _messages(ended.out)
    # To compile takes longer than a case may.
    warm = (*_RUN[:2], "--estimators", "phy-ukf", "--no-report")
    command("run", str(work / "seeds" / "plain.bag"), "-o", str(work / "warm"), *warm)
    return partial(judge_log, work, seed, seeds, counts)


def judge_log(work: Path, seed: int, seeds: dict[str, bytes], counts: dict[str, int], number: int) -> Verdict:
    """Write a mutant, look at it and perhaps run it, and take it away again."""
    name = sorted(seeds)[number % len(seeds)]
    kind, content = mutant(name, seeds[name], seed, number)
    folder = work / "cases" / str(number)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_bytes(content)
    try:
        as_json = kind == "bytes" or number % 2 == 0
        ended = command("inspect", str(path), *(["--json"] if as_json else []))
        verdict = judge(ended, (0, 1, 3))
        if not verdict.problem and kind == "bytes" and ended.code == 0 and name in _CHECKED:
            left = _messages(ended.out)
            if left < counts[name]:
                return Verdict("lost in silence", f"{left} of {counts[name]} messages and no loss")
        if verdict.problem or (number // len(seeds)) % RUN_EVERY:
            return verdict
        ran = judge(command("run", str(path), "-o", str(folder / "out"), *_RUN), (0, 1, 3))
        return Verdict(f"{verdict.end}, run {ran.end}", ran.problem)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _messages(document: str) -> int:
    return sum(int(t["messages"]) for t in json.loads(document)["topics"])


# ------------------------------------------------------------------------------------------------ tables

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
        left = [f"left {path.name}" for place in places for path in place.iterdir()]
        if out.is_file() and any(_CANARY in m.data for m in messages(out)):
            left.append("contains another file")
        return judge_process(process, (0, 1, 3), HANG_S, *left)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
