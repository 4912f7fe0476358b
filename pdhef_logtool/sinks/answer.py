"""The answer of a run in words: how good, whether the band holds, what was assumed, what to do next.

Everything is said from the report's document, so that terminal, report.json, Markdown and recording say the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from pdhef_logtool.records.geometry import DEGREES

Report: TypeAlias = Mapping[str, Any]
#: Figures of the whole drive by estimator, signal and metric; None where there is none.
_Figures: TypeAlias = Mapping[tuple[str, str, str], float | None]

#: Share of the truth inside the 95 % band from which on it is said to hold, and nearly, and to be too wide.
HOLDS, NEARLY_HOLDS = 0.94, 0.90
_WIDE = 0.995
#: Two errors that differ by less than this share are said to be the same.
SAME = 0.03
#: A ratio below this is told with a decimal.
_FEW = 10.0
#: Rad: a truth whose sideslip stays below this on average was not measured.
NO_SIDESLIP_RAD = 1e-5
#: An estimate whose d2 is not less than this share of that of sideslip 0 has nothing to show for itself.
_LESS = 0.8
#: NIS over its degrees of freedom beyond which sensors are said to surprise a filter less or more than it expects.
_NIS_RANGE = (0.5, 2.0)
#: Share of the drive that must show its friction for an estimate of it to be called known.
_FRICTION_SHOWN = 0.1
_MOST_STEPS = 2


@dataclass(frozen=True, slots=True)
class MainFacts:
    """The estimator whose estimate is the answer, chosen without truth, and what it is shown with.

    Attributes
    ----------
    name : of it. chosen_by : evidence of the car's driving, d2, or the order of the estimators. why : in words.
    distrusted : whether d2 spoke against the one that would have been it. stands_in : what then runs under its name,
        None for itself.
    naive : what an estimate is worth anything against, None if it did not run. shown : what a person is shown; all that
        ran where the estimators were ``named``.
    """

    name: str
    chosen_by: Literal["evidence", "d2", "order"]
    why: str
    distrusted: bool
    stands_in: str | None
    naive: str | None
    shown: Sequence[str]
    named: bool


def answer_of(report: Report, main: MainFacts) -> dict[str, Any]:
    """Return the ``answer`` of a report's document: the main estimator, what was best in hindsight, and the words."""
    figures = {
        (m["estimator"], m["signal"], m["metric"]): m["value"] for m in report["metrics"] if m["segment"] == "all"
    }
    texts = {
        "result": _result(report, main, figures),
        "consistency": "" if report["truth"]["available"] else _consistency(main, figures),
        "band": _band(report, main, figures),
        "assumed": "; ".join(_assumed(report, main)),
        "next": "; ".join(_next_steps(report, main, figures)[:_MOST_STEPS]),
    }
    best = _best_in_hindsight(report, main, figures)
    return {
        "main": main.name,
        "chosen_by": main.chosen_by,
        "why": main.why,
        "distrusted": main.distrusted,
        "stands_in": main.stands_in,
        "naive": main.naive,
        "shown": list(main.shown),
        "named": main.named,
        "best_in_hindsight": best,
        "texts": texts,
    }


def degrees(value_rad: float) -> str:
    """Return an angle with as many digits as a person reads."""
    shown = value_rad * DEGREES
    return f"{shown:.3f}°" if shown < 1.0 else f"{shown:.2f}°"


def _error(figures: _Figures, name: str | None) -> float | None:
    return None if name is None else figures.get((name, "sideslip_rad", "rmse"))


def _result(report: Report, main: MainFacts, figures: _Figures) -> str:
    truth, own = report["truth"], _error(figures, main.name)
    if not truth["available"]:
        return f"sideslip is by {main.name}; how good it is cannot be told, for the log has no truth"
    if own is None:
        return f"sideslip by {main.name} is not scored: {_why_not_scored(report, main)}{_scored_instead(main, figures)}"
    said = [f"sideslip by {main.name} is {degrees(own)} RMSE off {_truth_of(report, 'sideslip_rad')}"]
    rivals = [
        (name, text) for name, text in (("physics", "physics alone"), ("zero", "sideslip 0")) if name != main.name
    ]
    others = [(text, other) for name, text in rivals if (other := _error(figures, name)) is not None]
    said += [_against(own, other, text) for text, other in others]
    if "sideslip_rad" in truth["not_independent"]:
        said.append("that truth is an input or the estimate itself: no independent check")
    if (measured := figures.get(("zero", "sideslip_rad", "rmse"))) is not None and measured < NO_SIDESLIP_RAD:
        said.append("but that truth's sideslip is 0 throughout, as of one that does not measure it")
    naive = None if main.name == main.naive else _error(figures, main.naive)
    useless = ". It is of no use here" if naive is not None and own > (1.0 + SAME) * naive else ""
    return ", ".join(said) + useless


def _against(own: float, other: float, text: str) -> str:
    beside = f"{text} ({degrees(other)})"
    if other == own:
        return f"the same as {beside}"
    if abs(own - other) <= SAME * other:
        return f"as good as {beside}"
    if own == 0.0 or other == 0.0:
        return f"{'nearer' if own < other else 'farther off'} than {beside}"
    times = max(own, other) / min(own, other)
    shown = f"{times:.1f}" if times < _FEW else f"{times:.0f}"
    if own > other:
        return (
            f"{shown} times as far off as {beside}" if times > 2.0 else f"{times - 1.0:.0%} farther off than {beside}"
        )
    return f"{shown} times nearer than {beside}" if times > 2.0 else f"{1.0 - own / other:.0%} nearer than {beside}"


def _truth_of(report: Report, name: str) -> str:
    """Return the topics that a truth quantity comes from, as far as its derivation names them."""
    by_name = {q["name"]: q for q in report["truth"]["quantities"]}
    parts = [by_name[n] for n in (name, "vx_m_s", "vy_m_s") if n in by_name]
    words = " ".join(f"{q['source']} {q['derivation']}" for q in parts).replace(",", " ").split()
    topics = dict.fromkeys(w.partition(".")[0] for w in words if w.startswith("/"))
    return f"the truth of {' and '.join(topics)}" if topics else "the truth"


def _why_not_scored(report: Report, main: MainFacts) -> str:
    quantities = {q["name"]: q for q in report["truth"]["quantities"]}
    if "sideslip_rad" in quantities:
        return f"nowhere is its truth known where {main.name} is valid and the car fast enough"
    if "no heading known" in quantities.get("vx_m_s", {}).get("derivation", ""):
        return (
            "the truth knows where the car moves (GNSS), not where it points; sideslip is the difference of the two "
            "and needs two antennas or an INS"
        )
    return f"the truth has only {', '.join(quantities) or 'no quantity'}"


def _scored_instead(main: MainFacts, figures: _Figures) -> str:
    shown = (("yaw_rate_rad_s", "yaw rate", DEGREES, "°/s"), ("vx_m_s", "v_x", 1.0, " m/s"))
    found = [
        f"{text} {value * factor:.2f}{unit}"
        for signal, text, factor, unit in shown
        if (value := figures.get((main.name, signal, "rmse"))) is not None
    ]
    return f". RMSE of what is: {', '.join(found)}" if found else ""


def _consistency(main: MainFacts, figures: _Figures) -> str:
    """Return what the figures that need no truth say of the main estimator, in words."""
    said = []
    d2, naive = (figures.get((n, "vy_m_s", "d2")) for n in (main.name, main.naive or ""))
    if main.name == "kinematic":
        said.append("it integrates the very sensors that it could be held against, so that nothing checks it")
    elif d2 is not None:
        follows = f"over 2 s its lateral velocity follows accelerometer and gyro to {d2:.2f} m/s (d2)"
        if naive is None or main.name == main.naive:
            said.append(follows)
        elif d2 < _LESS * naive:
            said.append(f"{follows}, sideslip 0 to {naive:.2f}: nothing contradicts it, which is no proof")
        else:
            said.append(
                f"{follows}, which sideslip 0 does too ({naive:.2f}): little sideslip, a biased accelerometer, a "
                "banked road or a wrong model, so that it tells nothing"
            )
    nis, dof = (figures.get((main.name, "state", metric)) for metric in ("nis", "nis_dof"))
    if nis is not None and dof:
        low, high = _NIS_RANGE
        how = "less than" if nis < low * dof else "more than" if nis > high * dof else "about as much as"
        hence = {
            "less than": ", so that its own 1-sigma is rather too wide",
            "more than": ": model or noise are wrong, its own 1-sigma is too narrow",
        }
        said.append(f"its sensors surprise it {how} it expects (NIS/dof {nis / dof:.2f}){hence.get(how, '')}")
    return "; ".join(said)


def _band(report: Report, main: MainFacts, figures: _Figures) -> str:
    notes: Sequence[str] = next((e["intervals"] for e in report["estimators"] if e["name"] == main.name), [])
    if not notes:
        return f"none: {main.name} gives no interval"
    made = f" ({'; '.join(notes)})"
    share = figures.get((main.name, "sideslip_rad", "coverage95"))
    if share is None:
        return f"not checked, for want of a truth of sideslip{made}"
    if share >= HOLDS:
        wide = ", and is wider than it need be" if share > _WIDE else ""
        return f"holds{wide}: the truth is inside {share:.0%} of the time{made}"
    verdict = "nearly holds" if share >= NEARLY_HOLDS else "does not hold, it is too narrow"
    return f"{verdict}: the truth is inside only {share:.0%} of the time{made}"


def _assumed(report: Report, main: MainFacts) -> list[str]:
    vehicle, friction = report["vehicle"], report["friction"]
    own = next(e for e in report["estimators"] if e["name"] == main.name)
    modelled = own["algorithm"] is not None and own["algorithm"]["physics_sha256"] is not None
    calibration = report["self_calibration"]
    calibrated = calibration is not None and modelled and not calibration["refused"] and not own["causal"]
    if not modelled:
        said = [f"no model of the car: {main.name} needs none"]
    elif calibrated:
        where = "this log" if calibration["logs"] == 1 else f"{calibration['logs']} logs"
        said = [_car(vehicle), f"calibrated on {where} without truth and so not causal"]
    elif vehicle["file"] is None:
        said = [_car(vehicle)]
    else:
        proven = "proven by driving with truth" if vehicle["proven"] else "as its file has it, which no driving proved"
        said = [f"{_car(vehicle)}, {proven}"]
    if calibration is not None and modelled:
        if calibration["refused"]:
            said.append(f"not calibrated on this log: {calibration['refused']}")
        if calibration["understeer"] is not None and calibration["understeer"]["contradicts"]:
            said.append("the drive understeers otherwise than the file")
    if friction is not None and modelled:
        said.append(f"friction {_friction(friction)}")
    if main.distrusted:
        said.append(main.why)
    algorithm = own["algorithm"] or {"options": {}}
    trust = algorithm["options"].get("trust", 0.0 if algorithm.get("algorithm") == "adaptive-physics" else None)
    if trust is not None:
        found = f"network trusted at {trust:g} by the car's evidence"
        said.append(found if trust else "no network, for want of evidence that it helps")
    return said


def _friction(friction: Mapping[str, Any]) -> str:
    source: str = friction["source"]
    if friction["estimated"]:
        return f"estimated ({friction['summary']})"
    return source if source.startswith("assumed") else f"told ({source})"


def _car(vehicle: Mapping[str, Any]) -> str:
    return "the default sedan, for no car was given" if vehicle["file"] is None else f"car {vehicle['file']}"


def _next_steps(report: Report, main: MainFacts, figures: _Figures) -> list[str]:
    """Return what would help, the most important first."""
    vehicle, steps = report["vehicle"], []
    if any(c["verdict"] == "failed" and not c["waived"] for c in report.get("checks", ())):
        steps.append("mend what failed above, or waive it by name")
    lacks = {e["reason"] for e in report["estimators"] if e["name"] == "physics" and e["outcome"] == "skipped"}
    steps += [f"map what is missing, for {reason} (pdhef map LOG)" for reason in lacks]
    if vehicle["file"] is None:
        steps.append("name your car: --car vehicle.toml with mass, geometry and tyres (docs/car.md)")
    elif main.distrusted:
        steps.append("look over the vehicle file: mass, wheelbase, tyres, steering ratio")
    share = figures.get((main.name, "sideslip_rad", "coverage95"))
    if vehicle["file"] is not None and not vehicle["proven"]:
        given = f"--car {vehicle['file']} -o mycar"
        steps.append(
            f"let this truth teach and prove the car: pdhef learn LOG {given}"
            if _error(figures, main.name) is not None
            else f"let several logs of the car teach it: pdhef learn LOGS {given} --without-truth"
        )
    if vehicle["proven"] and share is not None and share < NEARLY_HOLDS:
        steps.append("make the band anew from drives like this one: pdhef learn --stages intervals")
    friction = report["friction"]
    if friction is not None and friction["estimated"] and (friction["observable_share"] or 0.0) < _FRICTION_SHOWN:
        steps.append("tell the friction if you know the road: --friction 0.8")
    return steps


def _best_in_hindsight(report: Report, main: MainFacts, figures: _Figures) -> dict[str, Any] | None:
    """Return the estimator with the least error by this log's truth, None without one; nothing is chosen by it."""
    ran = [e["name"] for e in report["estimators"] if e["outcome"] == "ran"]
    errors = {name: error for name in ran if (error := _error(figures, name)) is not None}
    if not errors:
        return None
    best = min(errors, key=lambda name: (errors[name], name != main.name))
    causal = next(e["causal"] for e in report["estimators"] if e["name"] == best)
    return {"name": best, "causal": causal, "sideslip_rmse_rad": errors[best]}
