"""Mutated recordings through ``pdhef inspect``, every hundredth also through ``pdhef run``."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

from studies.torture.mutating import mutant
from studies.torture.seeds import write_seeds
from studies.torture.workers import Verdict, command, judge

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
