"""The result of a run in sentences: error, coverage of the interval, assumptions, next steps.

The report's document is the only source, so that terminal, report.json, Markdown and recording agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.requirement_blocks import from_document
from pdhef_logtool.evaluation.statistics import LEAST_BLOCKS, pooled
from pdhef_logtool.evaluation.validation_plan import SIDESLIP
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.storage.templates import clauses, one_line, template

#: Templates of texts and files of results.
TEMPLATES = Path(__file__).parent / "templates"

Report: TypeAlias = Mapping[str, Any]
#: Values of metrics by estimator, signal, segment and metric.
Figures: TypeAlias = dict[tuple[str, str, str, str], float | None]

#: Coverage of the 95 % interval from which on it is nearly as stated.
NEARLY_HOLDS = 0.90
#: Two errors that differ by less than this share are reported as equal.
SAME = 0.03
_MOST_STEPS = 2
#: The baseline of every score. It needs the fewest signals and cannot drift; ``kinematic`` follows the accelerometer's
#: bias and has a higher error on half of the recorded drives.
NAIVE = "zero"


@dataclass(frozen=True, slots=True)
class MainFacts:
    """The selected estimator, chosen without ground truth, and the tracks shown with it.

    Attributes
    ----------
    name : of it. why : in words.
    distrusted : whether the lateral consistency contradicts the preferred one.
    naive : the estimator to beat, None if it did not run. shown : displayed tracks; all if the estimators were
        ``named``.
    """

    name: str
    why: str
    distrusted: bool
    naive: str | None
    shown: Sequence[str]
    named: bool


def answer_of(report: Report, main: MainFacts) -> dict[str, Any]:
    """Return the ``answer`` of a report: the reason of the selection, and the result in words."""
    figures = figures_of(report)

    def value(name: str | None, metric: str, signal: str = "sideslip_rad") -> float | None:
        return figures.get((name or "", signal, "all", metric))

    words = _words()
    intervals = next((e["intervals"] for e in report["estimators"] if e["name"] == main.name), ())
    interval = _interval(report)
    texts = {
        "result": words.result(report, main, value, interval),
        "consistency": "" if report["truth"]["available"] else words.consistency(main, value),
        "band": words.band(main, intervals, value(main.name, "coverage95")),
        "hindsight": words.hindsight(_best_in_hindsight(report, main, figures), main),
        "assumed": "; ".join(clauses(words.assumed(report, main))),
        "next": "; ".join(clauses(words.next(report, main, value))[:_MOST_STEPS]),
    }
    texts = {key: one_line(text) for key, text in texts.items()}
    chosen = {"why": main.why, "named": main.named, "shown": list(main.shown)}
    return {**chosen, "sideslip_rmse_ci_rad": interval, "texts": texts}


def figures_of(report: Report) -> Figures:
    """Return the figures of a document.

    ``nis_ratio`` is the NIS per degree of freedom, ``from_main`` the difference from the selected estimate.
    """
    values = {(m["estimator"], m["signal"], m["segment"], m["metric"]): m["value"] for m in report["metrics"]}
    main = report.get("selected_estimate")
    for (name, signal, segment, metric), value in [*values.items()]:
        if metric == "nis" and value is not None and (dof := values.get((name, signal, segment, "nis_dof"))):
            values[name, signal, segment, "nis_ratio"] = value / dof
        if metric == "disagreement_rms" and main in (pair := name.split("~")):
            values[next((n for n in pair if n != main), name), signal, segment, "from_main"] = value
    return values


def _interval(report: Report) -> list[float] | None:
    """Return the 95 % CI of the sideslip RMSE of the selected estimate in rad, None with too few blocks of time."""
    blocks = from_document(report.get("requirement_blocks") or ())
    of = next((b for b in blocks if b.of == SIDESLIP.measured and not b.estimated and len(b.n) >= LEAST_BLOCKS), None)
    if of is None:
        return None
    counts, values = np.array(of.n, dtype=np.float64), np.array(of.value)
    bounded = pooled(counts, values, None, squares=True, positive=True)
    return [bounded.low, bounded.high]


@cache
def _words() -> Any:
    """Return the sentences of ``selected_estimate.txt`` as functions."""
    functions = {"degrees": degrees, "truth_of": truth_of, "is_worse": is_worse}
    limits = {"NEARLY_HOLDS": NEARLY_HOLDS, "SAME": SAME, "DEGREES": DEGREES}
    return template(TEMPLATES / "selected_estimate.txt", **limits, **functions).module


def result_of(report: Report) -> str:
    """Return the result of a document in a sentence: of the selected estimate, or of recorded estimates."""
    if report["answer"] is not None:
        return str(report["answer"]["texts"]["result"])
    names, figures = [e["name"] for e in report["estimators"] if e["outcome"] == "ran"], figures_of(report)
    errors = {name: figures.get((name, "sideslip_rad", "all", "rmse")) for name in names}
    return one_line(_words().recorded(report, names, {k: v for k, v in errors.items() if v is not None}))


def assumptions_of(report: Report) -> list[str]:
    """Return the assumptions of the result of a document, as independent clauses."""
    if report["answer"] is not None:
        return [clause for clause in report["answer"]["texts"]["assumed"].split("; ") if clause]
    return clauses(_words().assumed_of_recorded(report["vehicle"]))


def failed_checks(report: Report) -> list[str]:
    """Return the failed checks of a document, waived ones too, with their findings and remedies."""
    return [
        f"{'waived' if c['waived'] else 'FAILED'}: {c['name']}: {c['evidence'].rstrip('.')}"
        + (f". Remedy: {c['remedy']}" if c["remedy"] else "")
        for c in report.get("checks") or ()
        if c["verdict"] == "failed"
    ]


def degrees(value_rad: float) -> str:
    """Return an angle in degrees as text, with digits by its size."""
    shown = value_rad * DEGREES
    return f"{shown:.3f}°" if abs(shown) < 1.0 else f"{shown:.2f}°"


def is_worse(error: float | None, naive: float | None) -> bool:
    """Return whether an RMSE is clearly above the one of the estimator to beat; False without either."""
    return error is not None and naive is not None and error > (1.0 + SAME) * naive


def truth_of(report: Report, name: str) -> str:
    """Return the topics that a ground truth quantity comes from, as far as its derivation names them."""
    sources = report["truth"]["quantities"]
    words = " ".join(sources.get(n, "") for n in (name, "vx_m_s", "vy_m_s")).replace(",", " ").split()
    topics = dict.fromkeys(w.partition(".")[0] for w in words if w.startswith("/"))
    return f"ground truth: {' and '.join(topics)}" if topics else "ground truth"


def _best_in_hindsight(report: Report, main: MainFacts, figures: Figures) -> dict[str, Any] | None:
    """Return the estimator with the least error against ground truth, None without it; for display only."""
    ran = [e for e in report["estimators"] if e["outcome"] == "ran" and e["name"] != REFERENCE]
    errors = [{**e, "sideslip_rmse_rad": figures.get((e["name"], "sideslip_rad", "all", "rmse"))} for e in ran]
    scored = [e for e in errors if e["sideslip_rmse_rad"] is not None]
    return min(scored, key=lambda e: (e["sideslip_rmse_rad"], e["name"] != main.name), default=None)
