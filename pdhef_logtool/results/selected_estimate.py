"""The result of a run in sentences: error, coverage of the interval, assumptions, next steps.

The report's document is the only source, so that terminal, report.json, Markdown and recording agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.requirement_blocks import from_document
from pdhef_logtool.evaluation.requirement_bounds import LEAST_BLOCKS, pooled
from pdhef_logtool.evaluation.validation_plan import SIDESLIP
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.storage.templates import one_line, template

#: Templates of texts and files of results.
TEMPLATES = Path(__file__).parent / "templates"

Report: TypeAlias = Mapping[str, Any]
#: Figures of the whole drive by estimator, signal and metric; None if absent.
_Figures: TypeAlias = Mapping[tuple[str, str, str], float | None]

#: Coverage of the 95 % interval from which on it is as stated, nearly, and wider than necessary.
HOLDS, NEARLY_HOLDS = 0.94, 0.90
_WIDE = 0.995
#: Two errors that differ by less than this share are reported as equal.
SAME = 0.03
#: A ratio below this is printed with a decimal.
_FEW = 10.0
#: rad; ground truth with an RMS sideslip below this does not measure it.
NO_SIDESLIP_RAD = 1e-5
#: Ratio of the lateral consistency residual to the one of zero sideslip; above it the residual is not conclusive.
_LESS = 0.8
#: Range of the NIS per degree of freedom (expected value 1) that is reported as consistent.
_NIS_RANGE = (0.5, 2.0)
_MOST_STEPS = 2


@dataclass(frozen=True, slots=True)
class MainFacts:
    """The selected estimator, chosen without ground truth, and the tracks shown with it.

    Attributes
    ----------
    name : of it. chosen_by : evidence of the car's driving, consistency, or estimator order. why : in words.
    distrusted : whether the lateral consistency contradicts the preferred one.
    naive : the estimator to beat, None if it did not run. shown : displayed tracks; all if the estimators were
        ``named``.
    """

    name: str
    chosen_by: Literal["evidence", "d2", "order"]
    why: str
    distrusted: bool
    naive: str | None
    shown: Sequence[str]
    named: bool


def answer_of(report: Report, main: MainFacts) -> dict[str, Any]:
    """Return the ``answer`` of a report's document: the selected estimator, the best in hindsight, and the words."""
    figures = {
        (m["estimator"], m["signal"], m["metric"]): m["value"] for m in report["metrics"] if m["segment"] == "all"
    }

    def value(name: str | None, metric: str, signal: str = "sideslip_rad") -> float | None:
        return None if name is None else figures.get((name, signal, metric))

    words = _words()
    intervals = next((e["intervals"] for e in report["estimators"] if e["name"] == main.name), ())
    interval = _interval(report)
    texts = {
        "result": words.result(report, main, value, interval),
        "consistency": "" if report["truth"]["available"] else words.consistency(main, value),
        "band": words.band(main, intervals, value(main.name, "coverage95")),
        "assumed": "; ".join(_assumed(report, main)),
        "next": "; ".join(_next_steps(report, main)[:_MOST_STEPS]),
    }
    texts = {key: one_line(text) for key, text in texts.items()}
    best = _best_in_hindsight(report, main, figures)
    chosen = {"main" if key == "name" else key: value for key, value in asdict(main).items()}
    shown = {"shown": list(main.shown), "sideslip_rmse_ci_rad": interval}
    return {**chosen, **shown, "best_in_hindsight": best, "texts": texts}


def _interval(report: Report) -> list[float] | None:
    """Return the 95 % CI of the sideslip RMSE of the selected estimate in rad, None with too few blocks of time."""
    blocks = from_document(report.get("requirement_blocks") or ())
    of = next((b for b in blocks if b.of == SIDESLIP.measured and not b.estimated and len(b.n) >= LEAST_BLOCKS), None)
    if of is None:
        return None
    counts, values = np.array(of.n, dtype=np.float64), np.array(of.value)
    bounded = pooled(counts, values, None, squares=True, positive=True, level=0.95)
    return [bounded.low, bounded.high]


@cache
def _words() -> Any:
    """Return the sentences of ``selected_estimate.txt`` as functions."""
    limits: dict[str, Any] = {
        "HOLDS": HOLDS,
        "NEARLY_HOLDS": NEARLY_HOLDS,
        "WIDE": _WIDE,
        "SAME": SAME,
        "FEW": _FEW,
        "LESS": _LESS,
    }
    limits |= {"NO_SIDESLIP_RAD": NO_SIDESLIP_RAD, "NIS_RANGE": _NIS_RANGE, "DEGREES": DEGREES}
    shown = {"degrees": degrees, "percent": lambda share: f"{100.0 * share:.0f}", "truth_of": truth_of}
    return template(TEMPLATES / "selected_estimate.txt", **limits, **shown).module


def degrees(value_rad: float) -> str:
    """Return an angle with as many digits as a person reads."""
    shown = value_rad * DEGREES
    return f"{shown:.3f}°" if shown < 1.0 else f"{shown:.2f}°"


def _error(figures: _Figures, name: str | None) -> float | None:
    return None if name is None else figures.get((name, "sideslip_rad", "rmse"))


def truth_of(report: Report, name: str) -> str:
    """Return the topics that a ground truth quantity comes from, as far as its derivation names them."""
    by_name = {q["name"]: q for q in report["truth"]["quantities"]}
    parts = [by_name[n] for n in (name, "vx_m_s", "vy_m_s") if n in by_name]
    words = " ".join(f"{q['source']} {q['derivation']}" for q in parts).replace(",", " ").split()
    topics = dict.fromkeys(w.partition(".")[0] for w in words if w.startswith("/"))
    return f"ground truth: {' and '.join(topics)}" if topics else "ground truth"


def friction_text(friction: Mapping[str, Any]) -> str:
    """Return the source of a friction with its topic or value."""
    value = None if friction["value"] is None else f"{friction['value']:.3g}"
    return ", ".join(filter(None, (friction["source"], friction["topic"], value)))


def _assumed(report: Report, main: MainFacts) -> list[str]:
    friction, calibration = report["friction"], report["self_calibration"]
    estimator = next(e for e in report["estimators"] if e["name"] == main.name)
    modelled = estimator["algorithm"] is not None and estimator["algorithm"]["physics_sha256"] is not None
    said = _model(report, estimator["causal"]) if modelled else [f"no vehicle model ({main.name} needs none)"]
    if calibration is not None and modelled:
        if calibration["refused"]:
            said.append(f"not calibrated on this log: {calibration['refused']}")
        elif not calibration["parameters"]:
            said.append(calibration["text"])
    if friction is not None and modelled:
        said.append(f"friction {'given' if friction['given'] else 'not given'} ({friction_text(friction)})")
    if main.distrusted:
        said.append(main.why)
    algorithm = estimator["algorithm"] or {"options": {}}
    trust = algorithm["options"].get("trust", 0.0 if algorithm.get("algorithm") == "adaptive-physics" else None)
    if trust is not None:
        unused = "residual not used: no network was trained with the physics of this car"
        said.append(f"residual gain {trust:g} within the region of validity" if trust else unused)
    return said


def _model(report: Report, causal: bool) -> list[str]:
    """Return the car of an estimator with a vehicle model, and its evidence."""
    vehicle, calibration = report["vehicle"], report["self_calibration"]
    used = calibration is not None and not calibration["refused"]
    taught = f", taught by {vehicle['taught']}" if vehicle.get("taught") else ""
    if used and not causal:
        return [_car(vehicle) + taught, "calibrated on this log without ground truth, therefore not causal"]
    if vehicle["file"] is None:
        return [_car(vehicle)]
    proven = "validated on drives with ground truth" if vehicle["proven"] else "parameters of its file, not validated"
    return [f"{_car(vehicle)}{taught or f', {proven}'}"]


def _car(vehicle: Mapping[str, Any]) -> str:
    return "default sedan (no car given)" if vehicle["file"] is None else f"car {vehicle['file']}"


def _next_steps(report: Report, main: MainFacts) -> list[str]:
    """Return the remedies, most important first."""
    vehicle, steps = report["vehicle"], []
    if any(c["verdict"] == "failed" and not c["waived"] for c in report.get("checks", ())):
        steps.append("correct the failed checks below, or waive them by name")
    lacks = {e["reason"] for e in report["estimators"] if e["name"] == "physics" and e["outcome"] == "skipped"}
    steps += [f"map the missing signals ({reason}): pdhef map LOG" for reason in lacks]
    if vehicle["file"] is None:
        steps.append("give your car: --car vehicle.toml with mass, geometry and tyres (docs/car.md)")
    elif main.distrusted:
        steps.append("check the vehicle file: mass, wheelbase, tyres, steering ratio")
    if vehicle["file"] is not None and not (vehicle["proven"] or vehicle.get("taught")):
        steps.append(f"learn the car from its drives: pdhef learn LOGS --car {vehicle['file']} -o mycar")
    friction = report["friction"]
    if friction is not None and not friction["given"] and vehicle["file"] is not None:
        steps.append("give the friction if it is known: --friction 0.8")
    return steps


def _best_in_hindsight(report: Report, main: MainFacts, figures: _Figures) -> dict[str, Any] | None:
    """Return the estimator with the least error against ground truth, None without it; for display only."""
    ran = [e["name"] for e in report["estimators"] if e["outcome"] == "ran" and e["name"] != REFERENCE]
    errors = {name: error for name in ran if (error := _error(figures, name)) is not None}
    if not errors:
        return None
    best = min(errors, key=lambda name: (errors[name], name != main.name))
    causal = next(e["causal"] for e in report["estimators"] if e["name"] == best)
    return {"name": best, "causal": causal, "sideslip_rmse_rad": errors[best]}
