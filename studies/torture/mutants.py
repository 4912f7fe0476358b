"""Mutants of recordings in supervised processes, and of every format in separate processes, with their verdicts."""

import json
import os
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from studies.mcap_logs import messages
from studies.torture.damage import mutant
from studies.torture.seeds import FORMATS, table_seeds, write_seeds
from studies.torture.workers import Verdict, command, judge, judge_process, measured

_CODES = (0, 1, 3)
RUN_EVERY, CONVERT_EVERY = 100, 3
_RUN = ("--car", "saloon", "--estimators", "zero,kinematic,phy-ukf")
#: A command that runs for longer hangs; the machine may do other work beside it.
HANG_S = 60.0
#: Content of a file of the machine, which no output may contain.
_CANARY = struct.pack("<d", 424_242.125)


def log_judge(work: Path, seed: int) -> Callable[[int], Verdict]:
    """Make the seeds, compile the code for runs, and return a function that judges one mutated log by its number."""
    seeds = write_seeds(work / "seeds")
    counts = {name: _messages(command("inspect", str(work / "seeds" / name), "--json").out) for name in seeds}
    # To compile takes longer than a case may.
    warm = (*_RUN[:2], "--estimators", "phy-ukf", "--no-report")
    command("run", str(work / "seeds" / "plain.bag"), "-o", str(work / "warm"), *warm)
    return partial(judge_log, work, seed, seeds, counts)


def judge_log(work: Path, seed: int, seeds: dict[str, bytes], counts: dict[str, int], number: int) -> Verdict:
    """Inspect a mutated recording, and run every :data:`RUN_EVERY`-th one of each seed."""
    name = sorted(seeds)[number % len(seeds)]
    with tempfile.TemporaryDirectory(dir=work) as folder:
        path = Path(folder) / name
        kind, content = mutant(path.suffix[1:], [seeds[name]], seed, number, path)
        path.write_bytes(content)
        ended = command("inspect", str(path), *(["--json"] if kind == "bytes" or number % 2 else []))
        verdict = judge(ended, _CODES)
        # A checksum of MCAP covers every message: none may be missing without a loss.
        if not verdict.problem and kind == "bytes" and ended.code == 0 and path.suffix == ".mcap":
            left = _messages(ended.out)
            if left < counts[name]:
                return Verdict("lost in silence", f"{left} of {counts[name]} messages and no loss")
        if verdict.problem or (number // len(seeds)) % RUN_EVERY:
            return verdict
        ran = judge(command("run", str(path), "-o", str(path.with_name("out")), *_RUN), _CODES)
        return Verdict(f"{verdict.end}, run {ran.end}", ran.problem)


def _messages(document: str) -> int:
    return sum(int(t["messages"]) for t in json.loads(document)["topics"])


def format_judge(work: Path, name: str, seed: int) -> Callable[[int], Verdict]:
    """Return a function that judges a mutant of a format by its number. Writes the seeds and the canary files."""
    import h5py

    folder = work / "seeds" / name
    folder.mkdir(parents=True, exist_ok=True)
    canary = work / "canary"
    canary.write_bytes(_CANARY * 150)
    with h5py.File(f"{canary}.h5", "w") as file:
        file["x"] = [[424_242.125] * 150]
    return partial(judge_mutant, name, table_seeds(name, folder), seed, canary)


def judge_mutant(name: str, seeds: Sequence[bytes], seed: int, canary: Path, number: int) -> Verdict:
    """Read a mutant in a separate process with an empty working folder and TMPDIR, and judge its end and its traces."""
    with tempfile.TemporaryDirectory(dir=canary.parent) as folder:
        places = [Path(folder) / "cwd", Path(folder) / "tmp"]
        for place in places:
            place.mkdir()
        log, out = Path(folder) / f"drive.{FORMATS[name][0]}", Path(folder) / "out.mcap"
        log.write_bytes(mutant(name, seeds, seed, number, canary)[1])
        arguments = ["inspect"] if number % CONVERT_EVERY else ["convert", "-o", str(out)]
        env = {**os.environ, "TMPDIR": str(places[1])}
        process = measured(arguments[0], str(log), *arguments[1:], limit_s=HANG_S, cwd=places[0], env=env)
        left = [f"left {path.name}" for place in places for path in place.iterdir()]
        if out.is_file() and any(_CANARY in m.data for m in messages(out)):
            left.append("contains another file")
        return judge_process(process, _CODES, HANG_S, *left)
