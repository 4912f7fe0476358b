"""The result of a run in sentences: error, coverage of the interval, assumptions, next steps.

The report's document is the only source, so that terminal, report.json, Markdown and recording agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.tracks import REFERENCE

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
#: Share of the drive in which friction must be observable for its estimate to count.
_FRICTION_SHOWN = 0.1
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
    texts = {
        "result": _result(report, main, figures),
        "consistency": "" if report["truth"]["available"] else _consistency(main, figures),
        "band": _band(report, main, figures),
        "assumed": "; ".join(_assumed(report, main)),
        "next": "; ".join(_next_steps(report, main, figures)[:_MOST_STEPS]),
    }
    best = _best_in_hindsight(report, main, figures)
    chosen = {"main" if key == "name" else key: value for key, value in asdict(main).items()}
    return {**chosen, "shown": list(main.shown), "best_in_hindsight": best, "texts": texts}


def degrees(value_rad: float) -> str:
    """Return an angle with as many digits as a person reads."""
    shown = value_rad * DEGREES
    return f"{shown:.3f}°" if shown < 1.0 else f"{shown:.2f}°"


def _error(figures: _Figures, name: str | None) -> float | None:
    return None if name is None else figures.get((name, "sideslip_rad", "rmse"))


def _result(report: Report, main: MainFacts, figures: _Figures) -> str:
    truth, rmse = report["truth"], _error(figures, main.name)
    if not truth["available"]:
        return f"Sideslip estimate: {main.name}; {_from_reference(report, main, figures)}"
    if rmse is None:
        return f"Sideslip of {main.name} is not scored: {_why_not_scored(report, main)}{_scored_instead(main, figures)}"
    said = [f"Sideslip RMSE of {main.name}: {degrees(rmse)} ({truth_of(report, 'sideslip_rad')})"]
    rivals = [(name, text) for name, text in (("physics", "physics"), ("zero", "zero sideslip")) if name != main.name]
    others = [(text, other) for name, text in rivals if (other := _error(figures, name)) is not None]
    others = [(text, other) for text, other in others if (text, other) != ("physics", rmse)]  # residual gain 0
    said += [_against(rmse, other, text) for text, other in others]
    if "sideslip_rad" in truth["not_independent"]:
        said.append("the ground truth is an input of the estimator or the estimate itself: not an independent check")
    if (measured := figures.get(("zero", "sideslip_rad", "rmse"))) is not None and measured < NO_SIDESLIP_RAD:
        said.append("the sideslip of the ground truth is 0 throughout: it is probably not measured")
    naive = None if main.name == main.naive else _error(figures, main.naive)
    useless = (
        ". On this drive the estimate is worse than a constant"
        if naive is not None and rmse > (1.0 + SAME) * naive
        else ""
    )
    return ", ".join(said) + useless


def _from_reference(report: Report, main: MainFacts, figures: _Figures) -> str:
    """Return how far the selected estimate is from the sideslip reference, or why its error is unknown."""
    rms, std = (figures.get((main.name, "sideslip_rad", metric)) for metric in ("reference_rms", "reference_std"))
    if rms is not None and std is not None:
        within = " (within its uncertainty)" if rms <= std else ""
        share = report["reference"]["valid_share"]
        return (
            f"RMS difference from the estimated reference {degrees(rms)}, reference ± {degrees(std)}{within}, "
            f"on {100.0 * share:.0f} % of the log; the log contains no ground truth"
        )
    reference = report.get("reference") or {}
    why = f"; no reference: {reference['refused']}" if reference.get("refused") else ""
    return f"its error is unknown, because the log contains no ground truth{why}"


def _against(rmse: float, other: float, text: str) -> str:
    beside = f"{text} ({degrees(other)})"
    if other == rmse:
        return f"equal to {beside}"
    if abs(rmse - other) <= SAME * other:
        return f"equal within {100.0 * SAME:.0f} % to {beside}"
    if rmse == 0.0 or other == 0.0:
        return f"{'lower' if rmse < other else 'higher'} than {beside}"
    times = max(rmse, other) / min(rmse, other)
    shown = f"{times:.1f}" if times < _FEW else f"{times:.0f}"
    if rmse > other:
        return f"{shown} times {beside}" if times > 2.0 else f"{100.0 * (times - 1.0):.0f} % higher than {beside}"
    return f"1/{shown} of {beside}" if times > 2.0 else f"{100.0 * (1.0 - rmse / other):.0f} % lower than {beside}"


def truth_of(report: Report, name: str) -> str:
    """Return the topics that a ground truth quantity comes from, as far as its derivation names them."""
    by_name = {q["name"]: q for q in report["truth"]["quantities"]}
    parts = [by_name[n] for n in (name, "vx_m_s", "vy_m_s") if n in by_name]
    words = " ".join(f"{q['source']} {q['derivation']}" for q in parts).replace(",", " ").split()
    topics = dict.fromkeys(w.partition(".")[0] for w in words if w.startswith("/"))
    return f"ground truth: {' and '.join(topics)}" if topics else "ground truth"


def _why_not_scored(report: Report, main: MainFacts) -> str:
    quantities = {q["name"]: q for q in report["truth"]["quantities"]}
    if "sideslip_rad" in quantities:
        return f"there is no ground truth at times where {main.name} is valid and the car is fast enough"
    if "no heading known" in quantities.get("vx_m_s", {}).get("derivation", ""):
        return (
            "the ground truth (GNSS) has the course but not the heading; sideslip is their difference and needs two "
            "antennas or an INS"
        )
    return f"the ground truth contains only {', '.join(quantities) or 'no quantity'}"


def _scored_instead(main: MainFacts, figures: _Figures) -> str:
    shown = (("yaw_rate_rad_s", "yaw rate", DEGREES, "°/s"), ("vx_m_s", "v_x", 1.0, " m/s"))
    others = [
        f"{text} {value * factor:.2f}{unit}"
        for signal, text, factor, unit in shown
        if (value := figures.get((main.name, signal, "rmse"))) is not None
    ]
    return f". RMSE of the other signals: {', '.join(others)}" if others else ""


def _consistency(main: MainFacts, figures: _Figures) -> str:
    """Return the results that need no ground truth, in sentences."""
    said = []
    d2, naive = (figures.get((n, "vy_m_s", "d2")) for n in (main.name, main.naive or ""))
    if main.name == "kinematic":
        said.append("it integrates the sensors that could check it: no independent check")
    elif d2 is not None:
        follows = f"lateral kinematic consistency with accelerometer and gyro: {d2:.2f} m/s over 2 s"
        if naive is None or main.name == main.naive:
            said.append(follows)
        elif d2 < _LESS * naive:
            said.append(f"{follows} (zero sideslip: {naive:.2f}): no contradiction, which is not a proof")
        else:
            said.append(
                f"{follows}, no better than zero sideslip ({naive:.2f}): little sideslip, a biased accelerometer, a "
                "banked road or a wrong model; inconclusive"
            )
    nis, dof = (figures.get((main.name, "state", metric)) for metric in ("nis", "nis_dof"))
    if nis is not None and dof:
        low, high = _NIS_RANGE
        hence = ""
        if nis < low * dof:
            hence = ": the standard deviation of the filter is rather too large"
        elif nis > high * dof:
            hence = ": model or noise are wrong, the standard deviation of the filter is too small"
        said.append(f"NIS per degree of freedom {nis / dof:.2f} (expected value 1){hence}")
    return "; ".join(said)


def _band(report: Report, main: MainFacts, figures: _Figures) -> str:
    notes: Sequence[str] = next((e["intervals"] for e in report["estimators"] if e["name"] == main.name), [])
    if not notes:
        return f"none: {main.name} states no interval"
    made = f" ({'; '.join(notes)})"
    share = figures.get((main.name, "sideslip_rad", "coverage95"))
    if share is None:
        return f"coverage unknown without ground truth of sideslip{made}"
    if share >= HOLDS:
        wide = ", wider than necessary" if share > _WIDE else ""
        return f"coverage {100.0 * share:.0f} % (nominal 95 %){wide}{made}"
    verdict = "slightly too narrow" if share >= NEARLY_HOLDS else "too narrow"
    return f"coverage {100.0 * share:.0f} % (nominal 95 %), {verdict}{made}"


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
        if calibration["understeer"] is not None and calibration["understeer"]["contradicts"]:
            said.append("the understeer gradient of the drive contradicts the file")
    if friction is not None and modelled:
        said.append(f"friction {_friction(friction)}")
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


def _friction(friction: Mapping[str, Any]) -> str:
    source: str = friction["source"]
    if friction["estimated"]:
        return f"estimated ({friction['summary']})"
    return source if source.startswith("assumed") else f"given ({source})"


def _car(vehicle: Mapping[str, Any]) -> str:
    return "default sedan (no car given)" if vehicle["file"] is None else f"car {vehicle['file']}"


def _next_steps(report: Report, main: MainFacts, figures: _Figures) -> list[str]:
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
        given = f"--car {vehicle['file']} -o mycar"
        steps.append(
            f"teach the car with this ground truth: pdhef learn LOG {given}"
            if _error(figures, main.name) is not None
            else f"calibrate the car with several logs: pdhef learn LOGS {given} --stages calibrate"
        )
    friction = report["friction"]
    if friction is not None and friction["estimated"] and (friction["observable_share"] or 0.0) < _FRICTION_SHOWN:
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
