"""Which cause costs how much: the same simulated drive again with one cause of error taken away.

The motion is driven anew from the manifest's entry (same car, course and amplitude), sensed with the same seed, and
handed on as the log of it would be. Noise and bias are drawn even where their size is 0, so that taking one away leaves
all others as they were.

=============  =========================================================================================================
cause          what is taken away
=============  =========================================================================================================
``told``       the estimator is told the true friction and gets all sensors, where the row withholds something
``vehicle``    a vehicle file of that very car on that very road: mass, geometry, axle tyres and roll gradient from a
               slow ramp steer of it, as ``sample_logs/vehicle.toml`` is made; the noise tables stay
``bias``       constant biases, slow walks, errors of scale, and faults that are biases
``noise``      white noise; quantisation stays
``tilt``       the accelerometers read the planar acceleration: no roll, pitch, bank or grade in them
``delay``      10 ms of the bus, and faults that are delays
``fault``      every other fault
``all``        all of these at once
=============  =========================================================================================================

What stays has no switch in the simulator: tyre relaxation, load transfer, combined slip, the shape of the tyres that
one axle formula does not follow, and the pull of a banked road on the car, which the nominal model does not know: there
the tilt of the accelerometer even tells it the tyres' force, so that taking it away does harm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, correct_signals
from pdhef_logtool.drive.alignment import align, plan_alignment
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.signals import SIGNAL_UNITS, WHEELS, Channel, FloatArray, Signals
from pdhef_logtool.records.tracks import make_track
from studies.condition_drives import ConditionDrive, told
from studies.defaults.fit_nominal_tyres import (
    LINEAR_A_Y_M_S2,
    axle_curves,
    axle_loads_n,
    fit_axle,
    ramp,
    roll_gradient_rad_per_m_s2,
)
from truthsim.batch import DriveSpec, sensor_noise
from truthsim.drive import START_NS, reference_steer_rad
from truthsim.faults import apply_faults, parse_fault, rtk_outages
from truthsim.manoeuvres import GRAVITY_M_S2, MANOEUVRES, Request
from truthsim.motion import Motion, simulate_motion
from truthsim.sensors import IMU_PERIOD_S, STEER_PHASE_S, WHEEL_PHASE_S, SensorChannel, SensorNoise, sense
from truthsim.vehicle import Vehicle
from truthsim.vehicle_choice import choose_vehicle

CAUSES = ("told", "vehicle", "bias", "noise", "tilt", "delay", "fault", "all")
_BIASES = ("acceleration_bias_m_s2", "yaw_rate_bias_rad_s", "steer_bias_rad", "wheel_scale", "steer_gain",
           "acceleration_walk_m_s2", "yaw_rate_walk_rad_s")  # fmt: skip
_WHITE = ("acceleration_m_s2", "yaw_rate_rad_s", "steer_rad", "wheel_speed_m_s")
_SENSOR_OF = {"imu": ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"), "steering": ("steer_rad",)}


@dataclass(frozen=True, slots=True, eq=False)
class Rerun:
    """A drive of the manifest, driven again: what it was made from and its motion."""

    name: str
    spec: DriveSpec
    vehicle: Vehicle
    noise: SensorNoise
    motion: Motion
    rtk_rate_hz: int


@dataclass(frozen=True, slots=True)
class Case:
    """What an estimator gets when a cause is taken away; ``use_speed`` False without wheel speeds."""

    drive: ConditionDrive
    signals: Signals
    vehicle: VehicleParameters
    use_speed: bool


def drive_again(entry: Mapping[str, Any]) -> Rerun:
    """Return the motion of a manifest's entry."""
    given = {f.name: entry[f.name] for f in fields(DriveSpec)}
    spec = DriveSpec(
        **{
            **given,
            "faults": tuple(given["faults"]),
            "without": tuple(given["without"]),
            "sensors": tuple((str(k), float(v)) for k, v in given["sensors"]),
        }
    )
    chosen, car = MANOEUVRES[spec.manoeuvre], choose_vehicle(spec.vehicle)
    request = Request(spec.speed_km_h / 3.6, spec.friction, spec.seed, spec.duration_s, spec.amplitude)
    if chosen.uses_reference:
        request = replace(request, reference_rad=reference_steer_rad(request.speed_m_s, spec.friction, car))
    request = replace(request, scale=float(entry["scale"]))
    motion = simulate_motion(
        chosen.plan(request),
        spec.friction,
        vehicle=car,
        period_s=IMU_PERIOD_S,
        phases_s=(0.0, STEER_PHASE_S, WHEEL_PHASE_S),
    )
    return Rerun(entry["file"], spec, car, sensor_noise(dict(spec.sensors)), motion, chosen.rtk_rate_hz)


def causes_of(spec: DriveSpec, assume: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the causes that a drive of a row has; the others have nothing to take away."""
    kinds = {parse_fault(f).kind for f in spec.faults}
    has = {"told": bool(assume), "fault": bool(kinds - {"bias", "delay"})}
    return tuple(c for c in CAUSES if has.get(c, True))


def without(
    run: Rerun, cause: str | None, vehicle: VehicleParameters, assume: Mapping[str, Any], fitted: VehicleParameters
) -> Case:
    """Return a drive with a cause taken away; None takes nothing away.

    Parameters
    ----------
    vehicle, fitted : the file that the table uses, and that of this very car (:func:`fit_vehicle`).
    assume : what the row tells the estimator.
    """
    gone = set(CAUSES[:-1]) if cause == "all" else {cause}
    silent = {"bias": _BIASES, "noise": _WHITE, "delay": ("can_delay_s", "jitter_s")}
    names = [name for cause, kinds in silent.items() if cause in gone for name in kinds]
    noise = run.noise._replace(**dict.fromkeys(names, 0.0))
    faults = [f for f in map(parse_fault, run.spec.faults) if _group(f.kind) not in gone]
    seed = run.spec.seed
    channels = apply_faults(
        sense(run.motion, run.vehicle, noise, seed, run.rtk_rate_hz, rtk_outages(faults)), faults, noise, seed
    )
    used = fitted if "vehicle" in gone else vehicle
    if "tilt" in gone:
        channels = {**channels, "imu": _planar(channels["imu"], run.motion)}
        used = used.model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
    drive = as_read(channels, run, used)
    row = {} if "told" in gone else dict(assume)
    return Case(drive, told(drive, row), used, row.get("sensors") != "esp")


def _group(kind: str) -> str:
    return kind if kind in ("bias", "delay") else "fault"


def _planar(imu: SensorChannel, motion: Motion) -> SensorChannel:
    changed = dict(imu.fields)
    for axis in ("x", "y"):
        tilt = motion.column(f"specific_force_{axis}_m_s2") - motion.column(f"a{axis}_m_s2")
        changed[f"a{axis}_m_s2"] = imu.fields[f"a{axis}_m_s2"] - np.interp(imu.times_s, motion.times_s, tilt)
    return SensorChannel(imu.times_s, imu.arrival_s, changed)


def as_read(channels: Mapping[str, SensorChannel], run: Rerun, vehicle: VehicleParameters) -> ConditionDrive:
    """Return sensor channels as a reader of their log would, with the perfect truth at the same stamps."""
    found: dict[str, Channel] = {}

    def add(name: str, sensor: SensorChannel, values: FloatArray) -> None:
        known = np.isfinite(values)
        stamps, arrival = sensor.stamps_ns(START_NS)[known], sensor.arrival_ns(START_NS)[known]
        found[name] = Channel(name, SIGNAL_UNITS[name], name, stamps, np.maximum(arrival, stamps), values[known])

    for sensor, names in _SENSOR_OF.items():
        for name in names:
            values = channels[sensor].fields[name]
            # A steering report holds single precision.
            single = values.astype(np.float32).astype(np.float64) if name == "steer_rad" else values
            add(name, channels[sensor], single)
    for w in WHEELS:
        add(f"wheel_speed_{w}_m_s", channels["wheels"], channels["wheels"].fields[f"{w}_m_s"])
    motion = run.motion
    at = SensorChannel(motion.times_s, motion.times_s, {})
    add("friction", at, np.mean([motion.column(f"friction_{w}") for w in WHEELS], axis=0))
    plan = plan_alignment(found, steering_ratio=vehicle.steering_ratio, wheel_radius_m=vehicle.wheel_radius_m)
    start = min(int(c.stamps_ns[0]) for c in found.values())
    end = max(int(c.stamps_ns[-1]) for c in found.values()) + 1
    signals = correct_signals(align(found, plan, start, end), vehicle)
    times = (signals.stamps_ns - START_NS) * 1e-9
    truth = make_track(
        "truth",
        signals.stamps_ns,
        **{
            n: np.interp(times, motion.times_s, motion.column(n), left=np.nan, right=np.nan)
            for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")
        },
    )
    return ConditionDrive(run.name, signals, truth, vehicle.low_speed_blend_m_s)


def fit_vehicle(car: Vehicle, friction: float, vehicle: VehicleParameters) -> VehicleParameters:
    """Return the vehicle file with mass, geometry, axle tyres and roll gradient of a simulated car on a road.

    Raises
    ------
    SimulationError
        The car cannot be driven through the ramp.
    """
    motion = ramp(friction, car)
    if not np.isfinite(motion.column("ay_m_s2")).all():
        raise SimulationError(expected="a finite ramp steer", got="NaN or infinity", where="error budget")
    tyres, loads_n = {}, axle_loads_n(car)
    for axle, (alpha, force) in axle_curves(motion, car).items():
        # Beyond the peak the car slides in ever other ways; the curve is fitted up to it.
        whole = slice(0, int(np.argmax(force)) + 1)
        fit = fit_axle(alpha[whole] / friction, force[whole] / friction, loads_n[axle])
        tyres[axle] = AxleTyre(B=fit.B, C=fit.C, D_n=fit.D_n, E=fit.E, reference_friction=1.0)
    linear_m_s2 = min(LINEAR_A_Y_M_S2, 0.5 * friction * GRAVITY_M_S2)
    return vehicle.model_copy(
        update={
            "mass_kg": car.mass_kg,
            "yaw_inertia_kg_m2": car.yaw_inertia_kg_m2,
            "cg_to_front_axle_m": car.cg_to_front_axle_m,
            "cg_to_rear_axle_m": car.cg_to_rear_axle_m,
            "track_m": car.track_m,
            "cg_height_m": car.cg_height_m,
            "roll_gradient_rad_per_m_s2": roll_gradient_rad_per_m_s2(motion, linear_m_s2),
            "tyres": Tyres(front=tyres["front"], rear=tyres["rear"]),
        }
    )
