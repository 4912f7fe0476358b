"""Checks: whether mapped signals, truth and vehicle file agree with physics and with one another.

Each signal is passed, failed or undecided by the relations that it stands in (:mod:`pdhef_logtool.drive.relations`).
Where they contradict one another, the smallest mistake that explains all of them says which signals fail.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, Sensors, VehicleParameters, default_vehicle
from pdhef_logtool.drive.columns import derivative, earlier, independent_samples, median_known, moving_at
from pdhef_logtool.drive.delays import LateSensor, delay_checks
from pdhef_logtool.drive.faulty_samples import without_faulty_samples
from pdhef_logtool.drive.measured import WHEEL_SPEEDS, Measured, measure
from pdhef_logtool.drive.relations import (
    Mistake,
    Relation,
    best_explanation,
    contradicting,
    gentle_at,
    known_mistakes,
    smallest_explanations,
)
from pdhef_logtool.drive.truth import LatencyEstimate, TruthTrack
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import WHEELS, BoolArray, Channel, FloatArray

#: What of an accelerometer's mean driving does not explain. Grade and crossfall of a whole drive are 3 % at most
#: (0.3 m/s^2), a production sensor's bias less than that; 0.8 m/s^2 is a tilt of 4.7 degrees, half of g another axis.
LEVEL_M_S2 = 0.8
OTHER_AXIS_M_S2 = 5.0
#: Independent samples of gentle driving from which on a mean is a tilt or a bias, and no manoeuvre: 10 s.
LEVEL_SAMPLES = 20.0
#: Truth stands wrong by more than what tyres and crossfall make of straight driving, and is known to a third of it.
SIDESLIP_OFFSET_RAD = math.radians(0.15)
#: No car drives sideways: half of its moving time beyond that, the heading and the velocity do not belong together.
SIDEWAYS_RAD = math.radians(20.0)
#: An accelerometer stands off the place in the file by more than a mounting in the cabin explains; m. Farther than the
#: second no car has one: something else goes with the yaw acceleration.
LEVER_M, MOST_LEVER_M = 0.5, 5.0
#: Production gyros are good to 1 %, cheap ones to 3 %.
GAIN_ERROR = 0.05
#: What an accelerometer reads of the lateral acceleration: roll adds a tenth, banked bends take a quarter.
AY_GAIN_RANGE = (0.65, 1.3)
#: The delay of a_y is found in so many steps, the last of which is less than this, and is none beyond.
DELAY_STEPS, DELAY_KNOWN_S, MOST_DELAY_S = 4, 0.005, 0.3
#: A sensor's filter and a bus take 10 to 20 ms; at 0.5 Hz, 30 ms are 5 degrees of phase.
SENSOR_DELAY_S = 0.03
#: Understeer gradients that have opposite signs and are this far from neutral; rad per m/s^2. Cars have 0.002 to 0.006.
NEUTRAL_RAD_PER_M_S2 = 0.0006
#: Steering angle over what the file's ratio and wheelbase make of the curvature.
STEERING_RANGE = (0.75, 1.33)
#: Share of the steering's spread that curvature and lateral acceleration may leave.
UNEXPLAINED_STEERING = 0.5
#: Effective radius over the file's: tyres wear by 3 %, sizes of one car differ by 5 %.
RADIUS_RANGE = (0.85, 1.18)
#: Highest over lowest speed from which wheelbase and understeer can be told apart.
SPEED_SPREAD = 1.4
#: Lateral acceleration driven over what the file's tyres carry at friction 1: summer tyres reach 1.15 of it.
MAX_GRIP_USE = 1.25
#: A sensor whose silent samples held so much of the drive's motion is itself a failed check.
FAULTY_SHARE = 0.5
#: A figure of a fit counts from this many standard errors on.
SURE = 4.0

_LACKS = {
    "ax_m_s2": "speeding up and braking, on straights",
    "speed_m_s": "a wheel speed, an accelerometer or truth to hold it against, and speeding up or bends",
}
_BENDS = "bends to both sides at speed"


def check_drive(
    signals: Mapping[str, Channel],
    truth: Mapping[str, Channel] | None = None,
    derived: TruthTrack | None = None,
    vehicle: VehicleParameters | None = None,
    *,
    latency: LatencyEstimate | None = None,
    late: Sequence[LateSensor] = (),
    mounting_is_known: bool = False,
    measured: Measured | None = None,
) -> tuple[Check, ...]:
    """Return the checks of mapped signals, of the truth and of the vehicle file; nothing that they decide is a guess.

    What contradicts is looked at again without the samples that a sensor fault has spoilt.

    Parameters
    ----------
    signals, truth : by name, SI, as mapped. derived : truth at the CG.
    vehicle : its file is held against the drive; None, or the default car: there is none.
    latency : of the truth against the gyro, or the gyro's own. late : sensors that are late without truth.
    mounting_is_known : gravity has shown that the IMU is not upside down.
    measured : what :func:`~pdhef_logtool.drive.measured.measure` makes of the channels, where that is known.
    """
    asked = _Asked(vehicle, latency, tuple(late), mounting_is_known, derived is not None)
    found = _all_checks(measure(signals, truth, derived) if measured is None else measured, asked)
    if all(check.verdict != "failed" for check in found):
        return found
    sound, shares = without_faulty_samples(signals, vehicle or default_vehicle())
    if not shares:
        return found
    again = _all_checks(measure(sound, truth, derived), asked)
    return (*(_fault_check(n, share) for n, share in shares.items() if share > FAULTY_SHARE), *again)


@dataclass(frozen=True, slots=True)
class _Asked:
    vehicle: VehicleParameters | None
    latency: LatencyEstimate | None
    late: tuple[LateSensor, ...]
    mounting_is_known: bool
    has_truth: bool


def _all_checks(measured: Measured, asked: _Asked) -> tuple[Check, ...]:
    columns, speed_name = measured.columns, measured.speed_name
    vehicle = asked.vehicle or default_vehicle()
    found = _by_relations(measured, mounting_is_known=asked.mounting_is_known)
    wrong = {c.subject for c in found if c.verdict == "failed"}
    known = not wrong & {"yaw_rate_rad_s", "ay_m_s2", speed_name}
    found += _levels(columns, speed_name, vehicle.sensors, driving_is_known=known)
    if asked.has_truth:
        found += _sideslip_checks(columns)
        found += _sensor_error_checks(columns, asked.latency, vehicle, wrong)
    by_truth = {c.name for c in found}
    found += [c for c in delay_checks(asked.late) if c.name not in by_truth]
    if vehicle != default_vehicle():
        found += _vehicle_checks(columns, speed_name, vehicle)
    unique: dict[str, Check] = {}
    for check in found:  # of two of a name the worse counts
        if check.name not in unique or _BADNESS[check.verdict] > _BADNESS[unique[check.name].verdict]:
            unique[check.name] = check
    return tuple(unique.values())


def _fault_check(name: str, share: float) -> Check:
    evidence = f"{share:.0%} of what the car did fell into samples of it that are stuck or dead"
    return Check(f"{name}.fault", name, "failed", evidence, "look at the sensor, its cable and its power")


def explained_factors(measured: Measured, *, mounting_is_known: bool, most: int = 2) -> dict[str, tuple[float, str]]:
    """Return by signal the factor that undoes its wrong unit or sign, with the evidence, where only one explains it.

    ``most``: mistakes at once that are believed.
    """
    relations = measured.relations
    groups = measured.groups(mounting_is_known=mounting_is_known)
    explanations = smallest_explanations(relations, known_mistakes(list(measured.columns), groups))
    chosen = best_explanation(relations, explanations)
    if chosen is None or len(chosen) > most or not all(m.is_exact for m in chosen):
        return {}
    bad = [r for r in relations if r.tells and not r.accepts()]
    found = {}
    for mistake in chosen:
        for name, factor in mistake.factors.items():
            evidence = next((r.evidence for r in bad if name in r.powers), "")
            found[name] = (factor, f"{mistake.words}: {evidence}")
    return found


_BADNESS = {"passed": 0, "undecided": 1, "failed": 2}


# ------------------------------------------------------------------------------- sign, unit, right field


def _by_relations(measured: Measured, *, mounting_is_known: bool) -> list[Check]:
    """Judge sign, unit and field of every signal that a relation is about."""
    columns, relations = measured.columns, measured.relations
    groups = measured.groups(mounting_is_known=mounting_is_known)
    names = [n for n in columns if n in measured.topics or n in _JUDGED_TRUTH]
    if "truth.sideslip_rad" in names and "truth.vy_m_s" in names:  # which is v_x times its tangent
        names.remove("truth.vy_m_s")
    explanations = smallest_explanations(relations, known_mistakes(list(columns), groups))
    blamed, suspected = _mistakes_by_signal(explanations)
    culprits = set() if explanations else contradicting(relations)
    checks: list[Check] = []
    for name in names:
        mine = [r for r in relations if name in r.powers]
        telling = [r for r in mine if r.tells]
        bad = [r for r in telling if not r.accepts()]
        good = [r for r in telling if r.accepts()]
        stray = [r for r in mine if r.unrelated and not _is_cleared(name, r, relations)]
        if stray:
            checks.append(_stray(name, stray[0]))
        if name in blamed or name in suspected:
            found = _blamed(name, blamed.get(name) or suspected[name], bad or telling)
            is_sure = name in blamed and not (bad and all(r.is_vague for r in bad))
            checks += found if is_sure else [replace(c, verdict="undecided") for c in found]
        elif name in culprits:
            checks.append(_unexplained(name, bad))
        elif good or (bad and explanations):
            best = max(telling if explanations else good, key=lambda r: (len(r.powers) > 1, abs(r.correlation)))
            checks += [Check(f"{name}.{aspect}", name, "passed", best.evidence) for aspect in ("sign", "unit")]
        elif bad:
            checks.append(_contradicted(name, bad[0], culprits))
        elif not stray:
            checks.append(_not_excited(name, mine))
    return checks


def _mistakes_by_signal(
    explanations: Sequence[tuple[Mistake, ...]],
) -> tuple[dict[str, list[Mistake]], dict[str, list[Mistake]]]:
    """Return by signal the mistakes of the likeliest explanations, and those of others that explain it as well."""
    least = min((_likelihood(e) for e in explanations), default=())
    blamed: dict[str, list[Mistake]] = {}
    suspected: dict[str, list[Mistake]] = {}
    for chosen in explanations:
        found = blamed if _likelihood(chosen) == least else suspected
        for mistake in chosen:
            for name in mistake.factors:
                if mistake not in found.setdefault(name, []):
                    found[name].append(mistake)
    return blamed, suspected


def _likelihood(explanation: tuple[Mistake, ...]) -> tuple[int, int]:
    """Return how many signals an explanation has wrong, the wheels as one, and how seldom those are."""
    signals = {"wheels" if n.startswith("wheel_speed") else n for m in explanation for n in m.factors}
    seldom = max((_OFTEN_WRONG.index(n) if n in _OFTEN_WRONG else len(_OFTEN_WRONG) for n in signals), default=0)
    return len(signals), seldom


#: Of signals that explain a contradiction equally well the first is blamed: no standard says how a steering angle
#: counts, and an axis of an IMU is turned more often than the sign of a gyro that is read from the right one.
_OFTEN_WRONG = ("steering_wheel_rad", "steer_rad", "wheels", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


def _unexplained(name: str, bad: Sequence[Relation]) -> Check:
    """Return the check of a signal that contradicts others by what is no known unit or sign."""
    first = next((r for r in bad if not r.is_close), bad[0])
    if first.is_close:
        remedy = "no unit or sign explains it: the car may slide, or a sensor may fail for a while"
        return Check(f"{name}.unit", name, "undecided", first.evidence, remedy)
    remedy = "no single mistake explains it: look at the field, unit and sign of " + " and ".join(first.powers)
    return Check(f"{name}.unit", name, "failed", first.evidence, remedy)


def _contradicted(name: str, relation: Relation, culprits: set[str]) -> Check:
    others = " and ".join(sorted(culprits & set(relation.powers)))
    return Check(f"{name}.unit", name, "undecided", relation.evidence, f"needs {others} that is right")


_JUDGED_TRUTH = (*(f"truth.{n}" for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2")),)


def _is_cleared(name: str, stray: Relation, relations: Sequence[Relation]) -> bool:
    """Return whether another relation shows the signal to be right, and none does so for the others of the pair."""

    def shown(signal: str) -> bool:
        return any(r.tells and r.accepts() and signal in r.powers and r.powers != stray.powers for r in relations)

    paces = {"speed_m_s", WHEEL_SPEEDS, "truth.vx_m_s"}
    others = [n for n in stray.powers if n != name and n not in paces]
    return name in paces or (shown(name) and not all(shown(n) for n in others))


def _stray(name: str, relation: Relation) -> Check:
    evidence = f"{relation.text}: one moves and the other does not with it, correlation {relation.correlation:.2f}"
    return Check(f"{name}.axis", name, "failed", evidence, f"map another field or axis to {name}")


def _blamed(name: str, mistakes: Sequence[Mistake], relations: Sequence[Relation]) -> list[Check]:
    kinds = {m.kind for m in mistakes}
    aspects = [a for a in ("sign", "unit") if any(a in k for k in kinds)]
    words = " or ".join(dict.fromkeys(m.words for m in mistakes))
    evidence = "; ".join(r.evidence for r in relations[:2])
    factors = {f for m in mistakes if (f := m.factors.get(name)) is not None}
    remedy = f"perhaps {words}"
    if len(factors) == 1:
        remedy += f": multiply its scale in the mapping by {factors.pop():.6g}"
    return [Check(f"{name}.{aspect}", name, "failed", evidence, remedy) for aspect in aspects]


def _not_excited(name: str, relations: Sequence[Relation]) -> Check:
    lacks = _LACKS.get(name, _BENDS)
    if not relations:
        evidence = "nothing in the log says what it should be"
    else:
        best = max(relations, key=lambda r: abs(r.correlation))
        evidence = f"{best.text}: correlation {best.correlation:.2f} over {best.samples:.0f} independent samples"
    return Check(f"{name}.sign", name, "undecided", evidence, f"needs {lacks}")


# --------------------------------------------------------------------------------------------- gravity


def _levels(
    columns: Mapping[str, FloatArray], speed_name: str | None, sensors: Sensors, *, driving_is_known: bool
) -> list[Check]:
    """Judge what driving leaves of the accelerometers' means: gravity on an axis that should be level."""
    checks = []
    speed = None if speed_name is None else columns[speed_name]
    yaw = columns.get("yaw_rate_rad_s")
    for name in ("ax_m_s2", "ay_m_s2"):
        if name not in columns:
            continue
        driven, at_ease = np.zeros_like(columns[name]), np.ones(columns[name].shape[0], np.bool_)
        if speed is not None and yaw is not None:
            # Where the car slides, speed and yaw rate no longer say what accelerates it.
            at_ease = gentle_at(yaw * speed, at_ease) & gentle_at(columns[name] - median_known(columns[name]), at_ease)
        if speed is not None and name == "ax_m_s2":
            driven = derivative(speed)
        elif speed is not None and yaw is not None:
            driven = yaw * speed
        rest = columns[name] - driven
        known = np.isfinite(rest)
        if independent_samples(int(np.count_nonzero(known))) < 6.0:
            rest, known = columns[name], np.isfinite(columns[name])
        if independent_samples(int(np.count_nonzero(known))) < 2.0:
            continue
        told = independent_samples(int(np.count_nonzero(known & at_ease))) >= LEVEL_SAMPLES
        use = known & at_ease if told else known
        bias = sensors.ax_bias_m_s2 if name == "ax_m_s2" else sensors.ay_bias_m_s2
        check = _level(name, float(np.mean(rest[use])) - bias, float(np.mean(columns[name][use])) - bias)
        if (driving_is_known and told) or check.name == f"{name}.axis":
            checks.append(check)
    return checks


def _level(name: str, rest: float, mean: float) -> Check:
    # A wrong sign or unit of the speed makes the rest wrong, not the mean: both must stand out.
    size = min(abs(rest), abs(mean))
    evidence = f"mean {mean:.2f} m/s^2, of which driving leaves {rest:.2f}"
    if size > OTHER_AXIS_M_S2:
        return Check(f"{name}.axis", name, "failed", f"{evidence}: that is gravity", "map a level axis of the sensor")
    if size > LEVEL_M_S2:
        tilt = math.degrees(math.asin(size / GRAVITY_M_S2))
        remedy = f"the sensor is tilted by {tilt:.1f} deg, which belongs in the mapping, or has a bias: a fit's matter"
        return Check(f"{name}.level", name, "failed", evidence, remedy)
    return Check(f"{name}.level", name, "passed", evidence)


# ----------------------------------------------------------------------------------------------- truth


def _sideslip_checks(columns: Mapping[str, FloatArray]) -> list[Check]:
    """Judge whether the truth's heading and velocity belong together, and whether its sideslip is 0 when straight."""
    if not all(f"truth.{n}" in columns for n in ("vx_m_s", "vy_m_s")):
        return []
    vx, vy = columns["truth.vx_m_s"], columns["truth.vy_m_s"]
    sideslip = np.arctan2(vy, vx)
    moving = moving_at(np.hypot(vx, vy))
    known = moving & np.isfinite(sideslip)
    if not known.any():
        return []
    name = "truth.sideslip_rad"
    typical = float(np.median(np.abs(sideslip[known])))
    evidence = f"its median size is {math.degrees(typical):.1f} deg where the car moves"
    if typical > SIDEWAYS_RAD:
        remedy = "heading and velocity do not belong together: look at frames, signs and units of the truth"
        return [Check(f"{name}.frame", name, "failed", evidence, remedy)]
    checks = [Check(f"{name}.frame", name, "passed", evidence)]
    offset = _offset_check(columns)
    return checks if offset is None else [*checks, offset]


def sideslip_offset(columns: Mapping[str, FloatArray]) -> tuple[float, float] | None:
    """Return the truth's sideslip at no curvature and no lateral force, with its standard error; None: too little."""
    rate, ay = (columns.get(n) for n in ("yaw_rate_rad_s", "ay_m_s2"))
    vx, vy = (columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s"))
    if rate is None or ay is None or vx is None or vy is None:
        return None
    moving = moving_at(np.hypot(vx, vy))
    with np.errstate(divide="ignore", invalid="ignore"):
        regressors = [np.ones_like(vx), rate / vx, ay]
    found = fit(np.arctan2(vy, vx), regressors, gentle_at(rate * vx, moving))
    return None if found is None else (float(found[0][0]), float(found[1][0]))


def is_turned(offset_rad: float, error_rad: float) -> bool:
    """Return whether an offset of the truth's sideslip is one, and not tyres, crossfall or chance."""
    return abs(offset_rad) > max(SIDESLIP_OFFSET_RAD, SURE * error_rad)


def _offset_check(columns: Mapping[str, FloatArray]) -> Check | None:
    """Return the check of the truth's sideslip on straights; None without IMU."""
    if "yaw_rate_rad_s" not in columns or "ay_m_s2" not in columns:
        return None
    name, lacks = "truth.sideslip_rad", "needs straights and bends"
    found = sideslip_offset(columns)
    if found is None:
        return Check(f"{name}.offset", name, "undecided", "too little gentle driving", lacks)
    offset, error = found
    evidence = f"{math.degrees(offset):.2f} +- {math.degrees(error):.2f} deg are left where the car goes straight"
    if is_turned(offset, error):
        remedy = "the truth's heading is turned: a tyre, a crossfall or a bias of a_y makes less of that"
        return Check(f"{name}.offset", name, "failed", evidence, remedy)
    if abs(offset) + 2.0 * error < 2.0 * SIDESLIP_OFFSET_RAD:
        return Check(f"{name}.offset", name, "passed", evidence)
    return Check(f"{name}.offset", name, "undecided", evidence, lacks)


def fit(
    measured: FloatArray, regressors: Sequence[FloatArray], use: BoolArray
) -> tuple[FloatArray, FloatArray, float] | None:
    """Regress a column on others where ``use`` and all are known.

    Returns
    -------
    coefficients, standard errors with the independent samples counted, and the residual's 1-sigma; None where there
    are too few, or where the regressors do not vary apart from one another.
    """
    matrix = np.stack(regressors, axis=1)
    known = use & np.isfinite(measured) & np.isfinite(matrix).all(axis=1)
    samples = independent_samples(int(np.count_nonzero(known)))
    if samples < 4.0 * len(regressors):
        return None
    a, b = matrix[known], measured[known]
    scale = np.linalg.norm(a, axis=0)
    if (scale <= 1e-12).any() or np.linalg.cond(a / scale) > 1e4:
        return None
    coefficients = np.linalg.lstsq(a / scale, b, rcond=None)[0] / scale
    spread = float(np.sqrt(np.mean((b - a @ coefficients) ** 2) * samples / (samples - len(regressors))))
    covariance = np.linalg.inv(a.T @ a / a.shape[0]) * spread**2 / samples
    return coefficients, np.sqrt(np.diag(covariance)), spread


# ------------------------------------------------------------------------------ lever, gain and delay


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """What regression on truth says of an accelerometer's place and of a gyro's gain, with standard errors.

    Attributes
    ----------
    lever_m : of the accelerometer ahead of the CG. yaw_rate_gain : what the gyro reads of 1.
    ay_gain : what the accelerometer reads of 1, with the roll of the body. ay_delay_s : how late it is.
    """

    lever_m: float
    lever_error_m: float
    yaw_rate_gain: float
    gain_error: float
    ay_gain: float = math.nan
    ay_gain_error: float = math.inf
    ay_delay_s: float = math.nan
    ay_delay_error_s: float = math.inf


def sensor_errors(columns: Mapping[str, FloatArray]) -> SensorErrors:
    """Regress a_y and the gyro on the truth; NaN for what the drive does not tell.

    a_y is the truth's v̇_y + v_x r, as far as roll makes it larger; a lever adds the derivative of the yaw rate, a delay
    takes the derivative of all that off, a bias adds a constant.
    """
    nothing = (math.nan, math.inf)
    lever = gain = ay_gain = delay = nothing
    needed = [columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")]
    vx, vy, rate = needed
    gyro, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if rate is not None and gyro is not None:
        everywhere = np.ones(rate.shape[0], np.bool_)
        found = fit(gyro, [rate, derivative(rate), np.ones_like(rate)], everywhere)
        gain = nothing if found is None else (found[0][0], found[1][0])
    if vx is not None and vy is not None and rate is not None and ay is not None:
        lateral = derivative(vy) + vx * rate
        regressors = [derivative(rate), lateral, derivative(lateral), np.ones_like(rate)]
        late_s = 0.0
        for _ in range(DELAY_STEPS):  # a lever's part is late too, so that one step is not all of it
            found = fit(earlier(ay, late_s), regressors, moving_at(vx))
            if found is None or found[0][1] <= 0.0:
                break
            (place, scale, slope, _), (place_error, scale_error, slope_error, _), _ = found
            step_s = -slope / scale
            late_s += step_s
            known = abs(step_s) < DELAY_KNOWN_S and late_s < MOST_DELAY_S
            delay = (late_s, slope_error / scale) if known else nothing
            if lever == nothing or (known and late_s > SURE * delay[1]):
                lever, ay_gain = (place, place_error), (scale, scale_error)
    return SensorErrors(*(float(x) for x in (*lever, *gain, *ay_gain, *delay)))


def _sensor_error_checks(
    columns: Mapping[str, FloatArray], latency: LatencyEstimate | None, vehicle: VehicleParameters, wrong: set[str]
) -> list[Check]:
    """Judge place, gain and delay; nothing is said of what the drive does not tell, or of a signal that is wrong."""
    checks = []
    errors = sensor_errors(columns)
    truth = {f"truth.{n}" for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")}
    name = "ay_m_s2"
    if math.isfinite(errors.lever_m) and not wrong & {name, *truth}:
        place = vehicle.imu_position_m[0]
        off, error = errors.lever_m - place, errors.lever_error_m
        evidence = (
            f"the accelerometer is {errors.lever_m:.2f} +- {error:.2f} m ahead of the CG, the file says {place:g}"
        )
        if abs(off) > max(MOST_LEVER_M, SURE * error):
            remedy = "no car has it there: the truth's lateral velocity or yaw rate may stand at another point or time"
            checks.append(Check(f"{name}.place", name, "undecided", evidence, remedy))
        elif abs(off) > LEVER_M and abs(off) > SURE * error:
            remedy = f"imu_position_m = [{errors.lever_m:.2f}, 0.0, 0.0] in the vehicle file, or pdhef identify"
            checks.append(Check(f"{name}.place", name, "failed", evidence, remedy))
        elif abs(off) + 2.0 * error < 2.0 * LEVER_M:
            checks.append(Check(f"{name}.place", name, "passed", evidence))
        checks += _gain_and_delay_of_ay(errors, latency)
    name = "yaw_rate_rad_s"
    if math.isfinite(errors.yaw_rate_gain) and not wrong & {name, *truth}:
        gain, error = errors.yaw_rate_gain / vehicle.sensors.yaw_rate_gain, errors.gain_error
        evidence = f"the gyro reads {gain:.3f} +- {error:.3f} of the truth's yaw rate"
        if abs(gain - 1.0) > GAIN_ERROR and abs(gain - 1.0) > SURE * error:
            remedy = f"sensors.yaw_rate_gain = {errors.yaw_rate_gain:.3f} in the vehicle file, or pdhef identify"
            checks.append(Check(f"{name}.gain", name, "failed", evidence, remedy))
        elif abs(gain - 1.0) + 2.0 * error < 2.0 * GAIN_ERROR:
            checks.append(Check(f"{name}.gain", name, "passed", evidence))
    if latency is not None and latency.reliable and not latency.identical:
        delay = latency.gyro_delay_s
        evidence = f"{delay * 1e3:.1f} +- {latency.std_error_s * 1e3:.1f} ms late against the truth"
        late = delay > SENSOR_DELAY_S
        remedy = f"latency_s = {delay:.4f} more in the mapping, or pdhef identify" if late else ""
        checks.append(Check(f"{name}.delay", name, "failed" if late else "passed", evidence, remedy))
    return checks


def ay_delay(errors: SensorErrors, latency: LatencyEstimate | None) -> tuple[float, float] | None:
    """Return how late the accelerometer is, and its standard error; None where the truth does not tell.

    A truth whose yaw rate is the gyro's own may have velocities of another time, and says nothing of a_y.
    """
    low, high = AY_GAIN_RANGE
    if latency is None or not latency.reliable or latency.identical:
        return None
    if not low < errors.ay_gain < high or not math.isfinite(errors.ay_delay_s):
        return None
    return errors.ay_delay_s + latency.latency_s, math.hypot(errors.ay_delay_error_s, latency.std_error_s)


def _gain_and_delay_of_ay(errors: SensorErrors, latency: LatencyEstimate | None) -> list[Check]:
    name, gain, error = "ay_m_s2", errors.ay_gain, errors.ay_gain_error
    (low, high), checks = AY_GAIN_RANGE, []
    evidence = f"a_y reads {gain:.2f} +- {error:.2f} of the truth's lateral acceleration, with roll and bank"
    if gain + SURE * error < low or gain - SURE * error > high:
        remedy = f"divide its scale in the mapping by about {gain:.2f}"
        checks.append(Check(f"{name}.gain", name, "failed", evidence, remedy))
    elif low <= gain - 2.0 * error and gain + 2.0 * error <= high:
        checks.append(Check(f"{name}.gain", name, "passed", evidence))
    found = ay_delay(errors, latency)
    if found is None:
        return checks
    delay, error = found
    evidence = f"a_y is {delay * 1e3:.1f} +- {error * 1e3:.1f} ms late against the truth"
    if delay > max(SENSOR_DELAY_S, SURE * error):
        remedy = f"latency_s = {delay:.4f} more in the mapping"
        checks.append(Check(f"{name}.delay", name, "failed", evidence, remedy))
    elif abs(delay) + 2.0 * error < 2.0 * SENSOR_DELAY_S:
        checks.append(Check(f"{name}.delay", name, "passed", evidence))
    return checks


# --------------------------------------------------------------------------------------------- vehicle


def _vehicle_checks(
    columns: Mapping[str, FloatArray], speed_name: str | None, vehicle: VehicleParameters
) -> list[Check]:
    if speed_name is None:
        return []
    speed = columns[speed_name]
    checks = _wheel_radius(columns, speed, vehicle)
    rate = columns.get("yaw_rate_rad_s")
    steer = columns.get("steer_rad")
    if steer is None and "steering_wheel_rad" in columns:
        steer = columns["steering_wheel_rad"] / vehicle.steering_ratio
    if rate is not None and steer is not None:
        checks += _steering_checks(steer, rate, speed, vehicle)
    if rate is not None and "ay_m_s2" in columns:
        # Roll makes a_y too large, and a car that begins to spin its yaw rate.
        checks.append(_grip_check(np.minimum(np.abs(columns["ay_m_s2"]), np.abs(rate * speed)), vehicle))
    return checks


def _wheel_radius(columns: Mapping[str, FloatArray], speed: FloatArray, vehicle: VehicleParameters) -> list[Check]:
    if "speed_m_s" not in columns:
        return []
    moving = moving_at(speed)
    wheels = [columns[n] for w in WHEELS if (n := f"wheel_speed_{w}_rad_s") in columns]
    turning = [(w, moving & np.isfinite(w) & (w != 0.0)) for w in wheels]
    ratios = [float(np.median(speed[k] / w[k])) for w, k in turning if k.any()]
    if not ratios:
        return []
    radius = float(np.median(ratios))
    low, high = (f * vehicle.wheel_radius_m for f in RADIUS_RANGE)
    evidence = f"the speed over the wheels' is {radius:.3f} m, the file's radius {vehicle.wheel_radius_m:g} m"
    good = low <= radius <= high
    return [
        Check("vehicle.wheel_radius", "vehicle", "passed", evidence)
        if good
        else Check("vehicle.wheel_radius", "vehicle", "failed", evidence, f"set wheel_radius_m = {radius:.3f}")
    ]


def _steering_checks(steer: FloatArray, rate: FloatArray, speed: FloatArray, vehicle: VehicleParameters) -> list[Check]:
    """Judge wheelbase with steering ratio, and under- or oversteer, by delta = s L r / v + K v r + offset."""
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = vehicle.wheelbase_m * rate / speed
    lateral = rate * speed
    gentle = gentle_at(lateral, moving_at(speed))
    found = fit(steer, [curved, lateral, np.ones_like(steer)], gentle)
    names = ("vehicle.steering", "vehicle.understeer")
    speeds = np.abs(speed[gentle & np.isfinite(speed)])
    # At one speed curvature and lateral acceleration are one regressor.
    if found is None or np.quantile(speeds, 0.9) < SPEED_SPREAD * np.quantile(speeds, 0.1):
        lacks = "needs bends to both sides at low and at high speed"
        return [Check(n, "vehicle", "undecided", "too little driving in bends", lacks) for n in names]
    (share, gradient, _), (share_error, error, _), left = found
    if share <= 0.0 or left > UNEXPLAINED_STEERING * float(np.std(steer[gentle & np.isfinite(steer)])):
        lacks = "needs bends that the car does not slide through"
        evidence = "curvature and lateral acceleration do not explain the steering"
        return [Check(n, "vehicle", "undecided", evidence, lacks) for n in names]
    file = vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)
    return [_steering_check(share, share_error), _understeer_check(gradient, error, file)]


def _steering_check(share: float, error: float) -> Check:
    name = "vehicle.steering"
    low, high = STEERING_RANGE
    evidence = (
        f"slow bends take {share:.2f} +- {error:.2f} of the steering that wheelbase and ratio of the file ask for"
    )
    if share + SURE * error < low or share - SURE * error > high:
        remedy = f"steering_ratio is off by {share:.2f}, or the wheelbase"
        return Check(name, "vehicle", "failed", evidence, remedy)
    if share - 2.0 * error < low or share + 2.0 * error > high:
        return Check(name, "vehicle", "undecided", evidence, "needs bends at low and at high speed")
    return Check(name, "vehicle", "passed", evidence)


def _understeer_check(gradient: float, error: float, file: float) -> Check:
    name = "vehicle.understeer"
    evidence = (
        f"understeer gradient {gradient * 1e3:.2f} +- {error * 1e3:.2f} mrad per m/s^2 in the drive, {file * 1e3:.2f} "
        "in the file"
    )
    opposite = gradient * file < 0.0 and min(abs(gradient), abs(file)) > NEUTRAL_RAD_PER_M_S2
    if opposite and abs(gradient) > SURE * error:
        behaves = "understeers where the file oversteers" if gradient > 0.0 else "oversteers where the file understeers"
        remedy = f"the car {behaves}: look at the tyres' stiffness and at the place of the CG, or run pdhef identify"
        return Check(name, "vehicle", "failed", evidence, remedy)
    if error > max(abs(gradient), abs(file), NEUTRAL_RAD_PER_M_S2):
        return Check(name, "vehicle", "undecided", evidence, "needs bends at low and at high speed")
    return Check(name, "vehicle", "passed", evidence)


def _grip_check(lateral: FloatArray, vehicle: VehicleParameters) -> Check:
    """Judge whether the file's tyres carry its mass through the bends that were driven."""
    known = lateral[np.isfinite(lateral)]
    friction = max(1.0, vehicle.assumed_friction)
    carried = [vehicle.magic_formula(front, friction)[2] / vehicle.axle_load_n(front) for front in (True, False)]
    most = GRAVITY_M_S2 * min(carried)
    seen = float(np.quantile(known, 0.99)) if known.size else 0.0
    evidence = f"{seen:.1f} m/s^2 were driven, the file's tyres carry its mass up to {most:.1f} m/s^2"
    if seen > MAX_GRIP_USE * most:
        remedy = "mass_kg is too large, or friction and the tyres' peak are too small"
        return Check("vehicle.mass", "vehicle", "failed", evidence, remedy)
    return Check("vehicle.mass", "vehicle", "passed", evidence)
