"""The figures of a whole run: errors over drives, the order of estimators, effects of conditions, and coverage.

They come from the tables of the run: a few figures of each drive are in memory, never a series.
Scores use drives with ground truth that is independent of the estimator; other drives are listed separately.
Intervals take the dependence of drives of one day, car or route into account.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.evaluation import statistics
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.results.breakdown import LEAST_DRIVES, SIGNIFICANT, Breakdown, breakdowns
from pdhef_logtool.results.opened_run import OpenedRun
from pdhef_logtool.results.selected_estimate import NAIVE

#: Name of the estimate that each drive's report calls its answer.
ANSWER = "answer"
#: Columns of errors: signal and unit.
SIGNALS = {s: SCORED_SIGNALS[s] for s in ("sideslip_rad", "vy_m_s", "yaw_rate_rad_s", "vx_m_s")}
JUDGED = "sideslip_rad"
WORST = 20
#: Levels of folders by which drives are grouped.
_MOST_FOLDERS = 3
#: Most labels of a group of failures, and most groups.
NAMED, _MOST_GROUPS = 10, 50
#: Remedies by the first words of a supervisor's reason.
_REMEDIES = {
    "nothing heard": "Allow more time: --set log_timeout_s=SECONDS.",
    "the worker was killed": "If memory was short, use fewer --jobs; pdhef inspect LOG shows the size of the log.",
    "there was no more memory": "Use fewer --jobs, or a machine with more memory.",
    "took more than": "Allow more memory: --set max_memory_mb=MB.",
}
_PLACE = re.compile(r"\s*\([^()]*\)\s*$")
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True, slots=True)
class Median:
    """A median over drives with its 95 % interval; NaN where the drives are too few."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class FleetDrive:
    """One drive with a report.

    Attributes
    ----------
    seconds : length. main : the selected estimate's estimator, empty without one.
    truth : whether its sideslip is scored against an independent ground truth. unscored : why not, else empty.
    errors : RMSE by estimator and signal, where the ground truth is independent of both.
    nis, d2, naive_d2 : without ground truth: NIS and v̇_y residual of the selected estimate, v̇_y residual of sideslip 0.
    coverage : of the 95 % confidence interval.
    failed_checks : that count. keys : for grouping.
    factors : day, car and route, None where not stated.
    """

    label: str
    seconds: float
    main: str
    truth: bool
    unscored: str
    errors: Mapping[tuple[str, str], float]
    coverage: float
    nis: float
    d2: float
    naive_d2: float
    failed_checks: int
    keys: Mapping[str, str]
    factors: Mapping[str, str | None]

    def error(self, estimator: str = ANSWER, signal: str = JUDGED) -> float:
        """Return the RMSE of an estimator, NaN if unknown."""
        return self.errors.get((self.main if estimator == ANSWER else estimator, signal), math.nan)


@dataclass(frozen=True, slots=True)
class Distribution:
    """Errors of one estimator in one signal over drives: ``values`` ascending, in ``unit``."""

    estimator: str
    signal: str
    unit: str
    median: Median
    values: FloatArray

    @property
    def drives(self) -> int:
        """Drives with the figure."""
        return len(self.values)

    def quantile(self, share: float) -> float:
        """Return a quantile of the errors."""
        return float(np.quantile(self.values, share))


@dataclass(frozen=True, slots=True)
class Rank:
    """Place of an estimator, and the estimators that it is significantly better than.

    ``place``: None where no difference between two estimators is significant. ``against_answer``: the median of its
    error over the selected estimate's, less 1; None for one that always is the selected estimate.
    """

    place: int | None
    estimator: str
    drives: int
    better_than: tuple[str, ...]
    against_answer: Median | None


@dataclass(frozen=True, slots=True)
class Failures:
    """Logs with the same failure: ``reason`` of the first, ``count``, and the first :data:`NAMED` ``labels``."""

    reason: str
    count: int
    labels: tuple[str, ...]

    @property
    def explanation(self) -> tuple[str, str]:
        """The cause, and the remedy, empty where none is known."""
        return cause_and_remedy(self.reason)


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Seconds and RMSE of sideslip in rad by cell of speed and |a_y|, [speeds, accelerations]; NaN: not scored."""

    speed_edges_m_s: FloatArray
    ay_edges_m_s2: FloatArray
    seconds: FloatArray
    rmse_rad: FloatArray
    drives: int


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """All of a run: ``logs`` in it, ``drives`` with a report, ``failed`` ones by reason, ``losses`` of the others.

    ``least_to_rank``: scored drives that a ranking of these estimators needs; with fewer, ``ranking`` is empty.
    ``dependence``: of the errors of the selected estimate.
    """

    logs: int
    drives: tuple[FleetDrive, ...]
    distributions: tuple[Distribution, ...]
    ranking: tuple[Rank, ...]
    least_to_rank: int
    dependence: statistics.Dependence
    breakdowns: tuple[Breakdown, ...]
    space: Space | None
    failed: tuple[Failures, ...]
    losses: tuple[Failures, ...]

    @property
    def scored(self) -> tuple[FleetDrive, ...]:
        """Drives with a scored selected estimate."""
        return tuple(d for d in self.drives if d.truth)

    @property
    def worst(self) -> tuple[FleetDrive, ...]:
        """The scored drives with the largest errors, the largest first; at most a quarter, but for a few."""
        scored = sorted(self.scored, key=lambda d: (-d.error(), d.label))
        return tuple(scored[: min(WORST, max(5, len(scored) // 4))])

    @property
    def without_truth(self) -> tuple[FleetDrive, ...]:
        """The other drives, largest contradiction between selected estimate and sensors first."""

        def contradiction(drive: FleetDrive) -> tuple[bool, float, str]:
            against = drive.d2 / drive.naive_d2 if drive.naive_d2 > 0.0 else math.nan
            return not math.isfinite(against), -against if math.isfinite(against) else 0.0, drive.label

        return tuple(sorted((d for d in self.drives if not d.truth), key=contradiction))


def read_fleet(run: OpenedRun, by: Sequence[str] = ()) -> Fleet:
    """Return the figures of a run.

    Parameters
    ----------
    by : keys to break the drives down by; none: every key that shows drives apart.

    Raises
    ------
    OutputError
        A table is damaged.
    """
    rows = _rows(run)
    done = [row for row in rows if row["outcome"] != "failed"]
    faults = run.table("faults")
    sensors = faults.filter(pl.col("origin") == "sensor").group_by("log").agg(pl.col("kind").unique().sort())
    kinds = dict(sensors.collect().iter_rows())
    lost = faults.filter(severity="lost").select("log", "text").collect().rows()
    metadata = statistics.gathered((log, entry) for log, *entry in run.table("metadata").collect().iter_rows())
    figures = sideslip_errors(run, [*SIGNALS]).collect().iter_rows()
    of_log = statistics.gathered((log, ((estimator, signal), value)) for log, estimator, signal, value in figures)
    drives = tuple(
        _drive(r, dict(of_log.get(r["log"], ())), dict(metadata.get(r["log"], ())) | _keys(r, kinds.get(r["log"])))
        for r in done
    )
    errors = np.array([d.error() for d in drives])
    scored = [d for d in drives if d.truth]
    names = _estimators(scored)
    return Fleet(
        logs=len(rows),
        drives=drives,
        distributions=tuple(_distributions(scored, names)),
        ranking=tuple(_ranking(scored, names)) if len(scored) >= least_to_rank(len(names)) else (),
        least_to_rank=least_to_rank(len(names)),
        dependence=_dependence(scored),
        breakdowns=breakdowns(errors, [d.keys for d in drives], _of_all(drives), by),
        space=_space(run),
        failed=grouped([(r["log"], r["reason"]) for r in rows if r["outcome"] == "failed"]),
        losses=grouped(lost),
    )


def least_to_rank(estimators: int) -> int:
    """Return how many drives can show a difference of two among several estimators: sign test with Holm's correction.

    With N drives the smallest two-sided p-value is 2 * 0.5**N.
    """
    pairs = max(estimators * (estimators - 1) // 2, 1)
    return max(LEAST_DRIVES, math.floor(math.log2(2.0 * pairs / SIGNIFICANT)) + 1)


def _space(run: OpenedRun) -> Space | None:
    """Return the operating space of all drives."""
    cells = run.table("exposure").with_columns(scored=pl.when(pl.col("sideslip_mse_rad2").is_not_null()).then("scored"))
    squares = (pl.col("sideslip_mse_rad2") * pl.col("scored")).sum() / pl.col("scored").sum()
    sums = cells.group_by("speed_m_s", "ay_m_s2").agg(pl.col("seconds").sum(), squares.sqrt().alias("rmse"))
    rows = sums.collect().rows()
    if not rows:
        return None
    shape = len(SPEED_EDGES_M_S), len(AY_EDGES_M_S2)
    seconds, rmse = np.zeros(shape), np.full(shape, math.nan)
    for speed, ay, spent, error in rows:
        cell = SPEED_EDGES_M_S.index(speed), AY_EDGES_M_S2.index(ay)
        seconds[cell], rmse[cell] = spent, error
    drives = run.table("exposure").select(pl.col("log").n_unique()).collect().item()
    return Space(np.array(SPEED_EDGES_M_S), np.array(AY_EDGES_M_S2), seconds, rmse, drives)


def sideslip_errors(run: OpenedRun, signals: Sequence[str] = (JUDGED,)) -> pl.LazyFrame:
    """Return the RMSE of drives, where the ground truth is independent: log, estimator, signal and value."""
    there = pl.col("independent") & pl.col("value").is_finite() & pl.col("signal").is_in(signals)
    return (
        run.table("metrics").filter(there, segment="all", metric="rmse").select("log", "estimator", "signal", "value")
    )


def _rows(run: OpenedRun) -> list[dict[str, Any]]:
    """Return the table of drives, with NIS per degree of freedom, v̇_y residual and the residual of sideslip 0."""

    def value(metric: str) -> pl.Expr:
        return pl.col("value").filter(pl.col("metric") == metric).first()

    metrics = run.table("metrics").filter(pl.col("metric").is_in(["nis", "nis_dof", "d2"]), segment="all")
    checks = metrics.group_by("log", "estimator").agg(nis=value("nis") / value("nis_dof"), d2=value("d2"))
    naive = checks.filter(estimator=NAIVE).select("log", naive_d2="d2")
    drives = run.table("drives").with_row_index("place").join(checks, on=["log", "estimator"], how="left")
    return drives.join(naive, on="log", how="left").sort("place").collect().to_dicts()


def _drive(row: Mapping[str, Any], errors: Mapping[tuple[str, str], float], keys: Mapping[str, str]) -> FleetDrive:
    """Return a drive of its row."""
    figures = (row[key] for key in ("sideslip_coverage95", "nis", "d2", "naive_d2"))
    coverage, nis, d2, naive_d2 = (math.nan if x is None else float(x) for x in figures)
    scored, factors = row["sideslip_rmse_rad"] is not None, {factor: row[factor] for factor in statistics.FACTORS}
    main, unscored, failed = row["estimator"] or "", row["unscored"] or "", row["failed_checks"]
    return FleetDrive(
        row["log"], row["seconds"], main, scored, unscored, errors, coverage, nis, d2, naive_d2, failed, keys, factors
    )


def _keys(row: Mapping[str, Any], kinds: Sequence[str] | None) -> dict[str, str]:
    """Return the keys for grouping of a drive that are not in the metadata of its log."""
    lengths = (("below 10 s", 10.0), ("10 to 60 s", 60.0), ("1 to 10 min", 600.0), ("10 to 60 min", 3600.0))
    from_log = {
        "car": row["car"],
        "log format": row["log_format"],
        "answer": row["estimator"],
        "friction source": row["friction_source"],
        "length": next((text for text, end in lengths if row["seconds"] < end), "above an hour"),
        "sensor faults": None if row["sensor_faults"] is None else ", ".join(kinds or ()) or "none",
        "month": (row["day"] or "")[:7],
    }
    parts = row["folder"].split("/")[:_MOST_FOLDERS]
    from_log |= {"folder" if i == 0 else f"folder {i + 1}": "/".join(parts[: i + 1]) for i in range(len(parts))}
    return {k: v for k, v in from_log.items() if v}


def _estimators(drives: Iterable[FleetDrive]) -> list[str]:
    """Return the estimators with an error in the judged signal, the most frequent first."""
    counts = Counter(e for d in drives for e, s in d.errors if s == JUDGED)
    return sorted(counts, key=lambda e: (-counts[e], e))


def _of_all(drives: Sequence[FleetDrive], use: BoolArray | None = None) -> dict[str, list[str | None]]:
    """Return day, car and route of the drives to use (None: all)."""
    used = drives if use is None else [drives[i] for i in np.flatnonzero(use).tolist()]
    return {f: [d.factors.get(f) for d in used] for f in statistics.FACTORS}


def _dependence(drives: Sequence[FleetDrive]) -> statistics.Dependence:
    """Return the dependence of the selected estimate's errors."""
    errors = np.array([d.error() for d in drives])
    use = errors > 0.0
    return statistics.dependence(np.log(errors[use]), _of_all(drives, use))


def _median(change: statistics.PairedChange, scale: Callable[[float], float] = float) -> Median:
    return Median(*map(scale, (change.median, change.low, change.high)))


def _distributions(drives: Sequence[FleetDrive], names: Sequence[str]) -> Iterable[Distribution]:
    for signal, unit in SIGNALS.items():
        for name in (ANSWER, *names):
            values = np.array([d.error(name, signal) for d in drives])
            use = np.isfinite(values)
            if use.any():
                median = _median(statistics.paired_change(values[use], None, _of_all(drives, use)))
                yield Distribution(name, signal, unit, median, np.sort(values[use]))


def _ranking(drives: Sequence[FleetDrive], names: Sequence[str]) -> list[Rank]:
    """Return the estimators in order of how many others they beat, pair by pair on the drives of both."""
    errors = {name: np.array([d.error(name) for d in drives]) for name in (ANSWER, *names)}

    def change(a: str, b: str) -> statistics.PairedChange:
        both = np.isfinite(errors[a]) & np.isfinite(errors[b])
        return statistics.paired_change(
            statistics.log_ratios(errors[a][both], errors[b][both]), None, _of_all(drives, both)
        )

    pairs = [*combinations(names, 2)]
    changes = [change(a, b) for a, b in pairs]
    beats: dict[str, set[str]] = {name: set() for name in names}
    score = dict.fromkeys(names, 0)
    for (a, b), of_pair, p in zip(pairs, changes, statistics.holm([c.sign_p for c in changes]), strict=True):
        if p < SIGNIFICANT and of_pair.median != 0.0:
            better, worse = (a, b) if of_pair.median > 0.0 else (b, a)
            beats[better].add(worse)
            score[better] -= 1
            score[worse] += 1
    order = sorted(names, key=lambda n: (score[n], float(np.nanmedian(errors[n])), n))
    mains = {d.main for d in drives}
    return [
        Rank(
            # Equal places where no difference is significant, and none where this is true of all.
            place=1 + sum(score[o] < score[name] for o in names) if any(beats.values()) else None,
            estimator=name,
            drives=int(np.isfinite(errors[name]).sum()),
            better_than=tuple(n for n in order if n in beats[name]),
            against_answer=None if mains == {name} else _median(change(ANSWER, name), math.expm1),
        )
        for name in order
    ]


def cause_and_remedy(reason: str) -> tuple[str, str]:
    """Return the cause of a failure and its remedy, empty where the reason contains none.

    An error of this tool reads ``WHERE: expected EXPECTED, got GOT; REMEDY``.
    """
    expected, got, rest = reason.partition(", got ")
    if not got or "expected " not in expected:
        return _sentence(reason), next((remedy for start, remedy in _REMEDIES.items() if reason.startswith(start)), "")
    cause, _, remedy = rest.rpartition("; ") if "; " in rest else (rest, "", "")
    return f"{_sentence(cause)} (expected: {expected.rpartition('expected ')[2]}).", _sentence(remedy)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def grouped(failures: Sequence[tuple[str, str]]) -> tuple[Failures, ...]:
    """Return reasons with their logs, the most frequent first; numbers and places do not distinguish reasons."""
    members: dict[str, tuple[str, dict[str, None]]] = {}
    for label, reason in failures:
        text = _without_place(reason)
        members.setdefault(_NUMBER.sub("", text), (text, {}))[1][label] = None
    groups = [Failures(text, len(labels), tuple(labels)[:NAMED]) for text, labels in members.values()]
    return tuple(sorted(groups, key=lambda g: (-g.count, g.reason))[:_MOST_GROUPS])


def _without_place(reason: str) -> str:
    _, expected, rest = reason.partition(": expected ")
    return f"expected {rest}" if expected else _PLACE.sub("", reason)
