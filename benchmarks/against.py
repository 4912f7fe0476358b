"""Commands of this tree and of another one, interleaved on one machine: ``python -m benchmarks.performance --against``.

A work is run in both trees in turns; the ratio of the best processor seconds does not depend on the load of the
machine.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from benchmarks.fleet_drive import DRIVES, drives
from benchmarks.hour import run_words
from benchmarks.measuring import CACHE, ROOT, Row, best_seconds, command_cost
from benchmarks.one_hour_log import SHARED_S, drive_log, image_log
from benchmarks.starting import LIGHT

_FLEET = ("--car", "saloon", "--keep", "metrics", "--no-report")


def works() -> dict[str, tuple[str | Path, ...]]:
    """Return the words of each command."""
    out = CACHE / "against"
    return {
        "a new process runs 10 s, figures": LIGHT,
        "inspect 60 s with 150 MB of images in shared chunks": ("inspect", image_log(SHARED_S)),
        "inspect the hour": ("inspect", drive_log()),
        f"{DRIVES} drives of a fleet": ("run", *drives(), *_FLEET, "-o", out),
        "run of the hour, light outputs": run_words(out, light=True),
        "run of the hour, everything": run_words(out, light=False),
    }


def rows(other: Path) -> list[Row]:
    """Measure this tree and another one."""
    measured = []
    for work, words in works().items():
        ways = {name: partial(command_cost, *words, tree=tree) for name, tree in (("this", ROOT), ("other", other))}
        for way in ways.values():
            way()  # code that is compiled on its first call
        seconds = best_seconds(ways)
        measured.append(Row(work, seconds["this"], "s", peers={"other tree": seconds["other"] / seconds["this"]}))
    return measured
