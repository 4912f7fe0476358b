"""Checks: whether signals, ground truth and vehicle file agree with physics and with one another.

``checks.toml`` is the table of all checks with their limits and texts; report.json, terminal, pages, ``--waive``, JUnit
and documentation use its names. To add a check, write its entry, and a function in ``FUNCTIONS`` that yields
:func:`~.check_table.judge` with a value, its standard error and the figures of the texts, or nothing without the data
to compare.
Signs and units are decided by a posterior (:mod:`~.relation_checks`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, default_vehicle
from pdhef_logtool.drive.check_table import FAILS_STD, TABLE, TEXTS, judge, result
from pdhef_logtool.drive.columns import (
    GRID_S,
    MS_PER_S,
    derivative,
    earlier,
    fit,
    independent_samples,
    median_known,
    moving_at,
)
from pdhef_logtool.drive.delays import LatencyEstimate, LateSensor
from pdhef_logtool.drive.measured import Measured
from pdhef_logtool.drive.mounting import IS_GRAVITY_M_S2
from pdhef_logtool.drive.relation_checks import relation_checks
from pdhef_logtool.drive.relations import CG_VY, EXPLAINED_SHARE, POSITION, gentle_at, law, position_factors
from pdhef_logtool.drive.sensor_changes import SensorChange
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import S_PER_NS, SIGNAL_UNITS, WHEELS, BoolArray, FloatArray

CHANGE_SUFFIX = ".change"
#: If a check of one of these aspects fails, the channel is not the signal that it is mapped to.
_MISREAD = frozenset({"sign", "unit", "scale", "axis", "mounting"})
_BADNESS = {"passed": 0, "undecided": 1, "failed": 2}
#: Half of g in the mean of an accelerometer means another axis.
OTHER_AXIS_M_S2 = 5.0
#: Least number of independent samples of gentle driving, so that a mean is not due to a manoeuvre: 10 s.
LEVEL_SAMPLES = 20.0
#: Share of the moving time in which ground truth must be sideways, since no car drives so.
SIDEWAYS_SHARE = 0.75
#: Bias of an accelerometer, 1-sigma, which shifts the sideslip due to lateral tyre forces.
AY_BIAS_M_S2 = 0.1
#: Beyond this distance a sensor is outside of the car: another quantity correlates with the yaw acceleration.
MOST_LEVER_M = 5.0
#: Crossfall alone moves an accelerometer by half a metre per second squared.
LEAST_LATERAL_M_S2 = 0.7
#: 1-sigma of the gain of a gyro by two filters (studies/plus_minus.py).
RESAMPLED_GAIN = 0.0015
#: Steps to find the delay of a_y, the largest last step, and the largest delay.
DELAY_STEPS, LAST_STEP_S, MOST_DELAY_S = 4, 0.005, 0.3
#: Lateral acceleration that changes more slowly may be a bank of the road. Delay of body roll after the acceleration;
#: the gain gives the roll angle.
SLOW_S, ROLL_LAG_S = 4.0, 0.08
#: Largest share of the steering's spread that curvature and lateral acceleration do not explain.
UNEXPLAINED_STEERING = 0.5
#: Highest over lowest speed from which wheelbase and understeer can be distinguished.
SPEED_SPREAD = 1.4
#: Understeer gradients of this size and less are neutral. Cars have 2 to 6 mrad per m/s².
NEUTRAL_MRAD_PER_M_S2 = 0.6
_TRUTH = {"truth.vx_m_s", "truth.vy_m_s", "truth.yaw_rate_rad_s"}
#: A value and its standard error.
Figure: TypeAlias = tuple[float, float]
UNKNOWN: Figure = (math.nan, math.inf)


@dataclass(frozen=True, eq=False)
class CheckedDrive:
    """A drive with the checks of its signals by their relations (``related``)."""

    measured: Measured
    related: tuple[Check, ...]

    @property
    def vehicle(self) -> VehicleParameters:
        """The vehicle of the file, or the default vehicle."""
        return self.measured.vehicle or default_vehicle()

    @property
    def columns(self) -> Mapping[str, FloatArray]:
        """The columns [N] by signal."""
        return self.measured.columns

    @cached_property
    def wrong(self) -> set[str]:
        """Signals with a failed check of a relation."""
        return {c.subject for c in self.related if c.verdict == "failed"}

    @property
    def speed(self) -> FloatArray | None:
        """The column used as the speed [N]; None if it is wrong."""
        name = self.measured.speed_name
        return None if name is None or name in self.wrong else self.columns[name]

    @cached_property
    def errors(self) -> "SensorErrors":
        """The errors of the sensors by ground truth; unknown without it, or if it is wrong."""
        return sensor_errors(self.columns) if self.measured.derived and not self.wrong & _TRUTH else SensorErrors()


# ------------------------------------------------------------------------------------------------ IMU


def _levels(drive: CheckedDrive) -> Iterator[Check]:
    """Compare the mean of an accelerometer with gravity, without the acceleration of speed and yaw rate."""
    columns, speed, sensors = drive.columns, drive.speed, drive.vehicle.sensors
    driving_is_known = not drive.wrong & {"yaw_rate_rad_s", "ay_m_s2", drive.measured.speed_name}
    yaw = columns.get("yaw_rate_rad_s")
    failed = {c.name for c in drive.related if c.verdict == "failed"}
    for name, bias in (("ax_m_s2", sensors.ax_bias_m_s2), ("ay_m_s2", sensors.ay_bias_m_s2)):
        if name not in columns or f"{name}.unit" in failed:
            continue
        driven, at_ease = _driven(name, columns[name], speed, yaw)
        rest = columns[name] - driven
        finite = np.isfinite(rest)
        is_known = speed is not None and yaw is not None and bool((yaw[np.isfinite(yaw)] != 0.0).any())
        if independent_samples(finite) < 6.0:
            rest, finite, is_known = columns[name], np.isfinite(columns[name]), False
        if independent_samples(finite) < 2.0:
            continue
        is_gentle_enough = independent_samples(finite & at_ease) >= LEVEL_SAMPLES
        use = finite & at_ease if is_gentle_enough else finite
        left, error = float(np.mean(rest[use])), 0.0
        # Roll and tyres near their limit change the gain; the tilt is the intercept at zero acceleration.
        line = fit(columns[name], [np.ones_like(driven), driven], use)
        if line is not None:
            left, error = min(left, float(line[0][0]), key=abs), float(line[1][0])
        # A wrong sign or unit of the speed changes the rest, but not the mean: both must exceed the limit.
        figures: dict[str, Any] = {"rest": left - bias, "mean": float(np.mean(columns[name][use])) - bias}
        size = min(map(abs, figures.values()))
        # A drive in circles has a mean too: without yaw rate and speed, only a mean of about 1 g is gravity.
        is_known |= name == "ax_m_s2" and speed is not None
        if size > OTHER_AXIS_M_S2:
            if is_known or abs(float(np.mean(rest[use]))) > IS_GRAVITY_M_S2[0]:
                evidence = TEXTS["gravity"].format(std=error, **figures)
                yield result("SIGNAL.axis", "failed", name, cause="gravity", evidence=evidence)
        elif driving_is_known and is_known and is_gentle_enough:
            tilt = math.degrees(math.asin(size / GRAVITY_M_S2))
            yield judge("SIGNAL.level", size, error, name, tilt=tilt, **figures)


def _driven(
    name: str, measured: FloatArray, speed: FloatArray | None, yaw_rate: FloatArray | None
) -> tuple[FloatArray, BoolArray]:
    """Return the acceleration [N] from speed and yaw rate, 0 without them, and where the driving is gentle [N]."""
    driven, at_ease = np.zeros_like(measured), np.ones(measured.shape[0], np.bool_)
    if speed is not None and yaw_rate is not None:
        # Speed and yaw rate do not explain the acceleration of a sliding car.
        at_ease = gentle_at(yaw_rate * speed, at_ease) & gentle_at(measured - median_known(measured), at_ease)
    if speed is not None and name == "ax_m_s2":
        driven = derivative(speed)
    elif speed is not None and yaw_rate is not None:
        driven = yaw_rate * speed
    return driven, at_ease


class SensorErrors(NamedTuple):
    """Errors of accelerometer and gyro by ground truth; :data:`UNKNOWN` if the drive does not excite them.

    Attributes
    ----------
    place_m : of the accelerometer ahead of the CG. ay_gain : with body roll. ay_delay_s : of the accelerometer.
    """

    place_m: Figure = UNKNOWN
    ay_gain: Figure = UNKNOWN
    ay_delay_s: Figure = UNKNOWN
    gyro_gain: Figure = UNKNOWN


def sensor_errors(columns: Mapping[str, FloatArray]) -> SensorErrors:
    """Regress a_y and the gyro on ground truth.

    The regressors of a_y are v̇_y + v_x r (gain, with body roll), the yaw acceleration (lever arm), the derivative of
    v̇_y + v_x r (delay), a constant (bias), and v̇_y + v_x r again where it changes slowly (bank).
    """
    place = gain = ay_gain = delay = UNKNOWN
    vx, vy, rate = (columns.get(f"truth.{n}") for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    vy = columns.get(CG_VY, vy)
    gyro, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if rate is not None and gyro is not None:
        solved = fit(gyro, [rate, derivative(rate), np.ones_like(rate)], np.ones(rate.shape[0], np.bool_))
        gain = UNKNOWN if solved is None else (float(solved[0][0]), math.hypot(solved[1][0], RESAMPLED_GAIN))
    if vx is not None and vy is not None and rate is not None and ay is not None:
        lateral = derivative(vy) + vx * rate
        slow = running_mean(lateral, round(0.5 * SLOW_S / GRID_S))
        regressors = [derivative(rate), lateral, derivative(lateral), np.ones_like(rate), slow]
        late_s = 0.0
        for _ in range(DELAY_STEPS):  # iterates, because the lever-arm term is late too
            solved = fit(earlier(ay, late_s), regressors, moving_at(vx))
            if solved is None or solved[0][1] <= 0.0:
                break
            (lever, scale, slope), (lever_error, scale_error, slope_error) = (map(float, x[:3]) for x in solved[:2])
            late_s -= slope / scale
            is_converged = abs(slope / scale) < LAST_STEP_S and late_s < MOST_DELAY_S
            roll = min(max(scale, 1.0), TABLE["ay_m_s2.gain"]["limits"][1]) - 1.0
            delay = (late_s - ROLL_LAG_S * roll, slope_error / scale) if is_converged else UNKNOWN
            if place is UNKNOWN or (is_converged and late_s > FAILS_STD * delay[1]):
                place, ay_gain = (lever, lever_error), (scale, scale_error)
    return SensorErrors(place, ay_gain, delay, gain)


def ay_delay(errors: SensorErrors, latency: LatencyEstimate | None) -> Figure | None:
    """Return the delay of the accelerometer, s; None if ground truth does not show it.

    If the yaw rate of ground truth is the gyro's channel, its velocities may have another delay.
    """
    low, high = TABLE["ay_m_s2.gain"]["limits"]
    if latency is None or not latency.reliable or latency.identical or math.isnan(errors.ay_delay_s[0]):
        return None
    delay_s, error_s = errors.ay_delay_s
    is_plausible = low < errors.ay_gain[0] < high
    return (delay_s + latency.latency_s, math.hypot(error_s, latency.std_error_s)) if is_plausible else None


def _accelerometer(drive: CheckedDrive) -> Iterator[Check]:
    """Compare position, gain and delay of the accelerometer with vehicle file and ground truth."""
    errors = drive.errors
    if math.isnan(errors.place_m[0]) or "ay_m_s2" in drive.wrong:
        return
    (place, std), file = errors.place_m, drive.vehicle.imu_position_m[0]
    is_outside = abs(place - file) > max(MOST_LEVER_M, FAILS_STD * std)
    doubt = "no_car" if is_outside else "" if drive.measured.vehicle else "no_file"
    yield judge("ay_m_s2.place", place - file, std, doubt=doubt, place=place, file=file)
    if np.nanstd(drive.columns["truth.vx_m_s"] * drive.columns["truth.yaw_rate_rad_s"]) > LEAST_LATERAL_M_S2:
        unit_is_right = any(c.name == "ay_m_s2.unit" and c.verdict == "passed" for c in drive.related)
        low, high = law("lateral", of="", pace="").gains
        is_other = not low < errors.ay_gain[0] < high
        yield judge("ay_m_s2.gain", *errors.ay_gain, doubt="ground_truth" if is_other and unit_is_right else "")
    delay = ay_delay(errors, drive.measured.latency)
    if delay is not None and MS_PER_S * delay[1] <= TABLE["ay_m_s2.delay"]["limits"][1]:
        yield judge("ay_m_s2.delay", MS_PER_S * delay[0], MS_PER_S * delay[1], delay_s=delay[0])


def _gyro(drive: CheckedDrive) -> Iterator[Check]:
    """Compare gain and delay of the gyro with vehicle file and ground truth."""
    (gain, std), latency, file = drive.errors.gyro_gain, drive.measured.latency, drive.vehicle.sensors.yaw_rate_gain
    if not math.isnan(gain) and "yaw_rate_rad_s" not in drive.wrong:
        yield judge("yaw_rate_rad_s.gain", gain / file, std, gain=gain)
    if latency is not None and latency.reliable and not latency.identical:
        late_s, error_s, delay_s = latency.gyro_delay_s - latency.latency_s, latency.std_error_s, latency.gyro_delay_s
        value, late_ms, std_ms = (MS_PER_S * x for x in (delay_s, late_s, error_s))
        yield judge("yaw_rate_rad_s.delay", value, late_ms=late_ms, std_ms=std_ms, delay_s=delay_s)


def delay_checks(late: Iterable[LateSensor]) -> list[Check]:
    """Return a failed check for each signal that is late."""
    return [
        result(
            "SIGNAL.delay", "failed", name,
            evidence=sensor.evidence, delay_s=sensor.delay_s, more="" if sensor.exact else ", at least",
        )
        for sensor in late
        for name in sensor.names
    ]  # fmt: skip


def change_checks(changes: Iterable[SensorChange], start_ns: int) -> list[Check]:
    """Return a failed check for each signal that changes in mid-drive; times are in s from the log's start."""
    texts: dict[str, list[str]] = {}
    for c in changes:
        start_s, known_s, end_s = ((t - start_ns) * S_PER_NS for t in (c.start_ns, c.known_ns, c.end_ns))
        kind = "replaced" if c.kind == "stuck" and not math.isnan(c.std) else c.kind
        figures = {"size": c.size, "std": c.std, "unit": SIGNAL_UNITS[c.sensor]}
        text = TEXTS[kind].format(start_s=start_s, known_s=known_s, end_s=end_s, **figures)
        texts.setdefault(c.sensor, []).append(text)
    return [result("SIGNAL.change", "failed", name, evidence="; ".join(text)) for name, text in texts.items()]


# ------------------------------------------------------------------------------------------------ ground truth


def _sideslip_of_truth(drive: CheckedDrive) -> Iterator[Check]:
    """Check that ground-truth heading and velocity are consistent, and that sideslip is 0 on straights."""
    columns = drive.columns
    if drive.measured.derived is None or not {"truth.vx_m_s", "truth.vy_m_s"} <= columns.keys():
        return
    over_ground, of_body = _velocity_differences(columns)
    if over_ground < EXPLAINED_SHARE * of_body:
        evidence = TEXTS["over_ground"].format(over_ground=over_ground, of_body=of_body)
        yield result("SIGNAL.axis", "failed", "truth.vy_m_s", cause="over_ground", evidence=evidence)
        return
    sideslip = _sideslip(columns)
    finite = moving_at(np.hypot(columns["truth.vx_m_s"], columns["truth.vy_m_s"])) & np.isfinite(sideslip)
    if not finite.any():
        return
    typical = math.degrees(float(np.quantile(np.abs(sideslip[finite]), 1.0 - SIDEWAYS_SHARE)))
    frame = judge("truth.sideslip_rad.frame", typical)
    if frame.verdict == "failed" and _is_speed(drive, columns["truth.vy_m_s"]):
        evidence = TEXTS["is_speed"].format(value=typical)
        for name in ("truth.vx_m_s", "truth.vy_m_s"):
            yield result("SIGNAL.axis", "failed", name, cause="exchanged", evidence=evidence)
        return
    yield frame
    if frame.verdict == "passed" and {"yaw_rate_rad_s", "ay_m_s2"} <= columns.keys():
        yield offset_check(columns)


def _sideslip(columns: Mapping[str, FloatArray]) -> FloatArray:
    """Return the angle [N] of the ground-truth velocity from the direction of travel, which is backwards in reverse."""
    vx, vy = columns["truth.vx_m_s"], columns["truth.vy_m_s"]
    way = np.where((columns.get("speed_m_s", vx * 0.0) < 0.0) & (vx < 0.0), -1.0, 1.0)
    return np.asarray(np.arctan2(way * vy, way * vx))


def _velocity_differences(columns: Mapping[str, FloatArray]) -> tuple[float, float]:
    """Return the median differences, m/s, of v_x, v_y from the path's velocity, over ground and in the car's axes.

    Without positions and heading, both are 0.
    """
    axes = (POSITION, ("truth.pose_vx_m_s", "truth.pose_vy_m_s"))
    if not {*axes[0], *axes[1]} <= columns.keys():
        return 0.0, 0.0
    vx, vy = columns["truth.vx_m_s"], columns["truth.vy_m_s"]
    moving = np.where(moving_at(np.hypot(vx, vy)), 1.0, np.nan)
    over_ground, of_body = (median_known(moving * np.hypot(vx - columns[x], vy - columns[y])) for x, y in axes)
    return over_ground, of_body


def _is_speed(drive: CheckedDrive, column: FloatArray) -> bool:
    """Return whether a column equals the speed of the sensors."""
    if drive.speed is None or str(drive.measured.speed_name).startswith("truth."):
        return False
    share = median_known(np.where(moving_at(drive.speed), np.abs(column / drive.speed), np.nan))
    low, high = law("speed", name="", pace="").gains
    return low < share < high


@np.errstate(divide="ignore", invalid="ignore")
def sideslip_offset(columns: Mapping[str, FloatArray]) -> Figure:
    """Return the ground-truth sideslip on straights, rad; :data:`UNKNOWN` if too little is known."""
    names = ("yaw_rate_rad_s", "ay_m_s2", "truth.vx_m_s", "truth.vy_m_s")
    if not set(names) <= columns.keys():
        return UNKNOWN
    rate, ay, vx, vy = (columns[n] for n in names)
    gentle = gentle_at(rate * vx, moving_at(np.hypot(vx, vy)))
    solved = fit(_sideslip(columns), [np.ones_like(vx), rate / vx, ay], gentle)
    if solved is None:
        return UNKNOWN
    return float(solved[0][0]), math.hypot(solved[1][0], solved[0][2] * AY_BIAS_M_S2)


def offset_check(columns: Mapping[str, FloatArray]) -> Check:
    """Return the check of the ground-truth sideslip on straights."""
    offset, std = map(math.degrees, sideslip_offset(columns))
    return judge("truth.sideslip_rad.offset", offset, std)


def _scales_of_positions(drive: CheckedDrive) -> Iterator[Check]:
    """Compare the ground-truth positions with its velocity, along each axis."""
    if drive.wrong & {"truth.vx_m_s", "truth.vy_m_s"}:
        return
    for name, factor in zip(drive.measured.positions, position_factors(drive.columns), strict=True):
        scale = drive.measured.scales.get(name)
        line = f", scale = {scale * factor:.3g}" if isinstance(scale, float | int) else ""
        if not math.isnan(factor):
            yield judge("SIGNAL.scale", factor, signal=name, line=line)


# ------------------------------------------------------------------------------------------------ vehicle file


def _radius(drive: CheckedDrive) -> Iterator[Check]:
    """Compare the ratio of speed and wheel speed with the wheel radius of the file."""
    file, wheels = drive.vehicle.wheel_radius_m, {f"wheel_speed_{w}_rad_s" for w in WHEELS}
    per_wheel = [r.gain for r in drive.measured.relations if wheels & r.powers.keys() and "speed_m_s" in r.powers]
    if drive.measured.vehicle and drive.speed is not None and any(per_wheel):
        radius = 1.0 / float(np.median(per_wheel))
        yield judge("vehicle.wheel_radius", radius / file, radius=radius, file=file)


def _steering(drive: CheckedDrive) -> Iterator[Check]:
    """Check wheelbase with steering ratio, and under- or oversteer, by delta = s L r / v + K v r + offset."""
    columns, speed, vehicle = drive.columns, drive.speed, drive.vehicle
    rate, steer = columns.get("yaw_rate_rad_s"), columns.get("steer_rad")
    if steer is None and "steering_wheel_rad" in columns:
        steer = columns["steering_wheel_rad"] / vehicle.steering_ratio
    is_misread = drive.wrong & {"yaw_rate_rad_s", "steer_rad", "steering_wheel_rad"}
    if drive.measured.vehicle is None or speed is None or rate is None or steer is None or is_misread:
        return
    curved, lateral = vehicle.wheelbase_m * rate / speed, rate * speed
    gentle = gentle_at(lateral, moving_at(speed))
    solved = fit(steer, [curved, lateral, np.ones_like(steer)], gentle)
    speeds = np.abs(speed[gentle & np.isfinite(speed)])
    (share, share_std), (gradient, std), file = UNKNOWN, UNKNOWN, 0.0
    # At constant speed, curvature and lateral acceleration are proportional.
    if solved is not None and np.quantile(speeds, 0.9) >= SPEED_SPREAD * np.quantile(speeds, 0.1):
        spread = float(np.std(steer[gentle & np.isfinite(steer)]))
        if solved[0][0] > 0.0 and solved[2] <= UNEXPLAINED_STEERING * spread:
            (share, gradient, _), (share_std, std, _) = solved[:2]
            file = vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)
    yield judge("vehicle.steering", share, share_std)
    drive_mrad, std_mrad, file_mrad = (1e3 * float(x) for x in (gradient, std, file))
    agreement = math.copysign(1.0, file) * drive_mrad
    if min(abs(drive_mrad), abs(file_mrad)) < NEUTRAL_MRAD_PER_M_S2:
        agreement = max(agreement, NEUTRAL_MRAD_PER_M_S2)
    drives, by_file = ("understeers", "oversteers")[:: 1 if gradient > 0.0 else -1]
    figures: dict[str, Any] = {"drive": drive_mrad, "file": file_mrad, "drives": drives, "by_file": by_file}
    yield judge("vehicle.understeer", agreement, std_mrad, **figures)


def _mass(drive: CheckedDrive) -> Iterator[Check]:
    """Compare the driven lateral acceleration with the limit by tyres and mass of the file."""
    columns, speed, vehicle = drive.columns, drive.speed, drive.vehicle
    rate, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if drive.measured.vehicle is None or speed is None or rate is None or ay is None:
        return
    # Roll increases a_y, and the yaw rate is too high when a car begins to spin.
    lateral = np.minimum(np.abs(ay), np.abs(rate * speed))
    finite = lateral[np.isfinite(lateral)]
    friction = max(1.0, vehicle.assumed_friction)
    carried = [vehicle.magic_formula(front, friction)[2] / vehicle.axle_load_n(front) for front in (True, False)]
    most = GRAVITY_M_S2 * min(carried)
    driven = float(np.quantile(finite, 0.99)) if finite.size else 0.0
    yield judge("vehicle.mass", driven / most, driven=driven, most=most)


# ------------------------------------------------------------------------------------------------ all checks

FUNCTIONS: tuple[Callable[[CheckedDrive], Iterable[Check]], ...] = (
    lambda drive: drive.related,
    _levels,
    _sideslip_of_truth,
    _scales_of_positions,
    _accelerometer,
    _gyro,
    _radius,
    _steering,
    _mass,
)


@np.errstate(divide="ignore", invalid="ignore")
def check_drive(measured: Measured) -> tuple[Check, ...]:
    """Return the checks of mapped signals, of ground truth and of the vehicle file."""
    drive = CheckedDrive(measured, relation_checks(measured))
    unique: dict[str, Check] = {}
    for check in (check for function in FUNCTIONS for check in function(drive)):
        if check.name not in unique or _BADNESS[check.verdict] > _BADNESS[unique[check.name].verdict]:
            unique[check.name] = check  # the worse of two checks with one name counts
    # Ground truth decides about delays before the signals do.
    return tuple(({c.name: c for c in delay_checks(measured.late)} | unique).values())


def misread_channels(checks: Sequence[Check], waived: Sequence[str] = ()) -> dict[str, str]:
    """Return the subjects that must not be used, with the reason: a failed check that is not waived, and its remedy."""
    misread: dict[str, str] = {}
    for check in checks:
        subject, _, aspect = check.name.rpartition(".")
        if check.verdict == "failed" and aspect in _MISREAD and check.name not in waived:
            misread.setdefault(subject, f"check {check.name} failed: {check.remedy}")
    return misread
