"""Evaluate the decisions of ``pdhef compare``: false alarms, detected changes, and cost with many drives.

    python -m studies.comparing [--times 5000] [--planted 2000] [--drives 10000] [--out docs]

The paired log ratios of drives are drawn from a normal and a heavy-tailed distribution (Student's t with 3 degrees of
freedom, scaled to the same standard deviation), 0.2 wide. Without a change, relabelling flips the sign of each ratio at
random. The cost is measured on a synthetic run of many drives, with as many figures per drive as in a real run.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import command_cost
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.statistics import paired_change
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.results.opened_run import TABLES, TABLES_FOLDER, table_file
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import drive_part, write_tables
from pdhef_logtool.storage.documents import file_sha256, seal
from studies.pages import DOCS, options, table, update

LIMIT, PLANTED, SPREAD = 0.05, 0.10, 0.2
COUNTS = (5, 10, 30, 100)
#: Drives that depend on one another, and the share of the variance of their log ratios that lies between days.
DAYS, DRIVES_A_DAY, SHARED = 6, 10, (0.0, 0.1, 0.2, 0.4, 0.8)
#: Figures a drive that a run with three estimators writes: these make as many.
_ESTIMATORS = ("zero", "physics", "pd-hef")
_SIGNALS = ("sideslip_rad", "vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")
_SEGMENTS = ("all", "linear", "nonlinear", "straight", "cornering-left", "cornering-right", "slalom", "braking")
_METRICS = ("rmse", "mae", "bias", "p95_abs", "max_abs", "coverage95")
_TAIL_DEGREES = 3.0

#: ``draw(rng, shape)`` of log ratios.
Draw = Callable[[np.random.Generator, tuple[int, int]], FloatArray]


def normal(rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
    """Return log ratios [times, drives] of a normal distribution."""
    return rng.normal(0.0, SPREAD, shape)


def heavy_tailed(rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
    """Return log ratios [times, drives] with some drives that go wild."""
    scale = SPREAD / math.sqrt(_TAIL_DEGREES / (_TAIL_DEGREES - 2.0))
    return np.asarray(scale * rng.standard_t(_TAIL_DEGREES, shape))


def share_closed(draw: Draw, drives: int, times: int, planted: float, seed: int) -> float:
    """Return how often the gate closes, of drives that are all worse by ``planted`` beside their spread."""
    rng = np.random.default_rng(seed)
    signs = rng.choice((-1.0, 1.0), (times, drives))
    ratios = signs * draw(rng, (times, drives)) + math.log1p(planted)
    return float(np.mean([paired_change(drive_ratios).verdict(LIMIT) == "worse" for drive_ratios in ratios]))


def share_of_means(draw: Draw, drives: int, times: int, seed: int) -> float:
    """Return how often a ratio of mean RMSE above the limit, the naive gate, closes on a relabelling."""
    rng = np.random.default_rng(seed)
    level = np.exp(rng.normal(0.0, 0.5, (times, drives)))
    other = level * np.exp(rng.choice((-1.0, 1.0), level.shape) * draw(rng, (times, drives)))
    return float(np.mean(other.mean(axis=1) / level.mean(axis=1) > 1.0 + LIMIT))


def shares_of_days(shared: float, times: int, seed: int) -> tuple[float, float]:
    """Return how often equal runs of :data:`DAYS` days are called worse: with independent drives, and by default."""
    rng = np.random.default_rng(seed)
    day = np.repeat(np.arange(DAYS), DRIVES_A_DAY)
    factors = {"day": day.tolist()}
    alone = together = 0
    for _ in range(times):
        own, common = rng.normal(size=len(day)), rng.normal(size=DAYS)[day]
        ratios = SPREAD * (math.sqrt(1.0 - shared) * own + math.sqrt(shared) * common)
        alone += paired_change(ratios).verdict() == "worse"
        together += paired_change(ratios, None, factors).verdict() == "worse"
    return alone / times, together / times


def make_run(folder: Path, drives: int) -> int:
    """Write run.json and the tables of a run of made-up drives; return the number of figures."""
    rng = np.random.default_rng(5)
    car = {"file": "golf", "name": "golf", "sha256": "0" * 64, "network_sha256": None}
    outcomes = []
    for i in range(drives):
        digests: Any = dict.fromkeys(("sha256", "signals_sha256", "truth_sha256"), f"{i:064x}")
        outcomes.append(LogOutcome(f"drive_{i:05d}", f"{i}.mcap", car=car, main="pd-hef", **digests))

    def rows(log: str) -> list[MetricRow]:
        values = zip(_names(), rng.random(_PER_DRIVE).tolist(), strict=True)
        return [MetricRow(log, *name, value, "rad", 1000) for name, value in values]

    write_tables(folder / TABLES_FOLDER, (drive_part(o, {}, rows(o.log)) for o in outcomes))
    files = {table_file(name): file_sha256(folder / table_file(name)) for name in TABLES}
    document = {
        "format": "pdhef.run",
        "version": 1,
        "config": {},
        "model": None,
        "versions": {},
        "logs": [asdict(o) | {"outcome": "ok"} for o in outcomes],
    }
    (folder / "run.json").write_text(json.dumps(seal({**document, "files": files}), indent=2))
    return drives * _PER_DRIVE


def _names() -> Iterator[tuple[str, str, str, str]]:
    return ((e, s, g, m) for e in _ESTIMATORS for s in _SIGNALS for g in _SEGMENTS for m in _METRICS)


_PER_DRIVE = len(_ESTIMATORS) * len(_SIGNALS) * len(_SEGMENTS) * len(_METRICS)


def cost(drives: int) -> list[str]:
    """Return the table row of a run of many drives compared with itself by the command line."""
    with tempfile.TemporaryDirectory() as place:
        figures = make_run(Path(place), drives)
        command = command_cost("compare", place, place, "--max-regression", "5%")
    return [f"{drives:,}", f"{figures:,}", f"{command.seconds:.1f}", f"{command.peak_bytes / (1 << 20):.0f}"]


def blocks(times: int, planted: int, drives: int) -> dict[str, str]:
    """Return the tables by name."""
    false_alarms, detected = [], []
    for count in COUNTS:
        alarms = [share_closed(draw, count, times, 0.0, 1) for draw in (normal, heavy_tailed)]
        hits = [share_closed(draw, count, planted, PLANTED, 2) for draw in (normal, heavy_tailed)]
        naive = share_of_means(normal, count, times, 3)
        false_alarms.append([str(count), *(f"{x:.1%}" for x in (*alarms, naive))])
        detected.append([str(count), *(f"{x:.1%}" for x in hits)])
    days = [[f"{x:.0%}", *(f"{y:.1%}" for y in shares_of_days(x, times, 4))] for x in SHARED]
    return {
        "false_alarms": table("drives, normal, heavy tails, ratio of means", false_alarms, right_from=0),
        "detected": table("drives, normal, heavy tails", detected, right_from=0),
        "days": table("between days, --cluster none, default: dependence is estimated", days, right_from=0),
        "cost": table("drives, figures, processor s, MiB at most", [cost(drives)], right_from=0),
    }


def main() -> None:
    """Write the tables into docs/calibration.md."""
    parser = options("comparing", __doc__)
    parser.add_argument("--times", type=int, default=5000, help="relabellings without a change")
    parser.add_argument("--planted", type=int, default=2000, help="runs with a change")
    parser.add_argument("--drives", type=int, default=10_000, help="of the run that is compared with itself")
    parser.add_argument("--out", type=Path, default=DOCS)
    given = parser.parse_args()
    update(given.out, "calibration.md", blocks(given.times, given.planted, given.drives))


if __name__ == "__main__":
    main()
