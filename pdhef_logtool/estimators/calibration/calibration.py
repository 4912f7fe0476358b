"""Calibration of a car by its logs without ground truth: results of the fit of :mod:`~.joint`.

See docs/method.md#self-calibration.

A calibration belongs to the log, or the pool of logs, that it was fitted to. Mass and position of the centre of gravity
come from the file. Parameters that are not observable in the driving keep their prior and widen the interval.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.parts import LIMIT_GAIN, FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.estimators.calibration.driving import Driving
from pdhef_logtool.estimators.calibration.joint import (
    DERIVATIVE_STEP,
    ERROR_STD,
    FRONT_STIFFNESS,
    RATIO,
    REAR_STIFFNESS,
    STEER_DELAY,
    JointProblem,
    Parameter,
    driven,
    front_stiffness,
    peak_reached,
    prior_of,
    prior_variations,
    prior_vehicle,
    varied_parameters,
)
from pdhef_logtool.estimators.calibration.single_track import AY, OF_AY, OF_RATE, YAW_RATE
from pdhef_logtool.records.signals import FloatArray

#: Standard deviation of a_y in ``physics`` on a calibrated car, m/s²: model error, larger than the sensor's noise.
AY_STD = 1.0
#: Process noise of ``physics`` on a calibrated car: PHYSICS_Q_STD with more for the axle forces, so that kinematics
#: have more influence beyond the linear range, where the fitted tyres are least certain.
Q_STD = (0.085, 0.12, 0.012, 0.086, 1.0, 1.0)
#: Minimum driving above the low-speed limit.
LEAST_S = 5.0
#: A fit is rejected if its error exceeds this share of the RMS of yaw rate or of a_y, and this multiple of
#: ``ERROR_STD``: sign or topic of a signal may be wrong, or the car spins.
LARGEST_SHARE, LARGEST_ERROR = 0.5, 1.0
#: A fit is rejected if the rear axle slides for this time and this share of the driving: beyond this slip angle the
#: lateral force depends on longitudinal slip, which the model lacks.
SLIDING_RAD, SLIDING_S, SLIDING_SHARE = math.radians(8.0), 10.0, 0.2
#: Correlation of a parameter between two drives of a car, about the mean of its prior.
CORRELATION = 0.9
#: Maximum number of posterior directions in an interval.
VARIED = 5
#: Smallest difference of understeer gradients that is reported as a contradiction, rad/(m/s²).
LEAST_CONTRADICTION = 1.5e-3


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One parameter: value, prior mean, posterior and prior 1-sigma, in its logarithm where ``log``."""

    name: str
    unit: str
    value: float
    prior: float
    sd: float
    prior_sd: float
    log: bool

    @property
    def excited(self) -> bool:
        """Whether its standard deviation is below half the prior's."""
        return self.sd < 0.5 * self.prior_sd


@dataclass(frozen=True, slots=True)
class Understeer:
    """Understeer gradient of the file and of the fit, rad/(m/s²)."""

    file: float
    drive: float
    drive_sd: float

    @property
    def contradicts(self) -> bool:
        """Whether file and drive contradict each other."""
        return abs(self.drive - self.file) > max(3.0 * self.drive_sd, LEAST_CONTRADICTION)

    @property
    def text(self) -> str:
        """Description in deg/g."""
        unit = math.degrees(GRAVITY_M_S2)
        verdict = "contradicts" if self.contradicts else "agrees with"
        return f"understeer {self.drive * unit:.1f} deg/g {verdict} the file's {self.file * unit:.1f} deg/g"


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """Calibration of a car on the driving of a log, or of a pool of logs, without ground truth.

    Attributes
    ----------
    vehicle_file : the file. vehicle : the file with the fitted parameters, also if the fit is rejected.
    refused : why the file is used unchanged; empty if the fit is accepted.
    rms : RMS error of yaw rate in rad/s and of a_y in m/s²; of_file : the same of the vehicle file.
    seconds : used driving. logs : number of logs in the pool.
    varied : vehicles one posterior 1-sigma away, one per direction with a large effect on the sideslip.
    sliding_friction : the friction that a_y reaches, if the fit is rejected because the car slides; None otherwise.
    """

    vehicle_file: VehicleParameters
    vehicle: VehicleParameters
    parameters: tuple[Calibrated, ...]
    understeer: Understeer | None
    refused: str
    rms: tuple[float, float]
    of_file: tuple[float, float]
    seconds: float
    logs: int
    varied: tuple[VehicleParameters, ...] = ()
    sliding_friction: float | None = None

    @property
    def steer_delay_s(self) -> float:
        """Delay of the steering angle; 0 if it was not fitted."""
        return next((p.value for p in self.parameters if p.name == STEER_DELAY), 0.0)

    @property
    def noise(self) -> FilterNoise:
        """Noise of ``physics`` for the calibrated car."""
        ay_std = max(AY_STD, self.vehicle_file.sensors.ay_std_m_s2)
        return FilterNoise(q_std=Q_STD, r_std={"ay_m_s2": ay_std}, limit_gain=LIMIT_GAIN)

    @property
    def error_scale(self) -> float:
        """RMS of the model error over ``ERROR_STD``, at least 1, as a good fit is no proof of a better model."""
        return float(np.fmax(1.0, np.sqrt(np.mean((np.array(self.rms) / np.array(ERROR_STD)) ** 2))))

    @property
    def text(self) -> str:
        """Summary in one line."""
        if not self.parameters and not self.refused:
            return "not calibrated: all parameters keep their prior"
        if self.refused:
            return f"not calibrated, the vehicle file is used: {self.refused}"
        by = {p.name: p for p in self.parameters}
        mu = self.vehicle_file.assumed_friction
        share = [
            f"{axle} stiffness {by[name].value / self.vehicle_file.cornering_stiffness_n_per_rad(front, mu) - 1.0:+.0%}"
            f" ± {by[name].sd:.0%}"
            for axle, name, front in (("front", FRONT_STIFFNESS, True), ("rear", REAR_STIFFNESS, False))
        ]
        where = "this log" if self.logs == 1 else f"{self.logs} logs"
        understeer = "" if self.understeer is None else f"; {self.understeer.text}"
        idle = [p.name for p in self.parameters if not p.excited]
        rest = f"; not excited: {', '.join(idle)}" if idle else ""
        return (
            f"calibrated without ground truth on {self.seconds:.0f} s of {where}: {', '.join(share)}{understeer}{rest}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the calibration as JSON-able values."""
        u = self.understeer
        return {
            "refused": self.refused or None,
            "text": self.text,
            "seconds": self.seconds,
            "logs": self.logs,
            "parameters": [{**asdict(p), "excited": p.excited} for p in self.parameters],
            "understeer": None
            if u is None
            else {
                "file_rad_per_m_s2": u.file,
                "drive_rad_per_m_s2": u.drive,
                "drive_sd_rad_per_m_s2": u.drive_sd,
                "contradicts": u.contradicts,
            },
            "friction_fixed_at": self.vehicle_file.assumed_friction,
            "yaw_rate_rms_rad_s": self.rms[OF_RATE],
            "ay_rms_m_s2": self.rms[OF_AY],
            "file_yaw_rate_rms_rad_s": self.of_file[OF_RATE],
            "file_ay_rms_m_s2": self.of_file[OF_AY],
        }


def self_calibrate(
    drives: Sequence[Driving],
    vehicle_file: VehicleParameters,
    *,
    taught: Sequence[TaughtParameter] = (),
) -> SelfCalibration:
    """Calibrate a car on the driving of its logs, which were read with ``vehicle_file``.

    Parameters
    ----------
    taught : prior from drives with ground truth. It cannot make a rejected calibration acceptable, as the model
        explains such driving with no parameters. It is omitted if the fit is rejected only with it.
    """
    drives = [d.informative() for d in drives if len(d.stretches)]
    seconds = sum(d.seconds for d in drives)
    if seconds < LEAST_S:
        why = f"{seconds:.0f} s above {vehicle_file.low_speed_blend_m_s:g} m/s, {LEAST_S:g} are needed"
        return _without_fit(vehicle_file, vehicle_file, why, seconds, len(drives))
    problem = JointProblem(drives, vehicle_file)
    theta = problem.solve()
    refused, slides = _refusal(problem, theta, drives)
    prior = prior_of(vehicle_file)
    if taught and not refused:
        with_prior = problem.taught(taught)
        place = with_prior.solve()
        if not _refusal(with_prior, place, drives)[0]:
            problem, theta, prior = with_prior, place, with_prior.parameters
    theta, covariance = problem.posterior(theta)
    parameters = posterior_of(problem, theta, covariance, prior)
    root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    varied = varied_parameters(theta, root, problem.sideslip, VARIED)
    return SelfCalibration(
        vehicle_file,
        problem.vehicle(theta),
        parameters,
        _understeer(problem, theta, covariance, vehicle_file),
        refused,
        problem.rms(theta),
        problem.rms(None),
        seconds,
        len(drives),
        tuple(problem.vehicle(to) for to in varied),
        peak_reached(drives, vehicle_file) * vehicle_file.assumed_friction if slides else None,
    )


def posterior_of(
    problem: JointProblem, theta: FloatArray, covariance: FloatArray, prior: Sequence[Parameter]
) -> tuple[Calibrated, ...]:
    """Return the parameters of a posterior, with the stiffness of the front axle beside the ratio of the axles."""
    file, fitted = prior_of(problem.vehicle_file), problem.parameters
    sd = np.sqrt(np.diag(covariance))
    rows = {
        p.name: Calibrated(p.name, p.unit, p.value(float(t)), before.mean, float(s) * p.std, wide.std, p.log)
        for p, before, wide, t, s in zip(fitted, prior, file, theta, sd, strict=True)
    }
    ratio, rear = rows[RATIO], rows[REAR_STIFFNESS]
    (i, j) = (list(rows).index(name) for name in (RATIO, REAR_STIFFNESS))
    std = math.sqrt(ratio.sd**2 + rear.sd**2 + 2.0 * covariance[i, j] * fitted[i].std * fitted[j].std)
    value = front_stiffness(problem.vehicle_file, ratio.value, rear.value)
    before = front_stiffness(problem.vehicle_file, ratio.prior, rear.prior)
    prior_sd = math.hypot(ratio.prior_sd, rear.prior_sd)
    return Calibrated(FRONT_STIFFNESS, rear.unit, value, before, std, prior_sd, log=True), *rows.values()


def as_prior(
    parameters: Sequence[Calibrated], correlation: float = CORRELATION, level_m_s2: float = 0.0
) -> tuple[TaughtParameter, ...]:
    """Return the posterior of earlier drives as the prior for a later drive of the car.

    Its width contains the spread between drives, so that the sensors of the later drive can overrule it.

    Parameters
    ----------
    correlation : of a parameter between two drives of a car, about the mean of its prior.
    level_m_s2 : lateral acceleration of the drives; 0 if unknown.
    """

    def of(p: Calibrated) -> TaughtParameter:
        moved = (p.value / p.prior) ** correlation if p.log else correlation * (p.value - p.prior)
        value = p.prior * moved if p.log else p.prior + moved
        std = math.sqrt(p.prior_sd**2 - correlation**2 * max(p.prior_sd**2 - p.sd**2, 0.0))
        return TaughtParameter(
            name=p.name, value=float(f"{value:.9g}"), std=float(f"{std:.6g}"), ay_m_s2=float(f"{level_m_s2:.4g}")
        )

    return tuple(map(of, parameters))


def _without_fit(
    vehicle_file: VehicleParameters, vehicle: VehicleParameters, refused: str = "", seconds: float = 0.0, logs: int = 1
) -> SelfCalibration:
    none = (math.nan, math.nan)
    return SelfCalibration(vehicle_file, vehicle, (), None, refused, none, none, seconds, logs)


def prior_calibration(vehicle_file: VehicleParameters, taught: Sequence[TaughtParameter] = ()) -> SelfCalibration:
    """Return the calibration before any driving: prior means, with the prior variations that affect sideslip most."""
    centre = prior_vehicle(vehicle_file, taught)
    return replace(_without_fit(vehicle_file, centre), varied=prior_variations(centre, prior_of(vehicle_file, taught)))


def _understeer(
    problem: JointProblem, theta: FloatArray, covariance: FloatArray, vehicle_file: VehicleParameters
) -> Understeer:
    def gradient(place: FloatArray) -> float:
        vehicle = problem.vehicle(place)
        return vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)

    centre = gradient(theta)
    steps = DERIVATIVE_STEP * np.eye(theta.size)
    slope = np.array([gradient(theta + step) - centre for step in steps]) / DERIVATIVE_STEP
    file = vehicle_file.understeer_gradient_rad_per_m_s2(vehicle_file.assumed_friction)
    return Understeer(file, centre, math.sqrt(float(slope @ covariance @ slope)))


def _refusal(problem: JointProblem, theta: FloatArray, drives: Sequence[Driving]) -> tuple[str, bool]:
    """Return why a fit is rejected, its error is too large or the car slides, and whether it slides."""
    rms = problem.rms(theta)
    for name, column, row in (("yaw rate", YAW_RATE, OF_RATE), ("lateral acceleration", AY, OF_AY)):
        measured = driven(drives, column)
        share = rms[row] / max(float(np.sqrt(np.mean(measured**2))), 1e-9)
        if share > LARGEST_SHARE and rms[row] > LARGEST_ERROR * ERROR_STD[row]:
            return f"the model leaves {share:.0%} of the {name}, at most {LARGEST_SHARE:.0%} is plausible", False
    sliding = float(np.mean(np.abs(problem.rear_slip(theta)) > SLIDING_RAD))
    if sliding > SLIDING_SHARE and sliding * sum(d.seconds for d in drives) > SLIDING_S:
        return f"the rear axle slides in {sliding:.0%} of the driving", True
    return "", False
