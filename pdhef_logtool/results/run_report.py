"""report.json of one log, run.json of a run, and the report as Markdown; plain records in, plain JSON out."""

import importlib.metadata
import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path, PurePath
from typing import Any

from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.compiled.sources import compiled_digest
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.units import LABELS
from pdhef_logtool.records.printable import listed, printable
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.selected_estimate import NEARLY_HOLDS, TEMPLATES, MainFacts, answer_of, failed_checks
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.documents import jsonable, seal
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import lines, template

#: Columns of a figure in the report.
_METRIC_COLUMNS = ("estimator", "signal", "segment", "metric", "value", "unit", "n")
#: Figures of a drive without ground truth.
_BY_REFERENCE = ("reference_rms", "reference_std", "disagreement_rms")
#: Entries of a verdict on one drive; tables/verdicts.parquet has all.
_OF_VERDICT = ("id", "label", "outcome", "reason", "next")
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
    ``failed_checks``: number of those that are not waived.
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
    failed_checks: int = 0

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
    """Return the versions, and the digest under which compiled code is kept."""
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
    intervals), ``algorithm``.
    """
    unstated = {"reason": None, "algorithm": None, "notes": (), "intervals": ()}
    return {"name": name, "causal": causal, "outcome": outcome, **unstated, **stated}


def build_report(content: Mapping[str, Any], main: MainFacts | None = None) -> dict[str, Any]:
    """Return the document of report.json (schemas/report.schema.json); NaN becomes None.

    Parameters
    ----------
    content : entries of the document as records or JSON-able values, ``metrics`` as rows of metrics.parquet, which
        are selected here.
    main : the selected estimate, None without one.
    """
    rows = [m for m in content["metrics"] if _is_shown(m, main)]
    metrics = [{name: getattr(m, name) for name in _METRIC_COLUMNS} for m in rows]
    entries = {"format": "pdhef.report", "version": 2, **content, "metrics": metrics}
    if entries.get("plan") is not None:
        verdicts = [{k: v[k] for k in _OF_VERDICT} for v in entries["plan"]["requirements"]]
        entries["plan"] = {"file": entries["plan"]["file"], "requirements": verdicts}
    document = {key: jsonable(value) for key, value in entries.items()}
    answer = None if main is None else answer_of(document, main)
    return document | {"selected_estimate": main and main.name, "answer": answer}


def _is_shown(metric: MetricRow, main: MainFacts | None) -> bool:
    """Whether the document has a figure: of the whole drive those that people read, of segments the RMSE of sideslip.

    Estimators that are not displayed with ``main``, the selected estimate, have their RMSE of sideslip alone. Two
    estimates are compared only with it.
    """
    is_error = (metric.signal, metric.metric) == ("sideslip_rad", "rmse")
    if main is not None and metric.estimator not in (*main.shown, PHYSICS, TRUTH):
        pair = metric.estimator.split("~")
        return metric.segment == "all" and (is_error or (main.name in pair and metric.metric == "disagreement_rms"))
    entry = registered().get(metric.metric)
    is_read = metric.metric in _BY_REFERENCE or (entry and metric.signal in (*entry.terminal, *entry.brief))
    return is_error or (metric.segment == "all" and bool(is_read))


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
    return {key: value for key, value in entry.items() if key not in ("failed", "lost", "failed_checks")}


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Return the document as indented UTF-8 JSON with sorted keys and a final line feed; NaN is null."""
    text = json.dumps(jsonable(document), sort_keys=True, ensure_ascii=False, allow_nan=False, indent=1)
    return (text + "\n").encode()


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document through a temporary name (see :func:`json_bytes`); raises OutputError."""
    write_bytes(path, json_bytes(document))


def report_markdown(report: Mapping[str, Any]) -> str:
    """Return the document of :func:`build_report` in a few words, as Markdown for viewers; the page has the figures."""
    return template(TEMPLATES / "report.md", lines_of=lines_of).render(report=report)


@cache
def _lines() -> Any:
    words = {"LABELS": LABELS, "MANOEUVRES": MANOEUVRES, "NEARLY_HOLDS": NEARLY_HOLDS}
    functions = {f.__name__: f for f in (failed_checks, gathered, listed, printable)}
    return template(TEMPLATES / "lines.txt", **words, **functions).module


def lines_of(about: str, report: Mapping[str, Any], *more: Any) -> list[str]:
    """Return the lines of ``lines.txt`` about a part of a report: ``diverged``, ``faults``, ``losses`` and others."""
    return lines(getattr(_lines(), about)(report, *more))
