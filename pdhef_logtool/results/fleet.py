"""The figures of a whole run: errors over drives, the order of estimators, effects of conditions, and coverage.

They come from the tables of the run: a few figures of each drive are in memory, never a series.
Scores use drives with ground truth that is independent of the estimator; other drives are listed separately.
Intervals take the dependence of drives of one day, car or route into account.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pdhef_logtool.evaluation import statistics
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.signals import BoolArray, FloatArray
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
_PLACE = re.compile(r"\s*\([^()]*\)\s*$")
_NUMBER = re.compile(r"\d+(\.\d+)?")


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


#: Its fields that are in the table of drives.
_OF_ROW = ("label", "seconds", "main", "truth", "unscored", "coverage", "nis", "d2", "naive_d2", "failed_checks")


@dataclass(frozen=True, slots=True)
class Distribution:
    """Errors of one estimator in one signal over drives: ``values`` ascending, in ``unit``."""

    estimator: str
    signal: str
    unit: str
    median: statistics.Bounded
    values: FloatArray


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
    against_answer: statistics.Bounded | None


@dataclass(frozen=True, slots=True)
class Failures:
    """Logs with the same failure: ``reason`` of the first, ``count``, and the first :data:`NAMED` ``labels``."""

    reason: str
    count: int
    labels: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Seconds and RMSE of sideslip in rad by cell of speed and |a_y|, [speeds, accelerations]; NaN: not scored.

    The cells begin at the edges of :mod:`~pdhef_logtool.evaluation.operating_space`.
    """

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
    breakdowns: "tuple[Breakdown, ...]"
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
        FleetDrive(
            **{key: r[key] for key in _OF_ROW},
            errors=dict(of_log.get(r["label"], ())),
            keys=dict(metadata.get(r["label"], ())) | _keys(r, kinds.get(r["label"])),
            factors={factor: r[factor] for factor in statistics.FACTORS},
        )
        for r in done
    )
    errors = np.array([d.error() for d in drives])
    scored, use = [d for d in drives if d.truth], errors > 0.0
    counts = Counter(e for d in scored for e, s in d.errors if s == JUDGED)
    names = sorted(counts, key=lambda e: (-counts[e], e))  # the most frequent first
    return Fleet(
        logs=len(rows),
        drives=drives,
        distributions=tuple(_distributions(scored, names)),
        ranking=tuple(_ranking(scored, names)) if len(scored) >= least_to_rank(len(names)) else (),
        least_to_rank=least_to_rank(len(names)),
        dependence=statistics.dependence(np.log(errors[use]), _of_all(drives, use)),
        breakdowns=breakdowns(errors, [d.keys for d in drives], _of_all(drives), by),
        space=_space(run),
        failed=grouped([(r["label"], r["reason"]) for r in rows if r["outcome"] == "failed"]),
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
    return Space(seconds, rmse, drives)


def sideslip_errors(run: OpenedRun, signals: Sequence[str] = (JUDGED,)) -> pl.LazyFrame:
    """Return the RMSE of drives, where the ground truth is independent: log, estimator, signal and value."""
    there = pl.col("independent") & pl.col("value").is_finite() & pl.col("signal").is_in(signals)
    return (
        run.table("metrics").filter(there, segment="all", metric="rmse").select("log", "estimator", "signal", "value")
    )


def _rows(run: OpenedRun) -> list[dict[str, Any]]:
    """Return the table of drives with fields of :class:`FleetDrive`; unknown figures are NaN, unknown texts empty."""

    def value(metric: str) -> pl.Expr:
        return pl.col("value").filter(pl.col("metric") == metric).first()

    metrics = run.table("metrics").filter(pl.col("metric").is_in(["nis", "nis_dof", "d2"]), segment="all")
    checks = metrics.group_by("log", "estimator").agg(nis=value("nis") / value("nis_dof"), d2=value("d2"))
    naive = checks.filter(estimator=NAIVE).select("log", naive_d2="d2")
    drives = run.table("drives").with_row_index("place").join(checks, on=["log", "estimator"], how="left")
    fields = {"label": "log", "main": "estimator", "coverage": "sideslip_coverage95"}
    named = drives.join(naive, on="log", how="left").sort("place").with_columns(**fields)
    scored = pl.col("sideslip_rmse_rad").is_not_null()
    unknown = pl.col("coverage", "nis", "d2", "naive_d2").fill_null(math.nan), pl.col("main", "unscored").fill_null("")
    return named.with_columns(*unknown, truth=scored).collect().to_dicts()


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


def _of_all(drives: Sequence[FleetDrive], use: BoolArray | None = None) -> dict[str, list[str | None]]:
    """Return day, car and route of the drives to use (None: all)."""
    used = drives if use is None else [drives[i] for i in np.flatnonzero(use).tolist()]
    return {f: [d.factors.get(f) for d in used] for f in statistics.FACTORS}


def _median(change: statistics.PairedChange, scale: Callable[[float], float] = float) -> statistics.Bounded:
    return statistics.Bounded(scale(change.median), scale(change.low), scale(change.high), change.drives)


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


def grouped(failures: Sequence[tuple[str, str]]) -> tuple[Failures, ...]:
    """Return reasons with their logs, the most frequent first; numbers and places do not distinguish reasons."""
    members: dict[str, tuple[str, dict[str, None]]] = {}
    for label, reason in failures:
        _, expected, rest = reason.partition(": expected ")
        text = f"expected {rest}" if expected else _PLACE.sub("", reason)
        members.setdefault(_NUMBER.sub("", text), (text, {}))[1][label] = None
    groups = [Failures(text, len(labels), tuple(labels)[:NAMED]) for text, labels in members.values()]
    return tuple(sorted(groups, key=lambda g: (-g.count, g.reason))[:_MOST_GROUPS])


#: Values of drives [N], None where unknown.
_Texts: TypeAlias = NDArray[np.object_]

#: Scored drives on each side of a comparison, at least.
LEAST_DRIVES = 5
#: Family-wise error rate.
SIGNIFICANT = 0.05
#: Values of a key that are listed one by one.
MOST_VALUES = 12
#: Log ratios above are shown as this one.
_LARGEST_LOG = 20.0


@dataclass(frozen=True, slots=True)
class Effect:
    """Ratio of the errors of a group and of the other drives, less 1, with its interval and corrected p-value."""

    share: float
    low: float
    high: float
    p: float

    @property
    def significant(self) -> bool:
        """Whether the interval excludes 0."""
        return self.p < SIGNIFICANT


@dataclass(frozen=True, slots=True)
class Group:
    """Drives with one value of a key; ``effect`` None with the reason in ``why_not``."""

    value: str
    drives: int
    scored: int
    mean_rad: float
    worst_rad: float
    effect: Effect | None
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Breakdown:
    """The drives by a key; ``also``: other keys that separate the scored drives in the same way."""

    key: str
    groups: tuple[Group, ...]
    also: tuple[str, ...] = ()

    @property
    def p(self) -> float:
        """The smallest corrected p-value; infinite without a comparison."""
        return min((g.effect.p for g in self.groups if g.effect is not None), default=math.inf)

    @property
    def comparisons(self) -> int:
        """Number of independent comparisons: two groups are compared once."""
        count = sum(g.effect is not None for g in self.groups)
        return 1 if count == 2 and len(self.groups) == 2 else count


@dataclass(frozen=True, slots=True)
class _Test:
    """A comparison before correction: difference of mean logs, its standard error, and degrees of freedom."""

    difference: float
    error: float
    freedom: float

    @property
    def p(self) -> float:
        from scipy.special import ndtr, stdtr

        if self.error == 0.0:
            return 1.0 if self.difference == 0.0 else 0.0
        t = -abs(self.difference) / self.error
        return 2.0 * float(ndtr(t) if math.isinf(self.freedom) else stdtr(self.freedom, t))

    def effect(self, p: float, level: float, sign: float = 1.0) -> Effect:
        """Return it with a corrected p-value, and the interval at a level (0.05: 95 %); ``sign`` -1: other group."""
        width, difference = statistics.deviate(1.0 - 0.5 * level, self.freedom) * self.error, sign * self.difference
        low, high = difference - width, min(difference + width, _LARGEST_LOG)
        return Effect(math.expm1(difference), math.expm1(low), math.expm1(high), p)


def breakdowns(
    errors: FloatArray, keys: Sequence[Mapping[str, str]], factors: statistics.Factors, by: Sequence[str] = ()
) -> tuple[Breakdown, ...]:
    """Return drives by each key that separates them, the strongest evidence first.

    Parameters
    ----------
    errors : of the selected estimate [N] in rad, NaN: not scored. keys, factors : of the drives [N].
    by : names of keys, in order; none: all that separate drives.
    """
    columns = {key: _values([of.get(key) for of in keys]) for key in by or dict.fromkeys(k for of in keys for k in of)}
    also: dict[str, tuple[str, ...]] = dict.fromkeys(columns, ())
    if not by:
        most = min(MOST_VALUES, len(keys) - 1)
        also = _alike(errors, {key: of for key, of in columns.items() if 2 <= len({*of} - {None}) <= most})
    drives = {name: np.array(of, dtype=object) for name, of in factors.items()}
    tests = {key: _tests(key, errors, columns[key], drives) for key in also}
    effects = _corrected(tests)
    rows = [Breakdown(key, _groups(errors, columns[key], effects[key]), others) for key, others in also.items()]
    return tuple(rows if by else sorted(rows, key=lambda b: (b.p, b.key)))


def _alike(errors: FloatArray, columns: Mapping[str, _Texts]) -> dict[str, tuple[str, ...]]:
    """Return for the first key of each way to separate the scored drives the other keys that do the same."""
    first: dict[bytes, list[str]] = {}
    for key in sorted(columns, key=lambda key: (key not in statistics.FACTORS, key)):
        part = statistics.numbered([value or "" for value in columns[key][errors > 0.0]])
        first.setdefault(part.tobytes(), []).append(key)
    return {key: tuple(others) for key, *others in first.values()}


def _tests(key: str, errors: FloatArray, values: _Texts, drives: Mapping[str, _Texts]) -> dict[str, _Test | str]:
    """Return the comparison of each value with the other drives, or the reason why it is impossible."""
    use = (errors > 0.0) & np.array([v is not None for v in values], dtype=np.bool_)
    logs, names = np.log(errors[use]), values[use]
    part = statistics.numbered(names)
    factors = {
        name: of[use]
        for name, of in drives.items()
        if key != name and not np.array_equal(statistics.numbered(of[use]), part) and len({*filter(None, of[use])}) > 1
    }
    return {value: _test(logs, names == value, factors) for value in dict.fromkeys(values) if value is not None}


def _test(logs: FloatArray, inside: BoolArray, factors: Mapping[str, _Texts]) -> _Test | str:
    scores, weights = np.zeros(len(logs)), np.zeros(len(logs))
    means, variances, freedoms = [], [], []
    for side, sign in ((inside, 1.0), (~inside, -1.0)):
        n = int(np.count_nonzero(side))
        if n < LEAST_DRIVES:
            other = "" if side is inside else " with another value"
            return f"{n} scored drives{other}, at least {LEAST_DRIVES} are needed"
        for name, of in factors.items():
            values = {*of[side]}
            if len(values) == 1 and None not in values:
                where = "its drives" if side is inside else "the other drives"
                return f"{where} are all of one {name}: the two cannot be separated"
        spread = float(logs[side].std(ddof=1))
        means.append(float(logs[side].mean()))
        scores[side] = (logs[side] - means[-1]) / (spread or 1.0)
        weights[side] = sign * spread / n
        variances.append(spread**2 / n)
        freedoms.append(n - 1.0)
    variance = sum(variances)
    if variance == 0.0:
        return _Test(means[0] - means[1], 0.0, math.inf)
    drives = statistics.dependence(scores, factors, weights)
    uncertain = sum(v**2 / f for v, f in zip(variances, freedoms, strict=True)) / variance**2
    freedom = 1.0 / (uncertain + (0.0 if math.isinf(drives.freedom) else 1.0 / drives.freedom))
    return _Test(means[0] - means[1], math.sqrt(variance * drives.design_effect), freedom)


def _corrected(tests: Mapping[str, Mapping[str, _Test | str]]) -> dict[str, dict[str, Effect | str]]:
    """Return effects with Holm's p-values, and intervals at the level of the same step, by key and value."""
    results: dict[str, dict[str, Effect | str]] = {key: {} for key in tests}
    once: list[tuple[_Test, str, list[str]]] = []
    for key, of_key in tests.items():
        results[key] |= {value: test for value, test in of_key.items() if isinstance(test, str)}
        made = {value: test for value, test in of_key.items() if isinstance(test, _Test)}
        if len(made) == len(of_key) == 2:  # the two values of a key are one comparison, with opposite signs
            once.append((next(iter(made.values())), key, [*made]))
        else:
            once += [(test, key, [value]) for value, test in made.items()]
    raw = [test.p for test, _, _ in once]
    steps = len(raw)
    for p, corrected, (test, key, values) in sorted(
        zip(raw, statistics.holm(raw), once, strict=True), key=lambda row: row[0]
    ):
        for value, sign in zip(values, (1.0, -1.0), strict=False):
            results[key][value] = test.effect(corrected, SIGNIFICANT / steps, sign)
        steps -= p <= SIGNIFICANT / steps and corrected < SIGNIFICANT
    return results


def _groups(errors: FloatArray, values: _Texts, effects: Mapping[str, Effect | str]) -> tuple[Group, ...]:
    groups = []
    for value in sorted({*values}, key=_in_order):
        inside = np.equal(values, value)
        scored = errors[inside & (errors >= 0.0)]
        effect = effects.get(value, "")
        mean = float(np.exp(np.mean(np.log(scored)))) if scored.size and scored.min() > 0.0 else math.nan
        worst = float(scored.max()) if scored.size else math.nan
        shown, why_not = (effect, "") if isinstance(effect, Effect) else (None, effect)
        name, drives = "not given" if value is None else value, int(np.count_nonzero(inside))
        groups.append(Group(name, drives, len(scored), mean, worst, shown, why_not))
    return tuple(groups)


def _values(texts: Sequence[str | None]) -> _Texts:
    """Return the value of each drive [N]: its text, or that it is rare; None without one."""
    counts = Counter(t for t in texts if t is not None)
    rare = {value for value, _ in counts.most_common()[MOST_VALUES:]}
    return np.array([f"{len(rare)} others" if t in rare else t for t in texts], dtype=object)


def _in_order(value: str | None) -> tuple[bool, bool, float, str]:
    """Return the place of a value: numbers in order, then texts, then None."""
    text = value or ""
    try:
        number = float(text.partition(" to ")[0])
    except ValueError:
        number = math.nan
    return value is None, math.isnan(number), 0.0 if math.isnan(number) else number, text


#: Number of drives with the largest errors in the summary.
_IN_SUMMARY = 10


def summarise(run: OpenedRun, exit_code: int) -> dict[str, Any]:
    """Return the summary of a run as one JSON-able document; its drives are one by one in run.json.

    Logs with figures are ``done``, with a scored selected estimate ``scored``; errors need independent ground truth.

    Raises
    ------
    OutputError : A table is damaged.
    """
    drives = run.table("drives").collect()
    scored = drives.drop_nulls("sideslip_rmse_rad").sort("sideslip_rmse_rad", "log", descending=[True, False])
    errors, failed = sideslip_errors(run).select("log", "estimator", "value").collect(), drives.filter(outcome="failed")
    selected, every, value = set(scored["estimator"]), errors, pl.col("value")
    if len(selected) > 1:
        answers = scored.select("log", estimator=pl.lit(ANSWER), value="sideslip_rmse_rad")
        selected, every = {ANSWER}, pl.concat([answers, errors])
    figures = {"median_rad": value.median(), "p90_rad": value.quantile(0.9, "linear"), "max_rad": value.max()}
    by_name = every.group_by("estimator", maintain_order=True).agg(drives=pl.len(), **figures).to_dicts()
    worst = scored.head(_IN_SUMMARY).select("log", "estimator").rows()
    return {
        "output": str(run.place),
        "exit_code": exit_code,
        "logs": len(drives),
        "done": len(drives) - len(failed),
        "lost": len(drives.filter(outcome="lost")),
        "scored": len(scored),
        "remaining": int(run.document.get("remaining", 0)),
        "errors": sorted(by_name, key=lambda of: of["estimator"] not in selected),
        "worst": [
            {"log": log, "main": main, "errors_rad": dict(errors.filter(log=log).select("estimator", "value").rows())}
            for log, main in worst
        ],
        "failed": [asdict(f) for f in grouped(failed.select("log", "reason").rows())],
        "checks_failed": drives.filter(drives["failed_checks"] > 0)["log"].to_list(),
        "plan": run.document.get("plan"),
    }
