"""report.json of one log, run.json of a run, and the report as Markdown; plain records in, plain JSON out."""

from __future__ import annotations

import importlib.metadata
import json
import math
import platform
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.compiled.sources import compiled_digest
from pdhef_logtool.evaluation.dead_reckoned import PathDrift
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.operating_space import OperatingSpace
from pdhef_logtool.evaluation.reasons import ReasonFacts, SensorFault
from pdhef_logtool.evaluation.standing import Standing
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.ledger import SampleCount
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.error_places import ErrorPlace
from pdhef_logtool.results.selected_estimate import MainFacts, answer_of
from pdhef_logtool.results.sink import Event
from pdhef_logtool.results.verdicts import verdicts_of
from pdhef_logtool.storage.documents import jsonable, seal
from pdhef_logtool.storage.files import write_bytes

if TYPE_CHECKING:
    from pathlib import Path

    from pdhef_logtool.car.assumed_values import AssumedValue
    from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
    from pdhef_logtool.results.plan_verdicts import PlanVerdicts

#: Columns of a figure in the report.
_METRIC_COLUMNS = ("log", "estimator", "signal", "segment", "metric", "value", "unit", "n")
#: Entries that a brief report keeps of a list.
_MOST_LISTED = 5
#: Distributions whose version decides what a run computes or writes.
VERSIONED = ("pdhef-logtool", "mcap", "numba", "numpy", "polars", "pyarrow", "rerun-sdk", "rosbags", "scipy", "torch")


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """One topic of the log, and whether a signal or a truth channel is read from it."""

    name: str
    type_name: str
    encoding: str
    messages: int
    mapped: bool


@dataclass(frozen=True, slots=True)
class LogFacts:
    """The log that was read; ``file`` is its file name without folders, [start_ns, end_ns) its log times.

    ``signals_sha256``, ``truth_sha256``: of what was read of it, None where nothing was.
    """

    name: str
    file: str
    kind: str
    sha256: str
    start_ns: int
    end_ns: int
    topics: Sequence[TopicFacts] = ()
    signals_sha256: str | None = None
    truth_sha256: str | None = None


@dataclass(frozen=True, slots=True)
class SourceFacts:
    """Where one signal or ground truth quantity came from.

    ``source`` is ``/topic.field``; ``derivation`` states how it was computed, empty if it was read directly.
    """

    name: str
    source: str
    unit: str
    samples: int
    derivation: str = ""


@dataclass(frozen=True, slots=True)
class EstimatorFacts:
    """One estimator that was asked for.

    ``skipped`` is the reason if it did not run, ``failed`` the reason if its estimates are not used.
    ``notes``: what it has to state of itself. ``intervals``: what its 95 % intervals are made of, empty without.
    ``reasons``: why it did not use its sensors as usual; None if it does not look. ``algorithm``: what ran under the
    name, with its digest; None if it did not run.
    """

    name: str
    causal: bool
    skipped: str | None = None
    failed: str | None = None
    notes: Sequence[str] = ()
    intervals: Sequence[str] = ()
    reasons: Sequence[ReasonFacts] | None = None
    algorithm: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class TruthFacts:
    """What was compared with: quantities (with their derivation), its latency, and what is no independent check."""

    quantities: Sequence[SourceFacts] = ()
    latency_s: float | None = None
    not_independent: Sequence[str] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class FrictionFacts:
    """The friction that every estimator was given: ``source`` in words, and what an estimate of it was worth.

    ``observable_share`` of the stamps, ``observable_std`` the median 1-sigma there; NaN where nothing was estimated.
    """

    source: str
    estimated: bool = False
    observable_share: float = math.nan
    observable_std: float = math.nan
    summary: str = ""


@dataclass(frozen=True, slots=True)
class DriveDetails:
    """What a report's page shows and no table contains, of a drive that a run estimated.

    ``faults`` of the sensors, None where no estimator detects them.
    ``standings`` of the selected estimate, empty without ground truth.
    ``metadata`` : what the log states of itself.
    """

    faults: Sequence[SensorFault] | None
    standings: Sequence[Standing]
    metadata: Mapping[str, str]
    path_drift: PathDrift | None = None


@dataclass(frozen=True, slots=True)
class RequirementFacts:
    """The verdicts of the validation plan on one drive alone, and the blocks of time that they are drawn from."""

    verdicts: PlanVerdicts
    blocks: Sequence[RequirementBlocks] = ()


@dataclass(frozen=True, slots=True)
class ReportFacts:
    """Everything that report.json states about one log.

    ``vehicle_file``: the car's folder or file, None where none was given; ``vehicle_proven``: whether driving with
    ground truth showed it to be right; ``vehicle_taught``: what taught it, None without. ``low_speed_m_s``: below it
    sideslip is not scored.
    ``main``: the estimator of the selected estimate, None where nothing was estimated.
    ``warnings``: what may be wrong; ``remarks``: what else is worth knowing.
    ``calibration``: what the drive stated of its car without ground truth, None where it was not asked.
    ``reference``: what came of the sideslip reference, None where it was not asked for.
    ``samples``: what became of the samples of each mapped source.
    ``checks``: plausibility of signals, ground truth and vehicle file. ``details``: None where nothing was estimated.
    ``requirements``: None where there is nothing to judge. ``space``: where the drive went.
    ``largest_errors``: of sideslip, the largest first.
    """

    log: LogFacts
    signals: Sequence[SourceFacts]
    missing_signals: Sequence[str]
    vehicle_name: str
    vehicle_sha256: str
    estimators: Sequence[EstimatorFacts]
    truth: TruthFacts
    vehicle_file: str | None = None
    vehicle_proven: bool = False
    vehicle_taught: str | None = None
    sensors: Mapping[str, float] = field(default_factory=dict)
    assumed: Sequence[AssumedValue] = ()
    setup: Mapping[str, Any] | None = None
    low_speed_m_s: float | None = None
    friction: FrictionFacts | None = None
    calibration: Mapping[str, Any] | None = None
    reference: Mapping[str, Any] | None = None
    metrics: Sequence[MetricRow] = ()
    segments: Sequence[Event] = ()
    losses: Sequence[Loss] = ()
    samples: Sequence[SampleCount] = ()
    warnings: Sequence[str] = ()
    remarks: Sequence[str] = ()
    main: MainFacts | None = None
    checks: Sequence[Check] = ()
    requirements: RequirementFacts | None = None
    space: OperatingSpace | None = None
    largest_errors: Sequence[ErrorPlace] = ()
    details: DriveDetails | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CarFacts:
    """The car that a log of a run had: folder or file (None: none was given), vehicle, digests of physics, network.

    ``sensors``: the entries of its sensor profile that differ from the default.
    """

    file: str | None
    name: str
    sha256: str
    network_sha256: str | None
    sensors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LogOutcome:
    """How one log of a run ended, with which car; None where it was not read or nothing was estimated.

    ``failed`` is the one-line reason if nothing came out; ``lost`` states what of the log could not be used.
    ``main``: the estimator of the selected estimate. ``folder`` of the log, below the folder of the run.
    ``algorithms``: the identity of each estimator that ran. ``files``: sha256 by name of the files in the log's folder
    that commands read back. ``day`` (UTC) and ``route``: drives that share them depend on one another.
    """

    log: str
    file: str
    sha256: str | None
    failed: str | None = None
    lost: Sequence[str] = ()
    car: CarFacts | None = None
    signals_sha256: str | None = None
    truth_sha256: str | None = None
    mapping_sha256: str | None = None
    main: str | None = None
    folder: str = ""
    algorithms: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    day: str | None = None
    route: str | None = None

    @property
    def outcome(self) -> str:
        """``ok``, ``failed: reason`` or ``lost: what``."""
        if self.failed is not None:
            return f"failed: {self.failed}"
        return f"lost: {'; '.join(self.lost)}" if self.lost else "ok"


def tool_versions() -> dict[str, str]:
    """Return the versions of Python and of the installed distributions that decide what a run computes."""
    return {"python": platform.python_version(), **{name: v for name in VERSIONED if (v := _installed(name))}}


def run_versions() -> dict[str, str]:
    """Return the same and the digest that compiled code is kept under."""
    return {**tool_versions(), "compiled": compiled_digest()}


@cache
def _installed(distribution: str) -> str | None:
    """Return the version of a distribution, None where it is not installed; the file is read once a process."""
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(distribution)
    return None


def build_report(facts: ReportFacts) -> dict[str, Any]:
    """Return the document of report.json (schemas/report.schema.json); NaN has become None."""
    log, about = facts.log, jsonable(facts.log)
    topics = about.pop("topics")
    document: dict[str, Any] = {
        "format": "pdhef.report",
        "version": 1,
        "log": {
            **about,
            "file": PurePath(log.file).name,
            "duration_s": (log.end_ns - log.start_ns) * 1e-9,
            "topics": [{"type" if k == "type_name" else k: v for k, v in topic.items()} for topic in topics],
        },
        "mapping": {"signals": list(facts.signals), "missing": list(facts.missing_signals)},
        "vehicle": {
            "name": facts.vehicle_name,
            "sha256": facts.vehicle_sha256,
            "file": facts.vehicle_file,
            "proven": facts.vehicle_proven,
            "taught": facts.vehicle_taught,
            "sensors": dict(facts.sensors),
            "assumed": list(facts.assumed),
            "low_speed_blend_m_s": facts.low_speed_m_s,
        },
        "estimators": [_estimator(e) for e in facts.estimators],
        "truth": {
            "available": bool(facts.truth.quantities),
            **jsonable(facts.truth),
            "not_independent": sorted(facts.truth.not_independent),
        },
        "setup": facts.setup,
        "friction": facts.friction,
        "self_calibration": facts.calibration,
        "reference": facts.reference,
        "metrics": [{name: getattr(m, name) for name in _METRIC_COLUMNS} for m in facts.metrics],
        "segments": list(facts.segments),
        "losses": list(facts.losses),
        "ledger": {
            "samples": list(facts.samples),
        },
        "warnings": list(facts.warnings),
        "remarks": list(facts.remarks),
        "checks": list(facts.checks),
        "versions": dict(facts.versions),
    }
    if facts.requirements is not None:
        document["plan"] = facts.requirements.verdicts.to_dict()
        document["requirement_blocks"] = list(facts.requirements.blocks)
    if facts.space is not None:
        document |= {"operating_space": facts.space, "largest_errors": list(facts.largest_errors)}
    document = {key: jsonable(value) for key, value in document.items()}
    return document | _selected(document, facts.main, facts.details)


def _estimator(facts: EstimatorFacts) -> dict[str, Any]:
    return {
        "name": facts.name,
        "causal": facts.causal,
        "outcome": "failed" if facts.failed else "ran" if facts.skipped is None else "skipped",
        "reason": facts.failed or facts.skipped,
        "algorithm": facts.algorithm,
        "notes": list(facts.notes),
        "intervals": list(facts.intervals),
        "reasons": None if facts.reasons is None else list(facts.reasons),
    }


def _selected(document: Mapping[str, Any], main: MainFacts | None, details: DriveDetails | None) -> dict[str, Any]:
    """Return the selected estimate, its sentences, and the keys that only a run writes."""
    if main is None:
        return {"selected_estimate": None, "answer": None}
    chosen: dict[str, Any] = {"selected_estimate": main.name, "answer": answer_of(document, main)}
    if details is None:
        return chosen
    chosen |= _detailed(details)
    return chosen | {"verdicts": verdicts_of({**document, **chosen}, main.name, details.standings)}


def _detailed(details: DriveDetails) -> dict[str, Any]:
    """Return the keys that only a run writes."""
    values = {
        "faults": details.faults,
        "path_drift": details.path_drift,
        "metadata": dict(details.metadata),
    }
    return {key: jsonable(value) for key, value in values.items()}


def brief_report(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return a report of a few kB, of many drives: figures that tables show, and no list that grows with the log.

    All figures are in metrics.parquet. Of topics those that were mapped stay, of algorithms all but the noise, of
    segments the sideslip answer's own, and of the rest the first :data:`_MOST_LISTED`; the verdicts are in run.json.
    """
    answer = report["answer"]
    names = {answer["main"], answer["naive"], PHYSICS} if answer else set()
    first = {key: report[key][:_MOST_LISTED] for key in ("losses", "warnings", "remarks")}
    if space := report.get("operating_space"):
        first["operating_space"] = {**space, "cells": [*map(_rounded, space["cells"])]}
    return {
        **{key: value for key, value in report.items() if key != "plan"},
        **first,
        "log": {**report["log"], "topics": [t for t in report["log"]["topics"] if t["mapped"]]},
        "estimators": [_brief_estimator(e, names) for e in report["estimators"]],
        "metrics": [m for m in report["metrics"] if m["estimator"] in names and _is_shown(m, answer["main"])],
        "segments": [s for s in report["segments"] if s["name"] in {f"{n} diverged" for n in names}][:_MOST_LISTED],
        "ledger": {
            "samples": _with_drops(report),
        },
        "checks": [c for c in report["checks"] if c["verdict"] != "passed"],
    }


def _brief_estimator(estimator: Mapping[str, Any], names: Container[str | None]) -> dict[str, Any]:
    algorithm, is_shown = estimator["algorithm"], estimator["name"] in names
    digest = None if algorithm is None else {k: v for k, v in algorithm.items() if k != "noise"}
    kept = estimator["notes"] if is_shown else []
    return {**estimator, "algorithm": digest, "notes": kept, "reasons": estimator["reasons"] if is_shown else None}


def _is_shown(metric: Mapping[str, Any], main: str) -> bool:
    """Whether a brief report keeps a figure: sideslip errors, all errors of the selected estimate, consistency, NIS."""
    signal, name = metric["signal"], metric["metric"]
    if metric["segment"] != "all":
        return signal == "sideslip_rad" and name == "rmse" and metric["segment"] in ("linear", "nonlinear")
    of_main = name == "rmse" and metric["estimator"] == main
    return of_main or (name in registered() and signal in registered()[name].brief)


def _rounded(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in cell.items()}


def _with_drops(report: Mapping[str, Any]) -> list[Any]:
    return [s for s in report["ledger"]["samples"] if s["dropped"]][:_MOST_LISTED]


def build_run(
    versions: Mapping[str, str],
    config: Mapping[str, Any],
    model: Mapping[str, str] | None,
    outcomes: Iterable[LogOutcome],
    remaining: int = 0,
    files: Mapping[str, str] | None = None,
    plan: PlanVerdicts | None = None,
) -> dict[str, Any]:
    """Return the document of run.json (schemas/run.schema.json), sealed.

    Parameters
    ----------
    versions : by distribution, see :func:`tool_versions`.
    config : the configuration in effect, as JSON-able values.
    model : ``name`` and ``sha256`` of the network; None when none ran, or not the same for all.
    outcomes : one a log. remaining : logs that are not done, for the run was ended.
    files : sha256 by name of the files beside run.json that commands read back. plan : verdicts on all logs.
    """
    document = {
        "format": "pdhef.run",
        "version": 1,
        "versions": dict(versions),
        "config": dict(config),
        "model": None if model is None else dict(model),
        **({"remaining": remaining} if remaining else {}),
        "files": dict(files or {}),
        "plan": None if plan is None else plan.to_dict(),
        "logs": [
            {
                "log": o.log,
                "file": PurePath(o.file).name,
                "folder": o.folder,
                "sha256": o.sha256,
                "signals_sha256": o.signals_sha256,
                "truth_sha256": o.truth_sha256,
                "mapping_sha256": o.mapping_sha256,
                "outcome": o.outcome,
                "main": o.main,
                "algorithms": o.algorithms,
                "car": o.car,
                "files": o.files,
                "day": o.day,
                "route": o.route,
            }
            for o in outcomes
        ],
    }
    return seal(document)


def json_bytes(document: Mapping[str, Any], *, brief: bool = False) -> bytes:
    """Return the document as indented UTF-8 JSON with sorted keys and a final line feed; NaN is null.

    ``brief``: without indentation.
    """
    layout: dict[str, Any] = {"separators": (",", ":")} if brief else {"indent": 2}
    text = json.dumps(jsonable(document), sort_keys=True, ensure_ascii=False, allow_nan=False, **layout)
    return (text + "\n").encode()


def write_json(path: Path, document: Mapping[str, Any], *, brief: bool = False) -> None:
    """Write a document through a temporary name (see :func:`json_bytes`); raises OutputError."""
    write_bytes(path, json_bytes(document, brief=brief))


def report_markdown(report: Mapping[str, Any]) -> str:
    """Return the document of :func:`build_report` in a few words, as Markdown for viewers; the page has the figures."""
    log, requirements = report["log"], (report.get("plan") or {}).get("requirements") or ()
    lines = [f"# {log['name']}", "", f"{log['file']} ({log['kind']}), {log['duration_s']:.1f} s", ""]
    lines += _bullets("Requirements", [f"**{r['outcome']}** {r['label']}: {r['reason']}" for r in requirements])
    if answer := report.get("answer"):
        lines += _bullets("Selected estimate", [text for text in answer["texts"].values() if text])
    lines += _bullets("Warnings", report["warnings"])
    lines += _bullets("Remarks", report.get("remarks", ()))
    lines += _bullets("Losses", [f"{x['what']} ({x['where']})" for x in report["losses"]])
    estimators = []
    for e in report["estimators"]:
        happened = [diverged_line(report, e["name"]), reasons_line(e, log["start_ns"])]
        skipped = [f"skipped: {e['reason']}"] if e["reason"] else []
        notes = "; ".join([*skipped, *e["notes"], *e.get("intervals", ()), *filter(None, happened)])
        kind = "causal" if e["causal"] else "not causal"
        estimators.append(f"**{e['name']}** ({kind})" + (f": {notes}" if notes else ""))
    return "\n".join([*lines, *_bullets("Estimators", estimators)])


def diverged_line(report: Mapping[str, Any], name: str) -> str:
    """Return when an estimator of a report diverged by its own account; empty if it did not."""
    spans = [s for s in report["segments"] if s["name"] == f"{name} diverged"]
    if not spans:
        return ""
    seconds = sum(s["end_ns"] - s["start_ns"] for s in spans) / 1e9
    first = (min(s["start_ns"] for s in spans) - report["log"]["start_ns"]) / 1e9
    often = "" if len(spans) == 1 else f" in {len(spans)} intervals"
    return f"diverged for {seconds:.2f} s{often}, first at {first:.2f} s"


#: A shorter interval is shown as one time.
_SHORT_S = 0.1
#: Share of the stamps inside the intervals from which on a reason counts as holding throughout.
_THROUGHOUT = 0.9


def reasons_line(estimator: Mapping[str, Any], start_ns: int) -> str:
    """Return why an estimator of a report did not use its sensors as usual, and when; empty if there is nothing.

    ``a_y spike 1.20 s, 3.45 s, 7.00 s and 9 more; gyro stuck 12.3-16.3 s``: in order of time, the longest intervals.
    """
    reasons = sorted(estimator.get("reasons") or (), key=lambda r: r["first_ns"])
    return "; ".join(_reason_text(r, start_ns) for r in reasons)


def _reason_text(reason: Mapping[str, Any], start_ns: int) -> str:
    def when(interval: Mapping[str, Any]) -> str:
        start_s, end_s = ((interval[key] - start_ns) * 1e-9 for key in ("start_ns", "end_ns"))
        return f"{start_s:.2f} s" if end_s - start_s < _SHORT_S else f"{start_s:.1f}-{end_s:.1f} s"

    more = reason["intervals"] - len(reason["longest"])
    text = f"{reason['text']} {', '.join(map(when, reason['longest']))}" + (f" and {more} more" if more else "")
    # A sensor at a lower rate than the stamps, or single spikes, do not contain throughout.
    within = reason["share_within"]
    return text if within > _THROUGHOUT else f"{text} ({within:.0%} of it)"


def _bullets(title: str, items: Sequence[str]) -> list[str]:
    return [f"## {title}", "", *(f"- {item}" for item in items), ""] if items else []
