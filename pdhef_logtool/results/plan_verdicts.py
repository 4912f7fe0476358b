"""The verdicts of a validation plan on the drives of a run, from its tables and the blocks of report.json.

The baseline of a requirement can be another run: run A of a comparison, or an earlier output.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.metrics.sensors import NOT_INDEPENDENT, SENSORS
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks, from_document
from pdhef_logtool.evaluation.requirement_verdicts import DriveValue, JudgedDrive, RequirementVerdict, judge
from pdhef_logtool.evaluation.statistics import LEAST_DRIVES
from pdhef_logtool.evaluation.units import LABELS
from pdhef_logtool.evaluation.validation_plan import POOLED, RUN, Requirement, ValidationPlan, names_of
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun, open_run
from pdhef_logtool.results.pairing import pair_logs
from pdhef_logtool.results.parquet_sink import read_rows
from pdhef_logtool.results.sink import TRUTH

#: Figures beside the requirement's own: exposure, independence, and the estimated reference.
_BESIDE = ("exposure_s", "exposure_m", NOT_INDEPENDENT, "reference_rms", "reference_std")
#: Log, estimator, signal, segment and metric.
_Key = tuple[str, str, str, str, str]


@dataclass(frozen=True, slots=True)
class PlanVerdicts:
    """The verdicts of a plan in its order. ``strict``: INCONCLUSIVE closes the gate too."""

    plan: ValidationPlan
    verdicts: tuple[RequirementVerdict, ...]
    strict: bool = False

    @property
    def closing(self) -> list[RequirementVerdict]:
        """The verdicts that fail the command; none of the default plan do."""
        outcomes = ("FAIL", "INCONCLUSIVE") if self.strict else ("FAIL",)
        return [v for v in self.verdicts if self.plan.file and v.outcome in outcomes]

    def to_dict(self) -> dict[str, Any]:
        """Return plan and verdicts as JSON-able values."""
        return {
            "title": self.plan.title,
            "file": self.plan.file or None,
            "sha256": self.plan.sha256,
            "requirements": [v.to_dict() for v in self.verdicts],
        }


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures by log, estimator, signal, segment and metric: value and number of stamps."""

    values: Mapping[_Key, tuple[float, int]]
    names: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def of(self, log: str, name: str, requirement: Requirement, metric: str) -> tuple[float, int] | None:
        """Return a figure of a requirement's signal and segment, None without a finite one."""
        figure = self.values.get((log, name, requirement.signal, requirement.segment, metric))
        return figure if figure is not None and math.isfinite(figure[0]) else None

    def main(self, drive: JudgedDrive) -> str | None:
        """Return the estimator of a drive that is judged by default."""
        names = self.names.get(drive.log, ())
        return drive.main if drive.main is not None else names[0] if len(names) == 1 else None


def figures_of_rows(rows: Iterable[MetricRow]) -> Figures:
    """Return the figures of rows at hand."""
    return _figures((r.log, r.estimator, r.signal, r.segment, r.metric, r.value, r.n) for r in rows)


def _figures(rows: Iterable[tuple[str, str, str, str, str, float, int]]) -> Figures:
    values: dict[_Key, tuple[float, int]] = {}
    names: dict[str, dict[str, None]] = {}
    for log, name, signal, segment, metric, value, n in rows:
        values[log, name, signal, segment, metric] = value, n
        if "~" not in name and name not in (SENSORS, TRUTH, REFERENCE):
            names.setdefault(log, {})[name] = None
    return Figures(values, {log: list(of_log) for log, of_log in names.items()})


def figures_of_file(path: Path, plan: ValidationPlan, mains: Sequence[str | None]) -> Figures:
    """Return the rows of a metrics.parquet that a plan needs; raises OutputError."""
    wanted = {
        "signal": {"state", *(r.signal for r in plan.requirements)},
        "segment": {"all", *(r.segment for r in plan.requirements)},
        "metric": {*_BESIDE, *(r.metric for r in plan.requirements)},
    }
    if len(named := [m for m in mains if m is not None]) == len(mains):
        wanted["estimator"] = {SENSORS, *names_of(plan.requirements), *named}
    return _figures(read_rows(path, ["log", "estimator", "signal", "segment", "metric", "value", "n"], wanted))


#: Figures of another run, and its drive by the label of this run's.
Against: TypeAlias = tuple[Figures, Mapping[str, JudgedDrive]]


def plan_verdicts(
    plan: ValidationPlan,
    figures: Figures,
    drives: Sequence[JudgedDrive],
    *,
    strict: bool = False,
    against: Mapping[str, Against] | None = None,
) -> PlanVerdicts:
    """Return the verdicts of a plan.

    Parameters
    ----------
    figures : of the drives. against : the other run by the baseline of a requirement.
    """
    others = against or {}
    judged = (_Judged(r, figures, others.get(r.other_run or "")) for r in plan.requirements)
    return PlanVerdicts(plan, tuple(j.verdict(drives) for j in judged), strict)


@dataclass(frozen=True, slots=True)
class _Judged:
    """A requirement on the figures of a run; ``against``: the run that is its baseline, if it is available."""

    requirement: Requirement
    figures: Figures
    against: Against | None

    def verdict(self, drives: Sequence[JudgedDrive]) -> RequirementVerdict:
        """Return the verdict: against ground truth if it scores a drive, else against the estimated reference."""
        requirement, metrics = self.requirement, [self.requirement.metric]
        if (requirement.signal, requirement.metric) == ("sideslip_rad", "rmse"):
            metrics.append("reference_rms")
        measured = ([(d, v) for d in drives if (v := self._value(d, metric)) is not None] for metric in metrics)
        rows = next(filter(None, measured), [])
        if requirement.statistic == POOLED and len(rows) < LEAST_DRIVES:
            rows = [(d, self._with_blocks(d, v)) for d, v in rows]
        return judge(requirement, [v for _, v in rows], "" if rows else self._why_missing(drives))

    def _name(self, drive: JudgedDrive) -> str | None:
        return self.requirement.estimator or self.figures.main(drive)

    def _tainted(self, log: str, name: str) -> bool:
        """Return whether the ground truth is an input of an estimator."""
        return (log, name, self.requirement.signal, "all", NOT_INDEPENDENT) in self.figures.values

    def _value(self, drive: JudgedDrive, metric: str) -> DriveValue | None:
        """Return the metric of a drive against ground truth, or its ``reference_rms``."""
        requirement, figures, name = self.requirement, self.figures, self._name(drive)
        if name is None or (metric == requirement.metric and self._tainted(drive.log, name)):
            return None
        figure = figures.of(drive.log, name, requirement, metric)
        std = figures.of(drive.log, name, requirement, "reference_std") if metric == "reference_rms" else (math.nan, 0)
        needed, baseline = requirement.baseline is not None, self._baseline(drive, metric)
        if figure is None or std is None or (needed and baseline is None):
            return None
        value, n = figure
        seconds, metres = self._exposure(drive, n)
        same = needed and value == baseline
        return DriveValue(drive, name, value, n, baseline, seconds, metres, std[0], same=same)

    def _baseline(self, drive: JudgedDrive, metric: str) -> float | None:
        """Return the metric of the baseline: an estimator of the drive, or of the drive in the other run."""
        figures, other, name = self.figures, drive, self.requirement.baseline
        if self.requirement.other_run is not None:
            if self.against is None or drive.log not in self.against[1]:
                return None
            figures, other = self.against[0], self.against[1][drive.log]
            name = self.requirement.estimator or figures.main(other)
        figure = None if name is None else figures.of(other.log, name, self.requirement, metric)
        return None if figure is None else figure[0]

    def _exposure(self, drive: JudgedDrive, n: int) -> Iterator[float]:
        """Yield seconds and metres behind a figure: the segment's, in proportion to the scored stamps."""
        for metric in ("exposure_s", "exposure_m"):
            whole = self.figures.values.get((drive.log, SENSORS, "state", self.requirement.segment, metric))
            yield math.nan if whole is None or not whole[1] else whole[0] * min(n / whole[1], 1.0)

    def _with_blocks(self, drive: JudgedDrive, value: DriveValue) -> DriveValue:
        """Return the metric of a drive with its blocks, which also state the exposure."""
        estimated = math.isfinite(value.std)
        blocks = self._blocks(drive, estimated=estimated)
        if self.requirement.other_run is not None:
            partner = None if self.against is None else self.against[1].get(drive.log)
            blocks = _paired(blocks, None if partner is None else self._blocks(partner, estimated=estimated))
        if blocks is None:
            return value
        return replace(value, blocks=blocks, seconds=math.fsum(blocks.seconds), metres=math.fsum(blocks.metres))

    def _blocks(self, drive: JudgedDrive, *, estimated: bool) -> RequirementBlocks | None:
        blocks = from_document((drive.read_report() or {}).get("requirement_blocks") or ())
        return next((b for b in blocks if b.of == self.requirement.measured and b.estimated == estimated), None)

    def _why_missing(self, drives: Sequence[JudgedDrive]) -> str:
        """Return why no drive has the metric, with a remedy after a semicolon."""
        requirement, figures = self.requirement, self.figures
        if requirement.other_run is not None and self.against is None:
            how = "pdhef compare A B --plan PLAN" if requirement.other_run == RUN else "see the verdict on the run"
            return f"the baseline is another run: {how}"
        names = {d.log: name for d in drives if (name := self._name(d))}
        if not names:
            return "there are several recorded estimates: name one with estimator" if figures.names else "no estimate"
        return self._why_unscored(names)

    def _why_unscored(self, names: Mapping[str, str]) -> str:
        """Return why no drive with the estimators ``names`` has the metric, with a remedy after a semicolon."""
        requirement, figures = self.requirement, self.figures
        scored = [log for log, name in names.items() if figures.of(log, name, requirement, requirement.metric)]
        if scored and all(self._tainted(log, names[log]) for log in scored):
            return "the ground truth is an input of the estimator: not an independent check"
        if scored and requirement.baseline != requirement.other_run:
            return f"{requirement.baseline} has no such value; add it to the estimators of pdhef run"
        whole = ((log, name, requirement.signal, "all", requirement.metric) for log, name in names.items())
        if requirement.segment != "all" and any(key in figures.values for key in whole):
            return f"no scored driving in {requirement.segment}"
        if requirement.estimator is not None and not any(requirement.estimator in n for n in figures.names.values()):
            return f"{requirement.estimator} did not run; add it to the estimators of pdhef run"
        above = " above the low-speed limit" if requirement.signal == "sideslip_rad" else ""
        return f"no ground truth of {LABELS[requirement.signal]}{above}; record drives with ground truth{above}"


def _paired(blocks: RequirementBlocks | None, theirs: RequirementBlocks | None) -> RequirementBlocks | None:
    """Return blocks with the blocks of run A as baseline, if both have them."""
    if blocks is None or theirs is None or blocks.block_s != theirs.block_s:
        return None
    by_number = dict(zip(theirs.number, theirs.value, strict=True))
    kept = [i for i, number in enumerate(blocks.number) if number in by_number]
    columns = ("number", "n", "seconds", "metres", "value", *(["std"] if blocks.std else []))
    picked: dict[str, Any] = {k: [getattr(blocks, k)[i] for i in kept] for k in columns}
    return replace(blocks, **picked, baseline=[by_number[number] for number in picked["number"]])


def plan_verdicts_against(plan: ValidationPlan, a: OpenedRun, b: OpenedRun, *, strict: bool) -> PlanVerdicts:
    """Return the verdicts on the drives of B with A as :data:`~.validation_plan.RUN`; raises OutputError."""
    drives: Sequence[JudgedDrive] = [judged_drive(log) for log in b.logs]
    drives = in_spaces(drives, plan, b.table_path)
    figures = figures_of_file(b.table_path("metrics"), plan, [d.main for d in drives])
    against = {**other_runs(plan, b.logs), RUN: _against(plan, a, b.logs)}
    return plan_verdicts(plan, figures, drives, strict=strict, against=against)


def other_runs(plan: ValidationPlan, logs: Sequence[OpenedLog]) -> dict[str, Against]:
    """Return the outputs that requirements name as baseline, by their path or URL, paired with logs of this run.

    Raises
    ------
    OutputError : One of them is missing (exit code 2) or damaged.
    """
    names = dict.fromkeys(n for r in plan.requirements if (n := r.other_run) not in (None, RUN))
    return {name: _against(plan, open_run(name), logs) for name in names if name is not None}


def _against(plan: ValidationPlan, run: OpenedRun, logs: Sequence[OpenedLog]) -> Against:
    partners = {pair.b.label: judged_drive(pair.a) for pair in pair_logs(run.logs, logs)[0]}
    return figures_of_file(run.table_path("metrics"), plan, [d.main for d in partners.values()]), partners


def judged_drive(log: OpenedLog) -> JudgedDrive:
    """Return a log of a run to judge."""
    factors = {"car": (log.entry.get("car") or {}).get("name"), **{k: log.entry.get(k) for k in ("day", "route")}}
    return JudgedDrive(log.label, log.main() or None, cache(log.readable_report), factors)


def in_space(drive: JudgedDrive, report: Mapping[str, Any]) -> JudgedDrive:
    """Return a drive with its operating space and friction, from its report."""
    space = report.get("operating_space") or {}
    speeds, ays = (space.get(key, ()) for key in ("speed_edges_m_s", "ay_edges_m_s2"))
    cells = {(speeds[c["speed"]], ays[c["ay"]]): c["seconds"] for c in space.get("cells", ())}
    friction = space.get("friction_median")
    return replace(drive, space=cells, friction=math.nan if friction is None else float(friction))


def in_spaces(
    drives: Sequence[JudgedDrive], plan: ValidationPlan, table_path: Callable[[str], Path]
) -> Sequence[JudgedDrive]:
    """Return drives with operating space and friction by tables of a run, which are read if the plan needs them."""
    if not any(r.exposure for r in plan.requirements):
        return drives
    spaces: dict[str, dict[tuple[float, float], float]] = {}
    for log, speed, ay, seconds in read_rows(table_path("exposure"), ["log", "speed_m_s", "ay_m_s2", "seconds"], {}):
        spaces.setdefault(log, {})[speed, ay] = seconds
    friction = dict(read_rows(table_path("drives"), ["log", "friction_median"], {}))
    return [replace(d, space=spaces.get(d.log, {}), friction=friction.get(d.log, math.nan)) for d in drives]
