"""report.json of one log, run.json of a run, and the report as Markdown; plain records in, plain JSON out."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.compiled.sources import compiled_digest
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.results.selected_estimate import TEMPLATES, MainFacts, answer_of
from pdhef_logtool.storage.documents import jsonable, seal
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import template

if TYPE_CHECKING:
    from pathlib import Path

    from pdhef_logtool.results.plan_verdicts import PlanVerdicts

#: Columns of a figure in the report.
_METRIC_COLUMNS = ("log", "estimator", "signal", "segment", "metric", "value", "unit", "n")
#: Entries that a brief report keeps of a list.
_MOST_LISTED = 5
#: Distributions that affect the results of a run; their versions are recorded.
VERSIONED = ("pdhef-logtool", "mcap", "numba", "numpy", "polars", "pyarrow", "rerun-sdk", "rosbags", "scipy", "torch")


@dataclass(frozen=True, slots=True)
class LogOutcome:
    """Outcome of one log of a run, with its car; None: the log was not read, or no estimator ran.

    ``failed`` is the one-line reason if there is no result; ``lost`` lists the parts of the log that are not used.
    ``car``: see :func:`car_entry`.
    ``main``: the estimator of the selected estimate. ``folder`` of the log, below the folder of the run.
    ``algorithms``: the identity of each estimator that ran. ``files``: sha256 by name of the files in the log's folder
    that commands read back. ``day`` (UTC) and ``route``: drives that share them depend on one another.
    """

    log: str
    file: str
    sha256: str | None
    failed: str | None = None
    lost: Sequence[str] = ()
    car: Mapping[str, Any] | None = None
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
    """Return the versions of Python and of the installed distributions that affect results."""
    return {"python": platform.python_version(), **{name: v for name in VERSIONED if (v := _installed(name))}}


def run_versions() -> dict[str, str]:
    """Return the same and the digest that compiled code is kept under."""
    return {**tool_versions(), "compiled": compiled_digest()}


@cache
def _installed(distribution: str) -> str | None:
    """Return the version of a distribution, None if it is not installed; the file is read once per process."""
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(distribution)
    return None


def estimator_entry(name: str, *, causal: bool, outcome: str = "ran", **stated: Any) -> dict[str, Any]:
    """Return the entry of an estimator in a report.

    ``stated``: ``reason`` if it was skipped or failed, ``notes`` on itself, ``intervals`` (origin of its 95 %
    intervals), ``reasons`` why it did not use its sensors as usual (None: it does not monitor them), ``algorithm``.
    """
    unstated = {"reason": None, "algorithm": None, "notes": (), "intervals": (), "reasons": None}
    return {"name": name, "causal": causal, "outcome": outcome, **unstated, **stated}


def build_report(content: Mapping[str, Any], main: MainFacts | None = None) -> dict[str, Any]:
    """Return the document of report.json (schemas/report.schema.json); NaN becomes None.

    Parameters
    ----------
    content : entries of the document as records or JSON-able values, ``metrics`` as rows of metrics.parquet.
    main : the selected estimate, None without one.
    """
    metrics = [{name: getattr(m, name) for name in _METRIC_COLUMNS} for m in content["metrics"]]
    entries = {"format": "pdhef.report", "version": 1, **content, "metrics": metrics}
    document = {key: jsonable(value) for key, value in entries.items()}
    if main is None:
        return document | {"selected_estimate": None, "answer": None}
    return document | {"selected_estimate": main.name, "answer": answer_of(document, main)}


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
    config: Mapping[str, Any],
    network: tuple[str, str] | None,
    outcomes: Iterable[LogOutcome],
    *,
    remaining: int = 0,
    files: Mapping[str, str] | None = None,
    plan: PlanVerdicts | None = None,
) -> dict[str, Any]:
    """Return the document of run.json (schemas/run.schema.json), sealed.

    Parameters
    ----------
    config : the configuration in effect, as JSON-able values.
    network : name and digest; None when none ran, or if the logs have different ones.
    outcomes : one per log. remaining : number of logs that are not done, because the run was interrupted.
    files : sha256 by name of the files beside run.json that commands read. plan : verdicts on all logs.
    """
    document = {
        "format": "pdhef.run",
        "version": 1,
        "versions": run_versions(),
        "config": dict(config),
        "model": None if network is None else dict(zip(("name", "sha256"), network, strict=True)),
        **({"remaining": remaining} if remaining else {}),
        "files": dict(files or {}),
        "plan": None if plan is None else plan.to_dict(),
        "logs": [_run_entry(o) for o in outcomes],
    }
    return seal(document)


def _run_entry(outcome: LogOutcome) -> dict[str, Any]:
    entry = asdict(outcome) | {"file": PurePath(outcome.file).name, "outcome": outcome.outcome}
    return {key: value for key, value in entry.items() if key not in ("failed", "lost")}


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
    context = {"diverged_line": diverged_line, "reasons_line": reasons_line}
    return template(TEMPLATES / "report.md", **context).render(report=report)


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
    """Return why an estimator of a report did not use its sensors as usual, and when; empty without a reason.

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
