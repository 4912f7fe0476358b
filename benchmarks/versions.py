"""The same commands by this version and an earlier one, in turns on one machine.

Processor and elapsed seconds are the best of two turns, memory the smallest peak of a process; code is compiled before.
The last column: cost of the earlier version over that of this one.
"""

import subprocess
from pathlib import Path

from benchmarks.fleet_drive import DRIVES, drives
from benchmarks.hour import run_words
from benchmarks.measuring import CACHE, ROOT, Cost, Row, command_cost
from benchmarks.one_hour_log import SHARED_S, drive_log, image_log
from benchmarks.starting import LIGHT

TURNS = 2
_FLEET = ("--car", "saloon", "--keep", "metrics", "--no-report")


def rows(other: Path) -> list[Row]:
    """Measure this tree and another one."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=other, check=True, capture_output=True, text=True
    ).stdout.strip()
    for tree in (ROOT, other):
        command_cost("compile", tree=tree)
    out, measured = CACHE / "versions", []
    works: dict[str, tuple[str | Path, ...]] = {
        "a new process runs 10 s, figures": LIGHT,
        "inspect 60 s with 150 MB of images in shared chunks": ("inspect", image_log(SHARED_S)),
        "inspect the hour": ("inspect", drive_log()),
        f"{DRIVES} drives of a fleet": ("run", *drives(), *_FLEET, "-o", out),
        "run of the hour, light outputs": run_words(out, light=True),
        "run of the hour, everything": run_words(out, light=False),
    }
    for work, words in works.items():
        costs: dict[Path, list[Cost]] = {ROOT: [], other: []}
        for _ in range(TURNS):
            for tree, of_tree in costs.items():
                of_tree.append(command_cost(*words, tree=tree))
        for name, unit, figure in (
            (work, "s", lambda cost: cost.seconds),
            ("elapsed time of it", "s", lambda cost: cost.elapsed_s),
            ("memory of it", "MB", lambda cost: cost.peak_bytes / 1e6),
        ):
            ours, theirs = (min(map(figure, of_tree)) for of_tree in costs.values())
            measured.append(Row(name, ours, unit, peers={commit: theirs / ours}))
    return measured
