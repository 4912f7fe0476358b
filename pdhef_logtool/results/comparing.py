"""Comparison of finished runs: changed figures of the drives that two runs share, the gate, and the history of several.

A compared figure is a requirement on run B with run A as the baseline. Figures are read from the tables of the runs.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl

from pdhef_logtool.evaluation import statistics
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.evaluation.metrics.sensors import SENSORS
from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.statistics import LEAST_CLUSTERS
from pdhef_logtool.evaluation.units import SIGNALS, share_of
from pdhef_logtool.evaluation.validation_plan import MEANS, RUN, SQUARES, Requirement, ValidationPlan, load_plan, shown
from pdhef_logtool.records.errors import EXIT_GATE, EXIT_OK, EXIT_PARTIAL, OutputError, UsageError
from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.junit import junit_bytes
from pdhef_logtool.results.opened_run import OpenedRun, open_run, table_file
from pdhef_logtool.results.pairing import Pair, pair_logs, run_differences
from pdhef_logtool.results.plan_verdicts import PlanVerdicts, plan_verdicts_against
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.documents import unknown
from pdhef_logtool.storage.templates import clauses, one_line, template

#: ``no figure``: no drive has it on both sides.
FigureVerdict: TypeAlias = statistics.Verdict | Literal["no figure"]

#: Value of ``cluster`` for drives that do not depend on one another.
INDEPENDENT = "none"
#: Name in documents for the selected estimate of each drive in A.
MAIN = "main"
#: Verdicts from grave to harmless; the gravest one is the overall verdict.
_GRAVITY: tuple[FigureVerdict, ...] = ("worse", "no figure", "inconclusive", "not worse", "better", "equal")
_FIGURE = ("estimator", "signal", "segment", "metric", "unit")


def figure(
    signal: str = "sideslip_rad",
    metric: str = "rmse",
    segment: str = "all",
    estimator: str | None = None,
    limit: float | None = None,
) -> Requirement:
    """Return the requirement that a figure rises by at most a share ``limit`` (0.05; None: any) above run A.

    ``estimator``: a name on both sides; None: the selected estimate of each drive in A.
    """
    ratio = None if limit is None else 1.0 + limit
    return Requirement("", "", signal, metric, estimator, segment, baseline=RUN, max_ratio=ratio, confidence=0.9)


def _entries(record: object, *names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """One figure over all drives.

    Attributes
    ----------
    drives : those with the figure on both sides, largest worsening first: names ``drive`` and ``drive_b``, values ``a``
        and ``b`` in ``unit`` (as in metrics.parquet), stamps ``n_a`` and ``n_b``, ``change`` b / a - 1 (None: a is 0).
    only_a, only_b : drives of both runs that have it on one side. neither : how many have it on none.
    notes : reservations.
    corrected_p : sign test, corrected for all figures that are shown beside those asked for; None for those.
    """

    requirement: Requirement
    verdict: FigureVerdict
    change: statistics.PairedChange
    unit: str
    drives: tuple[dict[str, Any], ...]
    only_a: tuple[str, ...] = ()
    only_b: tuple[str, ...] = ()
    neither: int = 0
    notes: tuple[str, ...] = ()
    corrected_p: float | None = None

    @property
    def limit(self) -> float | None:
        """The accepted increase (0.05 is 5 %), None without one."""
        ratio = self.requirement.max_ratio
        return None if ratio is None else round(ratio - 1.0, 12)

    @property
    def detectable(self) -> float:
        """The smallest worsening (a share) that would have been found in 80 % of all cases; NaN: unknown."""
        return self.change.detectable(self.limit or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values; changes are shares: 0.05 is 5 % more."""
        change, asked = self.change, self.requirement
        return {
            **_entries(asked, "signal", "metric", "segment"),
            "estimator": asked.estimator or MAIN,
            **_entries(self, "limit", "unit", "verdict"),
            **_entries(change, "drives", "clusters"),
            "design_effect": change.dependence.design_effect,
            "dependence": change.dependence.by,
            **{k: math.expm1(getattr(change, k)) for k in ("median", "low", "high", "least", "most")},
            "sign_p": change.sign_p,
            **_entries(self, "detectable", "corrected_p", "only_a", "only_b", "neither", "notes"),
            "of_drives": self.drives,
        }


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """A run of a history.

    ``requirement``: the first compared figure. ``figure``: over all drives of the run, in ``unit``. ``step``: its
    change from the run before; None for the first run, or if nothing changed. ``verdict``: of the step, else empty.
    """

    run: str
    version: str
    requirement: Requirement
    figure: statistics.Bounded
    unit: str
    verdict: FigureVerdict | Literal[""] = ""
    step: ComparedFigure | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values; ``change``: share with its 95 % interval."""
        step = {} if self.step is None else self.step.to_dict()
        unchanged = 0.0 if self.verdict == "equal" else None
        return {
            **_entries(self, "run", "version", "unit", "verdict"),
            "drives": self.figure.units,
            **_entries(self.figure, "value", "low", "high"),
            "change": [step.get(key, unchanged) for key in ("median", "low", "high")],
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """Run B against run A.

    Attributes
    ----------
    a, b : the folders. pairs : number of drives in both, by the way they were paired. only_a, only_b : other drives.
    differences : other causes of changed figures, a line each. changed : drives with any figure that is not the
        same bit for bit.
    figures : requested, or of the gate. others : shown beside them; empty if all are equal.
    gated, allow_unpaired, strict : rules of the gate. requirements : verdicts of a validation plan on B.
    history : all runs, if there are more than two; A and B are then the last two.
    """

    a: str
    b: str
    pairs: Mapping[str, int]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    differences: tuple[str, ...]
    changed: int
    figures: tuple[ComparedFigure, ...] = ()
    others: tuple[ComparedFigure, ...] = ()
    cluster: str | None = None
    gated: bool = False
    allow_unpaired: bool = False
    strict: bool = False
    requirements: PlanVerdicts | None = None
    history: tuple[HistoryRow, ...] = ()

    @property
    def equal(self) -> bool:
        """Whether all figures of all pairs are the same bit for bit."""
        return self.changed == 0

    @property
    def verdict(self) -> FigureVerdict:
        """The worst verdict of the figures."""
        return min((f.verdict for f in self.figures), key=_GRAVITY.index, default="equal")

    @property
    def unpaired(self) -> tuple[str, ...]:
        """Drives and figures on one side only, a line per side and figure."""
        sides = [("drives", "", self.only_a, self.only_b)]
        sides += [("figures", f": {f.requirement.name}", f.only_a, f.only_b) for f in self.figures]
        return tuple(
            f"{what} in {side} only{label}: {listed(names)}"
            for what, label, a, b in sides
            for side, names in (("A", a), ("B", b))
            if names
        )

    @property
    def failures(self) -> tuple[str, ...]:
        """Reasons why the gate is closed, a line each; empty without a gate or if it is open."""
        verdicts = [(f.requirement.name, f.verdict) for f in self.figures]
        reasons = []
        if self.gated:
            reasons += [f"{name}: {verdict}" for name, verdict in verdicts if verdict in ("worse", "no figure")]
            reasons += () if self.allow_unpaired else self.unpaired
        if self.strict and self.requirements is None:
            refused = ("inconclusive",) if self.gated else ("inconclusive", "no figure")
            reasons += [f"{name}: {v}, which --strict refuses" for name, v in verdicts if v in refused]
        return tuple(reasons)

    @property
    def exit_code(self) -> int:
        """4 where the gate is closed, 3 for drives without partner and no gate, else 0."""
        if self.failures or (self.requirements is not None and self.requirements.closing):
            return EXIT_GATE
        return EXIT_PARTIAL if self.unpaired and not self.gated and not self.allow_unpaired else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as one JSON-able document."""
        return {
            "format": "pdhef.comparison",
            "version": 2,
            **_entries(self, "a", "b", "verdict", "exit_code", "failures"),
            "plan": None if self.requirements is None else self.requirements.to_dict(),
            "differences": self.differences,
            "pairs": dict(self.pairs),
            **_entries(self, "only_a", "only_b", "changed", "cluster"),
            **{key: [f.to_dict() for f in getattr(self, key)] for key in ("figures", "others", "history")},
        }


def compare(
    a: Path | str,
    b: Path | str,
    *later: Path | str,
    plan: Path | str | None = None,
    max_regression: str | None = None,
    estimator: str | None = None,
    metric: str | None = None,
    cluster: str | None = None,
    allow_unpaired: bool = False,
    strict: bool = False,
) -> Comparison:
    """Compare the outputs of runs, folders or URLs, as ``pdhef compare`` does with options of these names.

    With more than two runs, oldest first, the result compares the last two and has a history of all.

    Raises
    ------
    UsageError : The plan is wrong, or an option.
    OutputError : One of them is no finished run, or damaged; or no drive is in both.
    """
    validation = None if plan is None else load_plan(Path(plan))
    figures = _asked(validation, max_regression, estimator, metric)
    runs = [open_run(run) for run in (a, b, *later)]
    *_, run_a, run_b = runs
    result = compare_runs(run_a, run_b, figures, allow_unpaired=allow_unpaired, cluster=cluster, strict=strict)
    if later:
        earlier = [compare_runs(x, y, figures[:1], cluster=cluster, alone=True) for x, y in pairwise(runs[:-1])]
        result = replace(result, history=tuple(_history(runs, [*earlier, result], figures[0])))
    if validation is None:
        return result
    return replace(result, requirements=plan_verdicts_against(validation, run_a, run_b, strict=strict))


def _asked(
    plan: ValidationPlan | None, max_regression: str | None, estimator: str | None, metric: str | None
) -> tuple[Requirement, ...]:
    """Return the figures to compare by, with their limits, from the options; raises UsageError."""
    compared = [name for name, m in registered().items() if m.best == "lower"]
    if plan is not None:
        single = {"--max-regression": max_regression, "--estimator": estimator, "--metric": metric}
        if given := [name for name, value in single.items() if value is not None]:
            raise UsageError(expected=f"--plan or {given[0]}", got="both", where="--plan")
        asked = [figure(r.signal, r.metric, r.segment, r.estimator) for r in plan.requirements if r.metric in compared]
        return tuple(dict.fromkeys(asked)) or (figure(),)
    limit = None if max_regression is None else share_of(max_regression)
    if max_regression is not None and limit is None:
        raise UsageError(expected="a share such as 5% or 0.05", got=max_regression, where="--max-regression")
    if metric not in (None, *compared):
        got = f"metric = {unknown(str(metric), compared)}"
        raise UsageError(expected="a figure; lower is better", got=got, where="--metric")
    return (figure(metric=metric or "rmse", estimator=estimator, limit=limit),)


def compare_runs(
    a: OpenedRun,
    b: OpenedRun,
    figures: Sequence[Requirement],
    *,
    allow_unpaired: bool = False,
    cluster: str | None = None,
    strict: bool = False,
    alone: bool = False,
) -> Comparison:
    """Compare two runs.

    Parameters
    ----------
    figures : to compare by (:func:`figure`); those without a limit are no gate. alone : no other figures.
    allow_unpaired : accept drives on one side only.
    cluster : ``car``, ``day``, ``route`` or a key of the logs' metadata by which drives depend on one another;
        ``none``: independent drives; None: the dependence by day, car and route is estimated.
    strict : an inconclusive figure closes the gate.

    Raises
    ------
    OutputError : No drive is in both runs, or the figures of a run are damaged.
    UsageError : No drive has the estimator, or the key.
    """
    pairs, only_a, only_b = pair_logs(a.logs, b.logs)
    if not pairs:
        raise OutputError(
            expected="a drive that is in both runs",
            got=f"none of {len(a.logs)} and {len(b.logs)} by signals, content or name",
            where=f"{a.place} and {b.place}",
            remedy="run both on the same drives",
        )
    tables = _Tables(a, b, pairs, cluster)
    gated, changed = any(f.max_ratio is not None for f in figures), tables.changed()
    compared = tuple(tables.compared(figures)) if changed or gated else ()
    tables.check_estimators(compared)
    return Comparison(
        a=a.place,
        b=b.place,
        pairs=Counter(pair.by for pair in pairs),
        only_a=tuple(log.label for log in only_a),
        only_b=tuple(log.label for log in only_b),
        differences=run_differences(a, b, pairs),
        changed=changed,
        figures=compared,
        others=_corrected(tables.compared(_beside(figures))) if changed and not alone else (),
        cluster=cluster,
        gated=gated,
        allow_unpaired=allow_unpaired,
        strict=strict,
    )


class _Tables:
    """Figures of two runs for their pairs; only requested rows are read."""

    def __init__(self, a: OpenedRun, b: OpenedRun, pairs: Sequence[Pair], cluster: str | None) -> None:
        labels = {"a": [p.a.label for p in pairs], "b": [p.b.label for p in pairs], "main": [p.a.main() for p in pairs]}
        self._runs, self._cluster = (a, b), cluster
        self._labels = pl.DataFrame(labels).with_row_index("place")

    @cached_property
    def _pairs(self) -> pl.DataFrame:
        """A row per pair: ``place``, labels ``a`` and ``b``, ``main``, day, car and route, and ``cluster``."""
        run, key = self._runs[0], self._cluster
        drives = run.table("drives").select("log", *statistics.FACTORS).collect()
        pairs = self._labels.join(drives, left_on="a", right_on="log", how="left").sort("place")
        if key in (None, INDEPENDENT):
            return pairs
        metadata = pairs.select(log="a").join(run.table("metadata").collect(), on="log")
        stated = metadata.filter(key=key).select(a="log", cluster="value").unique("a", keep="last")
        keyed = pairs.join(stated, on="a", how="left").sort("place")
        if key in statistics.FACTORS:
            keyed = pairs.with_columns(cluster=pl.col(str(key)))
        if keyed["cluster"].null_count() == len(keyed):
            names = ", ".join(dict.fromkeys((*statistics.FACTORS, INDEPENDENT, *metadata["key"].unique().sort())))
            raise UsageError(expected=f"a key of the drives: {names}", got=str(key), where="--cluster")
        return keyed

    def changed(self) -> int:
        """Return the number of drives with any figure that is not the same bit for bit."""
        tables = [run.table("metrics") for run in self._runs]
        digests = {run.document.get("files", {}).get(table_file("metrics")) for run in self._runs}
        if len(digests) == 1 and None not in digests and self._labels["a"].equals(self._labels["b"]):
            return 0
        hashed = (rows.select("log", row=pl.struct(*_FIGURE, "value", "n").hash()) for rows in tables)
        sums = (rows.group_by("log").agg(pl.col("row").sum(), pl.len()) for rows in hashed)
        a, b = (rows.collect(engine="streaming") for rows in sums)
        both = self._labels.join(a, left_on="a", right_on="log", how="left")
        both = both.join(b, left_on="b", right_on="log", how="left", suffix="_b")
        differs = pl.col("row").ne_missing(pl.col("row_b")) | pl.col("len").ne_missing(pl.col("len_b"))
        return len(both.filter(differs))

    def compared(self, figures: Sequence[Requirement]) -> list[ComparedFigure]:
        """Return figures over all pairs; only their rows are read."""
        rows = self._rows(figures)
        return [self._compared(figure, rows) for figure in figures]

    def _rows(self, figures: Sequence[Requirement]) -> pl.DataFrame:
        """Return the figures of the pairs, a row each: ``value``, ``n``, ``independent`` of A, and with ``_b`` of B."""
        named = {f.estimator for f in figures if f.estimator} | set(self._pairs["main"])
        asked = [named, *({getattr(f, key) for f in figures} for key in _FIGURE[1:-1])]
        wanted = [pl.col(key).is_in(sorted(of)) for key, of in zip(_FIGURE, asked, strict=False)]
        a, b = (
            self._pairs.select("place", log=side)
            .join(run.table("metrics").filter(pl.col("value").is_finite(), *wanted).collect(), on="log")
            .drop("log", "algorithm")
            for side, run in zip("ab", self._runs, strict=True)
        )
        both = a.join(b, on=["place", *_FIGURE], how="full", coalesce=True, suffix="_b")
        return both.join(self._pairs, on="place", how="left").sort("place")

    def _compared(self, asked: Requirement, rows: pl.DataFrame) -> ComparedFigure:
        name = pl.col("main") if asked.estimator is None else pl.lit(asked.estimator)
        of_figure = {key: getattr(asked, key) for key in ("signal", "segment", "metric")}
        of_pairs = rows.filter(pl.col("estimator") == name, **of_figure)
        both = of_pairs.drop_nulls(["value", "value_b"])
        ratios = statistics.log_ratios(both["value"].to_numpy(), both["value_b"].to_numpy())
        clusters = both["cluster"].to_list() if "cluster" in both.columns else None
        factors = {f: both[f].to_list() for f in statistics.FACTORS} if self._cluster is None else None
        change = statistics.paired_change(ratios, clusters, factors)
        equal = both["value"].equals(both["value_b"]) and both["n"].equals(both["n_b"])
        verdict = change.verdict((asked.max_ratio or 1.0) - 1.0) if not equal else "equal" if len(both) else "no figure"
        drives = both.select(drive="a", drive_b="b", a="value", b="value_b", n_a="n", n_b="n_b")
        share = pl.when(pl.col("a") != 0.0).then(pl.col("b") / pl.col("a") - 1.0)
        return ComparedFigure(
            asked,
            verdict,
            change,
            unit=both["unit"][0] if len(both) else "",
            drives=tuple(drives.with_columns(change=share)[np.argsort(-ratios, kind="stable")].to_dicts()),
            only_a=tuple(of_pairs.filter(pl.col("value_b").is_null())["a"]),
            only_b=tuple(of_pairs.filter(pl.col("value").is_null())["a"]),
            neither=len(self._pairs) - len(of_pairs),
            notes=tuple(_notes(both)),
        )

    def check_estimators(self, figures: Sequence[ComparedFigure]) -> None:
        """Raise UsageError for an estimator that no drive of either run has, and for runs without a selected one."""
        missing = {f.requirement.estimator or "" for f in figures if f.verdict == "no figure"}
        missing -= {""} if any(self._labels["main"]) else set()
        if not missing:
            return
        frames = [run.table("metrics").select("estimator").unique().collect(engine="streaming") for run in self._runs]
        estimators = {name for frame in frames for name in frame["estimator"]}
        for name in sorted(missing - estimators):
            single = sorted(k for k in estimators if "~" not in k and k != SENSORS)
            got = name or "none named, and none that is selected"
            raise UsageError(expected=f"an estimator of these runs: {', '.join(single)}", got=got, where="--estimator")


def _notes(both: pl.DataFrame) -> Iterator[str]:
    other = both.filter(both["n"] != both["n_b"])
    if len(other):
        share = int(both["n_b"].sum()) / max(int(both["n"].sum()), 1) - 1.0
        yield f"other stamps are scored in {len(other)} of {len(both)} drives, {share:+.2%} in all"
    if tainted := len(both) - int((both["independent"] & both["independent_b"]).sum()):
        yield f"in {tainted} of {len(both)} drives the ground truth is one of the estimator's inputs"


def _beside(asked: Sequence[Requirement]) -> list[Requirement]:
    """Return the figures shown beside those asked for: RMSE by signal and segment, and the other columns of tables."""
    of_tables = [
        (signal, metric.name)
        for metric in registered().values()
        for signal in dict.fromkeys((*metric.terminal, *metric.brief))
        if metric.best == "lower"
    ]
    errors = [(signal, "rmse") for signal in SIGNALS if signal != "state"]
    figures = [
        *(figure(*of, estimator=asked[0].estimator) for of in dict.fromkeys([*errors, *of_tables])),
        *(figure(segment=segment, estimator=asked[0].estimator) for segment in SEGMENTS if segment != "all"),
    ]
    keys = {(f.signal, f.metric, f.segment) for f in asked}
    return [f for f in figures if (f.signal, f.metric, f.segment) not in keys]


def _corrected(figures: Sequence[ComparedFigure]) -> tuple[ComparedFigure, ...]:
    there = [f for f in figures if f.drives]
    return tuple(
        replace(f, corrected_p=p) for f, p in zip(there, statistics.holm([f.change.sign_p for f in there]), strict=True)
    )


def _history(runs: Sequence[OpenedRun], steps: Sequence[Comparison], asked: Requirement) -> Iterator[HistoryRow]:
    """Yield a row per run, with the comparison ``steps`` [N - 1] to the run before it."""
    for run, step in zip(runs, (None, *steps), strict=True):
        version = str((run.document.get("versions") or {}).get("pdhef-logtool") or "unknown")
        figures = () if step is None else step.figures
        verdict: Any = "" if step is None else figures[0].verdict if figures else step.verdict
        yield HistoryRow(run.place, version, asked, *_of_all(run, asked), verdict, next(iter(figures), None))


def _of_all(run: OpenedRun, asked: Requirement) -> tuple[statistics.Bounded, str]:
    """Return a figure over all drives of a run, and its unit: pooled, or the median of metrics that are no means."""
    rows = run.table("metrics").filter(pl.col("value").is_finite(), pl.col("independent"))
    rows = rows.filter(**{key: getattr(asked, key) for key in ("signal", "segment", "metric")})
    drives = run.table("drives").select("log", *statistics.FACTORS, main="estimator")
    name = pl.col("main") if asked.estimator is None else pl.lit(asked.estimator)
    of_run = rows.join(drives, on="log").filter(pl.col("estimator") == name).collect().sort("log")
    factors = {f: of_run[f].to_list() for f in statistics.FACTORS}
    n, values = (of_run[key].to_numpy().astype(np.float64) for key in ("n", "value"))
    unit = of_run["unit"][0] if len(of_run) else ""
    if asked.metric not in SQUARES | MEANS:
        return statistics.quantile(values, 0.5, factors=factors), unit
    squares = asked.metric in SQUARES
    return statistics.pooled(n, values, None, squares=squares, positive=True, factors=factors), unit


@cache
def _words() -> Any:
    """Return the sentences of ``comparison.txt`` as functions."""
    context = {"change_text": change_text, "percent": percent, "isfinite": math.isfinite}
    limits = {"LEAST_CLUSTERS": LEAST_CLUSTERS, "INDEPENDENT": INDEPENDENT}
    return template(TEMPLATES / "comparison.txt", **context, **limits).module


def sentence(about: str, comparison: Comparison) -> str:
    """Return a sentence of a comparison: ``paired``, ``verdict``, ``changes``, ``assumed`` or ``next``."""
    if about != "next":
        return one_line(getattr(_words(), about)(comparison))
    plan = comparison.requirements
    steps = next_steps(None if plan is None else plan.to_dict())
    undecided = [f.detectable for f in comparison.figures if f.verdict == comparison.verdict]
    return one_line(_words().next(comparison, steps, [*filter(math.isfinite, undecided)]))


def notes_of(comparison: Comparison) -> list[str]:
    """Return remarks on the requested figures, a line each."""
    return clauses(_words().notes(comparison))


def history_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Return the heads of a history's table, ``>`` before heads of numbers, and the texts of its rows."""
    rows = []
    for row in comparison.history:
        of, step = row.figure, row.step
        value, *ends = (shown(x, row.unit) if math.isfinite(x) else "-" for x in (of.value, of.low, of.high))
        change = "0 %" if row.verdict == "equal" else "-" if step is None else percent(math.expm1(step.change.median))
        interval = "-" if step is None else interval_text(step)
        between = "-" if "-" in ends else " to ".join(ends)
        rows.append([row.run, row.version, str(of.units), value, between, change, interval, row.verdict or "-"])
    name = comparison.history[0].requirement.name if rows else ""
    return ["run", "version", ">drives", f">{name}", ">95 % interval", ">change", ">95 % interval", "verdict"], rows


def comparison_junit(comparison: Comparison) -> bytes:
    """Return the verdicts of the plan, of the figures, and of the drives' partners as JUnit XML."""
    words: dict[str, Any] = {"percent": percent, "expm1": math.expm1, "interval_text": interval_text}
    return junit_bytes(comparison.requirements, comparison=comparison, **words)


def change_text(figure: ComparedFigure) -> str:
    """Return the median change with its interval: ``+3.1 % (+1.0 % to +5.2 %)``."""
    median, interval = percent(math.expm1(figure.change.median)), interval_text(figure)
    return median if interval == "-" else f"{median} ({interval})"


def interval_text(figure: ComparedFigure) -> str:
    """Return the 95 % interval of the median change, a dash without."""
    low, high = (math.expm1(x) for x in (figure.change.low, figure.change.high))
    return f"{percent(low)} to {percent(high)}" if math.isfinite(figure.change.low) else "-"


def percent(share: float) -> str:
    """Return a share with its sign; one too small for a digit keeps its sign, so that it does not pass for none."""
    if not math.isfinite(share):
        return "-" if math.isnan(share) else "+∞"
    if share and abs(share) < 5e-4:
        return f"{'+' if share > 0 else '-'}<0.1 %"
    return f"{share * 100:+.1f} %" if share else "0 %"
