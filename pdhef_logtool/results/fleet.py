"""The figures of a whole run: errors over drives, the order of estimators, effects of conditions, and coverage.

Reports are read one after the other and metrics lazily: a few figures of each drive remain in memory, never a series.
Scores use drives with ground truth that is independent of the estimator; other drives are listed separately.
Intervals take the dependence of drives of one day, car or route into account.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.dependence import FACTORS, Dependence, dependence, factors_of
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.results.breakdown import LEAST_DRIVES, SIGNIFICANT, Breakdown, BreakdownDrive, breakdowns
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun
from pdhef_logtool.results.paired_change import PairedChange, holm, log_ratios, paired_change

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
    failed_checks : that count. lost : data that could not be used. keys : for grouping.
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
    lost: str
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
    """The place of an estimator: those that it is shown to be better than, pair by pair.

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
    """Logs that ended alike: the ``reason`` of the first, and ``labels`` of the first :data:`NAMED` of ``count``."""

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
    dependence: Dependence
    breakdowns: tuple[Breakdown, ...]
    space: Space | None
    failed: tuple[Failures, ...]
    losses: tuple[Failures, ...]

    @property
    def scored(self) -> tuple[FleetDrive, ...]:
        """Drives with a scored answer."""
        return tuple(d for d in self.drives if d.truth)

    @property
    def worst(self) -> tuple[FleetDrive, ...]:
        """The scored drives with the largest errors, the largest first; at most a quarter, but for a few."""
        scored = sorted(self.scored, key=lambda d: (-d.error(), d.label))
        return tuple(scored[: min(WORST, max(5, len(scored) // 4))])

    @property
    def without_truth(self) -> tuple[FleetDrive, ...]:
        """The other drives, largest contradiction between answer and sensors first."""

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
        metrics.parquet is damaged.
    """
    figures = read_figures(run)
    gathered = _Gathered()
    for log in run.logs:
        gathered.add(log, figures.get(log.label, {}))
    drives = tuple(gathered.drives)
    scored = [d for d in drives if d.truth]
    names = _estimators(scored)
    return Fleet(
        logs=len(run.logs),
        drives=drives,
        distributions=tuple(_distributions(scored, names)),
        ranking=tuple(_ranking(scored, names)) if len(scored) >= least_to_rank(len(names)) else (),
        least_to_rank=least_to_rank(len(names)),
        dependence=_dependence(scored),
        breakdowns=breakdowns([BreakdownDrive(d.error(), d.keys, d.factors) for d in drives], by),
        space=gathered.space(),
        failed=grouped(gathered.failed),
        losses=grouped(gathered.lost),
    )


def least_to_rank(estimators: int) -> int:
    """Return how many drives can show a difference of two among several estimators: sign test with Holm's correction.

    With N drives the smallest two-sided p-value is 2 * 0.5**N.
    """
    pairs = max(estimators * (estimators - 1) // 2, 1)
    return max(LEAST_DRIVES, math.floor(math.log2(2.0 * pairs / SIGNIFICANT)) + 1)


@dataclass(slots=True)
class _Gathered:
    """Accumulated contents of the reports."""

    drives: list[FleetDrive] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    lost: list[tuple[str, str]] = field(default_factory=list)
    edges: tuple[FloatArray, FloatArray] | None = None
    cells: FloatArray = field(default_factory=lambda: np.zeros((3, 0, 0)))
    mapped: int = 0

    def add(self, log: OpenedLog, figures: Mapping[tuple[str, str, str], float]) -> None:
        kind, _, reason = log.outcome.partition(": ")
        try:
            report = log.report()
            if kind == "failed" or report is None:
                self.failed.append((log.label, reason or "its report is not there any more"))
                return
        except PdhefError as error:
            self.failed.append((log.label, f"its report cannot be read: {error.expected}, got {error.got}"))
            return
        self.drives.append(_drive(log, report, figures))
        self.lost += [(log.label, str(x["what"])) for x in report.get("losses", ()) if x.get("severity") == "lost"]
        self._add_space(report.get("operating_space"))

    def _add_space(self, space: Mapping[str, Any] | None) -> None:
        if not space:
            return
        if self.edges is None:
            self.edges = np.array(space["speed_edges_m_s"]), np.array(space["ay_edges_m_s2"])
            self.cells = np.zeros((3, *map(len, self.edges)))
        self.mapped += 1
        for cell in space["cells"]:
            scored = cell["scored"] if cell["sideslip_mse_rad2"] is not None else 0
            share = cell["seconds"], scored, scored * (cell["sideslip_mse_rad2"] or 0.0)
            self.cells[:, cell["speed"], cell["ay"]] += share

    def space(self) -> Space | None:
        if self.edges is None:
            return None
        seconds, counts, squares = self.cells
        with np.errstate(invalid="ignore", divide="ignore"):
            return Space(*self.edges, seconds, np.sqrt(squares / counts), self.mapped)


def independent_errors(figures: Mapping[tuple[str, str, str], float]) -> dict[tuple[str, str], float]:
    """Return the RMSE by estimator and signal, where the ground truth is independent of both."""
    return {
        (e, s): value
        for (e, s, metric), value in figures.items()
        if metric == "rmse" and math.isfinite(value) and (e, s, "not_independent") not in figures
    }


def read_figures(run: OpenedRun) -> dict[str, dict[tuple[str, str, str], float]]:
    """Return the figures of whole drives by log, then by estimator, signal and metric."""
    import polars as pl

    rows = (
        run.metrics()
        .filter(
            (pl.col("segment") == "all")
            & (
                (pl.col("metric").is_in(["rmse", "not_independent"]) & pl.col("signal").is_in(list(SIGNALS)))
                | ((pl.col("metric") == "coverage95") & (pl.col("signal") == JUDGED))
                | pl.col("metric").is_in(["nis", "nis_dof", "d2"])
            )
        )
        .select("log", "estimator", "signal", "metric", "value")
    )
    values: dict[str, dict[tuple[str, str, str], float]] = {}
    for log, estimator, signal, metric, value in rows.collect().iter_rows():
        values.setdefault(log, {})[estimator, signal, metric] = math.nan if value is None else value
    return values


def _drive(log: OpenedLog, report: Mapping[str, Any], figures: Mapping[tuple[str, str, str], float]) -> FleetDrive:
    answer = report.get("answer") or {}
    ran = [e["name"] for e in report.get("estimators", ()) if e["outcome"] == "ran"]
    main = answer.get("main") or next(iter(ran), "")  # without an answer the first of recorded estimates
    errors = independent_errors(figures)
    dof = figures.get((main, "state", "nis_dof"), math.nan)
    nis = figures.get((main, "state", "nis"), math.nan)
    kind, _, reason = log.outcome.partition(": ")
    return FleetDrive(
        label=log.label,
        seconds=float(report["log"]["duration_s"]),
        main=main,
        truth=(main, JUDGED) in errors,
        unscored="" if (main, JUDGED) in errors else _why_unscored(report),
        errors=errors,
        coverage=figures.get((main, JUDGED, "coverage95"), math.nan),
        nis=nis / dof if dof and dof > 0.0 else math.nan,
        d2=figures.get((main, "vy_m_s", "d2"), math.nan),
        naive_d2=figures.get((answer.get("naive") or "", "vy_m_s", "d2"), math.nan),
        failed_checks=sum(c["verdict"] == "failed" and not c["waived"] for c in report.get("checks", ())),
        lost=reason if kind == "lost" else "",
        keys=_keys(log, report, main),
        factors=factors_of(log.entry, report),
    )


def _why_unscored(report: Mapping[str, Any]) -> str:
    if not report["truth"]["available"]:
        return "the log has no ground truth"
    if JUDGED in report["truth"]["not_independent"]:
        return "its ground truth is not independent"
    texts = (report.get("answer") or {}).get("texts") or {}
    return str(texts.get("result", "")).partition(" is not scored: ")[2] or "no figure of it is scored"


def _keys(log: OpenedLog, report: Mapping[str, Any], main: str) -> dict[str, str]:
    """Return the keys for grouping of a drive: metadata of its log, and of the run."""
    car = log.entry.get("car") or {}
    source = str((report.get("friction") or {}).get("source", ""))
    from_log = {
        "car": car.get("name") or report["vehicle"]["name"],
        "log format": report["log"]["kind"],
        "answer": main,
        "friction source": source,
        "length": _length(float(report["log"]["duration_s"])),
        "sensor faults": _fault_text(report),
        "month": (factors_of(log.entry, report)["day"] or "")[:7],
    }
    parts = str(log.entry.get("folder") or "").split("/")[:_MOST_FOLDERS]
    from_log |= {"folder" if i == 0 else f"folder {i + 1}": "/".join(parts[: i + 1]) for i in range(len(parts))}
    from_metadata = {str(k): str(v) for k, v in (report.get("metadata") or {}).items()}
    return {**from_metadata, **{k: v for k, v in from_log.items() if v}}


def _length(seconds: float) -> str:
    for text, end in (("below 10 s", 10.0), ("10 to 60 s", 60.0), ("1 to 10 min", 600.0), ("10 to 60 min", 3600.0)):
        if seconds < end:
            return text
    return "above an hour"


def _fault_text(report: Mapping[str, Any]) -> str:
    faults = report.get("faults")
    if faults is None:
        return ""
    return ", ".join(sorted({f["kind"] for f in faults})) or "none"


def _estimators(drives: Iterable[FleetDrive]) -> list[str]:
    """Return the estimators with an error in the judged signal, the most frequent first."""
    counts = Counter(e for d in drives for e, s in d.errors if s == JUDGED)
    return sorted(counts, key=lambda e: (-counts[e], e))


def _of_all(drives: Sequence[FleetDrive], use: BoolArray) -> dict[str, list[str | None]]:
    """Return day, car and route of the drives to use."""
    return {f: [d.factors.get(f) for d, used in zip(drives, use, strict=True) if used] for f in FACTORS}


def _dependence(drives: Sequence[FleetDrive]) -> Dependence:
    """Return the dependence of the selected estimate's errors."""
    errors = np.array([d.error() for d in drives])
    use = errors > 0.0
    return dependence(np.log(errors[use]), _of_all(drives, use))


def _median(change: PairedChange) -> Median:
    return Median(change.median, change.low, change.high)


def _distributions(drives: Sequence[FleetDrive], names: Sequence[str]) -> Iterable[Distribution]:
    for signal, unit in SIGNALS.items():
        for name in (ANSWER, *names):
            values = np.array([d.error(name, signal) for d in drives])
            use = np.isfinite(values)
            if use.any():
                median = _median(paired_change(values[use], None, _of_all(drives, use)))
                yield Distribution(name, signal, unit, median, np.sort(values[use]))


def _ranking(drives: Sequence[FleetDrive], names: Sequence[str]) -> list[Rank]:
    """Return the estimators in order of how many others they beat, pair by pair on the drives of both."""
    errors = {name: np.array([d.error(name) for d in drives]) for name in (ANSWER, *names)}

    def change(a: str, b: str) -> PairedChange:
        both = np.isfinite(errors[a]) & np.isfinite(errors[b])
        return paired_change(log_ratios(errors[a][both], errors[b][both]), None, _of_all(drives, both))

    pairs = [*combinations(names, 2)]
    changes = [change(a, b) for a, b in pairs]
    beats: dict[str, set[str]] = {name: set() for name in names}
    for (a, b), of_pair, p in zip(pairs, changes, holm([c.sign_p for c in changes]), strict=True):
        if p < SIGNIFICANT and of_pair.median != 0.0:
            better, worse = (a, b) if of_pair.median > 0.0 else (b, a)
            beats[better].add(worse)
    lost = {name: {other for other in names if name in beats[other]} for name in names}
    medians = {name: float(np.nanmedian(errors[name])) for name in names}
    order = sorted(names, key=lambda n: (len(lost[n]) - len(beats[n]), medians[n], n))
    mains = {d.main for d in drives}
    return [
        Rank(
            # Equal places where no difference is significant, and none where this is true of all.
            place=1 + sum(len(lost[o]) - len(beats[o]) < len(lost[name]) - len(beats[name]) for o in names)
            if any(beats.values())
            else None,
            estimator=name,
            drives=int(np.isfinite(errors[name]).sum()),
            better_than=tuple(n for n in order if n in beats[name]),
            against_answer=None if mains == {name} else _share(_median(change(ANSWER, name))),
        )
        for name in order
    ]


def _share(of_logs: Median) -> Median:
    return Median(*(math.expm1(x) for x in (of_logs.value, of_logs.low, of_logs.high)))


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
