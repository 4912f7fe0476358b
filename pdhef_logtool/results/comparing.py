"""Comparison of two finished runs: changed figures of the drives that are in both, and the gate."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.metrics.sensors import SENSORS
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.statistics import FACTORS, PairedChange, Verdict, holm, log_ratios, paired_change
from pdhef_logtool.evaluation.units import SIGNALS
from pdhef_logtool.evaluation.validation_plan import load_plan
from pdhef_logtool.records.errors import EXIT_GATE, EXIT_OK, EXIT_PARTIAL, OutputError, UsageError
from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.gate import MAIN, Figure, asked_figures
from pdhef_logtool.results.opened_run import OpenedRun, open_run, table_file
from pdhef_logtool.results.pairing import Pair, Pairing, pair_logs
from pdhef_logtool.results.plan_against import plan_verdicts_against
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.run_differences import run_differences

if TYPE_CHECKING:
    import polars as pl

#: ``no figure``: no drive has it on both sides.
FigureVerdict: TypeAlias = Verdict | Literal["no figure"]

#: Clusters of the pairs [N] that the user named, or factors with estimated influence.
_Grouping: TypeAlias = tuple[Sequence[object] | None, Mapping[str, Sequence[object]]]
#: Value of ``cluster`` for drives that do not depend on one another.
INDEPENDENT = "none"
#: Verdicts from grave to harmless; the gravest one is the overall verdict.
_GRAVITY: tuple[FigureVerdict, ...] = ("worse", "no figure", "inconclusive", "not worse", "better", "equal")
_FIGURE = ("estimator", "signal", "segment", "metric", "unit")


@dataclass(frozen=True, slots=True)
class DriveFigure:
    """A figure of one drive in both runs, in the unit of metrics.parquet; ``n``: stamps behind it.

    ``change``: b / a − 1, None from a figure of 0.
    """

    drive: str
    drive_b: str
    a: float
    b: float
    n_a: int
    n_b: int
    change: float | None


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """One figure over all drives.

    Attributes
    ----------
    drives : with the figure on both sides, largest worsening first. unit : of the figure in metrics.parquet.
    only_a, only_b : drives of both runs that have it on one side. neither : how many have it on none.
    notes : reservations.
    corrected_p : sign test, corrected for all figures that are shown beside those asked for; None for those.
    """

    figure: Figure
    verdict: FigureVerdict
    change: PairedChange
    unit: str
    drives: tuple[DriveFigure, ...]
    only_a: tuple[str, ...] = ()
    only_b: tuple[str, ...] = ()
    neither: int = 0
    notes: tuple[str, ...] = ()
    corrected_p: float | None = None

    @property
    def detectable(self) -> float:
        """The smallest worsening (a share) that would have been found in 80 % of all cases; NaN: unknown."""
        return self.change.detectable(self.figure.limit or 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values; changes are shares: 0.05 is 5 % more."""
        change = self.change
        bounds = {k: math.expm1(getattr(change, k)) for k in ("median", "low", "high", "least", "most")}
        return {
            **asdict(self.figure),
            "unit": self.unit,
            "verdict": self.verdict,
            "drives": change.drives,
            "clusters": change.clusters,
            "design_effect": change.dependence.design_effect,
            "dependence": change.dependence.by,
            **bounds,
            "detectable": self.detectable,
            "sign_p": change.sign_p,
            **{key: getattr(self, key) for key in ("corrected_p", "only_a", "only_b", "neither", "notes")},
            "of_drives": [asdict(d) for d in self.drives],
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
    """

    a: str
    b: str
    pairs: Mapping[str, int]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    differences: tuple[str, ...]
    changed: int
    figures: tuple[ComparedFigure, ...]
    others: tuple[ComparedFigure, ...] = ()
    cluster: str | None = None
    gated: bool = False
    allow_unpaired: bool = False
    strict: bool = False
    requirements: PlanVerdicts | None = None

    @property
    def equal(self) -> bool:
        """Whether all figures of all pairs are the same bit for bit."""
        return self.changed == 0

    @property
    def verdict(self) -> FigureVerdict:
        """The gravest verdict of the figures."""
        if self.equal and not any(f.verdict == "no figure" for f in self.figures):
            return "equal"
        return min((f.verdict for f in self.figures), key=_GRAVITY.index)

    @property
    def unpaired(self) -> tuple[str, ...]:
        """Drives and figures on one side only, a line per side and figure."""
        sides = [("drives", "", self.only_a, self.only_b)]
        sides += [("figures", f": {f.figure.label}", f.only_a, f.only_b) for f in self.figures]
        return tuple(
            f"{what} in {side} only{label}: {listed(names)}"
            for what, label, a, b in sides
            for side, names in (("A", a), ("B", b))
            if names
        )

    @property
    def failures(self) -> tuple[str, ...]:
        """Reasons why the gate is closed, a line each; empty without a gate or if it is open."""
        reasons = []
        if self.gated:
            reasons += [f"{f.figure.label}: {f.verdict}" for f in self.figures if f.verdict in ("worse", "no figure")]
            reasons += () if self.allow_unpaired else self.unpaired
        if self.strict and self.requirements is None:
            refused = ("inconclusive",) if self.gated else ("inconclusive", "no figure")
            reasons += [
                f"{f.figure.label}: {f.verdict}, which --strict refuses" for f in self.figures if f.verdict in refused
            ]
        return tuple(reasons)

    @property
    def exit_code(self) -> int:
        """4 where the gate is closed, 3 for drives without partner and no gate, else 0."""
        if self.failures or (self.requirements is not None and self.requirements.closes_gate):
            return EXIT_GATE
        return EXIT_PARTIAL if self.unpaired and not self.gated and not self.allow_unpaired else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as one JSON-able document."""
        return {
            "format": "pdhef.comparison",
            "version": 2,
            **{key: getattr(self, key) for key in ("a", "b", "verdict", "exit_code", "failures")},
            "plan": None if self.requirements is None else self.requirements.to_dict(),
            "differences": self.differences,
            "pairs": dict(self.pairs),
            **{key: getattr(self, key) for key in ("only_a", "only_b", "changed", "cluster")},
            "figures": [f.to_dict() for f in self.figures],
            "others": [f.to_dict() for f in self.others],
        }


def compare(
    a: Path | str,
    b: Path | str,
    *,
    plan: Path | str | None = None,
    max_regression: str | None = None,
    estimator: str | None = None,
    metric: str | None = None,
    cluster: str | None = None,
    allow_unpaired: bool = False,
    strict: bool = False,
) -> Comparison:
    """Compare the outputs of two runs, folders or URLs, as ``pdhef compare`` does with options of these names.

    Raises
    ------
    UsageError : The plan is wrong, or an option.
    OutputError : One of them is no finished run, or damaged; or no drive is in both.
    """
    validation = None if plan is None else load_plan(Path(plan))
    figures = asked_figures(validation, max_regression, estimator, metric)
    runs = open_run(a), open_run(b)
    result = compare_runs(*runs, figures, allow_unpaired=allow_unpaired, cluster=cluster, strict=strict)
    if validation is None:
        return result
    return replace(result, requirements=plan_verdicts_against(validation, *runs, strict=strict))


def compare_runs(
    a: OpenedRun,
    b: OpenedRun,
    figures: Sequence[Figure],
    *,
    allow_unpaired: bool = False,
    cluster: str | None = None,
    strict: bool = False,
) -> Comparison:
    """Compare two runs.

    Parameters
    ----------
    figures : to compare by; those without a limit are no gate. allow_unpaired : accept drives on one side only.
    cluster : ``car``, ``day``, ``route`` or a key of the logs' metadata by which drives depend on one another;
        ``none``: independent drives; None: the dependence by day, car and route is estimated.
    strict : an inconclusive figure closes the gate.

    Raises
    ------
    OutputError : No drive is in both runs, or the figures of a run are damaged.
    UsageError : No drive has the estimator, or the key.
    """
    pairing = pair_logs(a.logs, b.logs)
    if not pairing.pairs:
        raise OutputError(
            expected="a drive that is in both runs",
            got=f"none of {len(a.logs)} and {len(b.logs)} by signals, content or name",
            where=f"{a.place} and {b.place}",
            remedy="run both on the same drives",
        )
    gated = any(f.limit is not None for f in figures)
    tables = _Tables(a, b, pairing.pairs)
    changed = tables.changed()
    result = Comparison(
        a=a.place,
        b=b.place,
        pairs=Counter(pair.by for pair in pairing.pairs),
        only_a=tuple(log.label for log in pairing.only_a),
        only_b=tuple(log.label for log in pairing.only_b),
        differences=run_differences(a, b, pairing.pairs),
        changed=len(changed),
        figures=(),
        cluster=cluster,
        gated=gated,
        allow_unpaired=allow_unpaired,
        strict=strict,
    )
    if not changed and not gated:
        return result
    grouping = _grouping(a, pairing, cluster)
    compared = tuple(tables.compared(figures, grouping))
    tables.check_estimators(compared)
    if not changed:
        return replace(result, figures=compared)
    return replace(result, figures=compared, others=_corrected(tables.compared(_beside(figures), grouping)))


class _Tables:
    """Figures of two runs for their pairs; only requested rows are read."""

    def __init__(self, a: OpenedRun, b: OpenedRun, pairs: Sequence[Pair]) -> None:
        import polars as pl

        columns = {
            "a": [p.a.label for p in pairs],
            "b": [p.b.label for p in pairs],
            "main": [p.a.main() for p in pairs],
        }
        self._runs, self._pairs = (a, b), pl.DataFrame(columns).with_row_index("place")

    def changed(self) -> frozenset[str]:
        """Return the drives of A with any figure that is not the same bit for bit."""
        import polars as pl

        tables = [run.table("metrics") for run in self._runs]
        digests = {run.document.get("files", {}).get(table_file("metrics")) for run in self._runs}
        if len(digests) == 1 and None not in digests and self._pairs["a"].equals(self._pairs["b"]):
            return frozenset()
        hashed = (rows.select("log", row=pl.struct(*_FIGURE, "value", "n").hash()) for rows in tables)
        sums = (rows.group_by("log").agg(pl.col("row").sum(), pl.len()) for rows in hashed)
        a, b = (rows.collect(engine="streaming") for rows in sums)
        both = self._pairs.join(a, left_on="a", right_on="log", how="left")
        both = both.join(b, left_on="b", right_on="log", how="left", suffix="_b")
        differs = pl.col("row").ne_missing(pl.col("row_b")) | pl.col("len").ne_missing(pl.col("len_b"))
        return frozenset(both.filter(differs)["a"])

    def compared(self, figures: Sequence[Figure], grouping: _Grouping) -> list[ComparedFigure]:
        """Return figures over all pairs; only their rows are read."""
        rows = self._rows(figures)
        return [self._compared(figure, rows, grouping) for figure in figures]

    def _rows(self, figures: Sequence[Figure]) -> pl.DataFrame:
        """Return the figures of the pairs, a row each: ``value``, ``n``, ``independent`` of A, and with ``_b`` of B."""
        import polars as pl

        named = {f.estimator for f in figures} - {MAIN} | set(self._pairs["main"])
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

    def _compared(self, figure: Figure, rows: pl.DataFrame, grouping: _Grouping) -> ComparedFigure:
        import polars as pl

        name = pl.col("main") if figure.estimator == MAIN else pl.lit(figure.estimator)
        key = {key: getattr(figure, key) for key in ("signal", "segment", "metric")}
        of_pairs = rows.filter(pl.col("estimator") == name, **key)
        both = of_pairs.drop_nulls(["value", "value_b"])
        a, b = both["value"].to_numpy(), both["value_b"].to_numpy()
        ratios = log_ratios(a, b)
        clusters, factors = grouping
        places = both["place"].to_list()
        of_both = {name: [values[i] for i in places] for name, values in factors.items()}
        change = paired_change(ratios, clusters and [clusters[i] for i in places], of_both)
        verdict: FigureVerdict = change.verdict(figure.limit or 0.0)
        if np.array_equal(a, b) and both["n"].equals(both["n_b"]):
            verdict = "equal" if len(both) else "no figure"
        ordered = both.select("a", "b", "value", "value_b", "n", "n_b")[np.argsort(-ratios, kind="stable")]
        return ComparedFigure(
            figure,
            verdict,
            change,
            unit=both["unit"][0] if len(both) else "",
            drives=tuple(
                DriveFigure(drive, drive_b, x, y, n_a, n_b, _share(x, y))
                for drive, drive_b, x, y, n_a, n_b in ordered.iter_rows()
            ),
            only_a=tuple(of_pairs.filter(pl.col("value_b").is_null())["a"]),
            only_b=tuple(of_pairs.filter(pl.col("value").is_null())["a"]),
            neither=len(self._pairs) - len(of_pairs),
            notes=tuple(_notes(both)),
        )

    def check_estimators(self, figures: Sequence[ComparedFigure]) -> None:
        """Raise UsageError for an estimator that no drive of either run has, and for runs without a selected one."""
        missing = {f.figure.estimator for f in figures if f.verdict == "no figure"}
        if any(self._pairs["main"]):
            missing -= {MAIN}
        if not missing:
            return
        frames = [run.table("metrics").select("estimator").unique().collect(engine="streaming") for run in self._runs]
        estimators = {name for frame in frames for name in frame["estimator"]}
        for name in sorted(missing - estimators):
            single = sorted(k for k in estimators if "~" not in k and k != SENSORS)
            got = "none named, and none that is selected" if name == MAIN else name
            raise UsageError(expected=f"an estimator of these runs: {', '.join(single)}", got=got, where="--estimator")


def _notes(both: pl.DataFrame) -> Iterator[str]:
    other = both.filter(both["n"] != both["n_b"])
    if len(other):
        share = _share(float(both["n"].sum()), float(both["n_b"].sum())) or 0.0
        yield f"other stamps are scored in {len(other)} of {len(both)} drives, {share:+.2%} in all"
    if tainted := len(both) - int((both["independent"] & both["independent_b"]).sum()):
        yield f"in {tainted} of {len(both)} drives the ground truth is one of the estimator's inputs"


def _share(a: float, b: float) -> float | None:
    return None if a == 0.0 else b / a - 1.0


def _others() -> list[Figure]:
    """Return figures that an estimator influences: RMSE by signal and segment, and the other columns of tables."""
    shown = [
        Figure(signal=signal, metric=metric.name)
        for metric in registered().values()
        for signal in dict.fromkeys((*metric.terminal, *metric.brief))
        if metric.best == "lower" and metric.name != "rmse"
    ]
    return [
        *(Figure(signal=signal) for signal in SIGNALS if signal not in ("sideslip_rad", "state")),
        *(figure for figure in shown if figure.signal == "sideslip_rad"),
        *(Figure(segment=segment) for segment in SEGMENTS if segment != "all"),
        *(figure for figure in shown if figure.signal != "sideslip_rad"),
    ]


def _beside(asked: Sequence[Figure]) -> list[Figure]:
    """Return the figures that are shown beside those asked for."""
    keys = {(f.signal, f.metric, f.segment) for f in asked}
    return [
        replace(f, estimator=asked[0].estimator)
        for f in (Figure(), *_others())
        if (f.signal, f.metric, f.segment) not in keys
    ]


def _corrected(figures: Sequence[ComparedFigure]) -> tuple[ComparedFigure, ...]:
    there = [f for f in figures if f.drives]
    return tuple(replace(f, corrected_p=p) for f, p in zip(there, holm([f.change.sign_p for f in there]), strict=True))


def _grouping(run: OpenedRun, pairing: Pairing, key: str | None) -> _Grouping:
    """Return the groups of the pairs [N] by a key, as clusters, or by day, car and route without one, as factors."""
    if key == INDEPENDENT:
        return None, {}
    of_log: dict[str, dict[str, str | None]] = {}
    for log, name, value in run.table("metadata").collect().iter_rows():
        of_log.setdefault(log, {})[name] = value
    for log, *values in run.table("drives").select("log", *FACTORS).collect().iter_rows():
        of_log.setdefault(log, {}).update(zip(FACTORS, values, strict=True))
    stated = [of_log.get(pair.a.label, {}) for pair in pairing.pairs]
    if key is None:
        return None, {name: [of.get(name) for of in stated] for name in FACTORS}
    values = [of.get(key) for of in stated]
    if all(value is None for value in values):
        names = dict.fromkeys((*FACTORS, INDEPENDENT, *sorted({str(k) for of in stated for k in of})))
        raise UsageError(expected=f"a key of the drives: {', '.join(names)}", got=key, where="--cluster")
    return values, {}
