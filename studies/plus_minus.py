"""Coverage of every "±" that the tool prints: true values of simulated cars within 1.96 standard deviations.

Each car drives with a vehicle file whose stiffness is wrong by a factor 0.5 to 2 at each axle, and whose inertia, roll
gradient and IMU position are wrong as the prior of the calibration expects, with a steering that is as wrong and late.
Figures of the checks are read from their printed text, others from records.
``python -m studies.plus_minus`` writes the table into ``docs/calibration.md``, as ``studies.calibration`` does.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Drive, friction_of
from pdhef_logtool.estimators.calibration import joint
from pdhef_logtool.evaluation.metrics import NORMAL_95
from studies.condition_drives import as_read
from studies.pages import DOCS, fill, table, write
from studies.self_calibration import calibrate, simulated_drives
from truthsim.sensors import SensorNoise

#: Manoeuvre, km/h, seconds (None: its own).
DRIVEN: tuple[tuple[str, float, float | None], ...] = (
    ("sine-sweep-wide", 90.0, None),
    ("road", 100.0, 120.0),
    ("dlc", 80.0, None),
    ("sine-with-dwell", 80.0, None),
    ("road", 60.0, 60.0),
)
CARS, SEED = 30, 99_005
#: Lowest and highest share of values that a ± with 95 % coverage may have.
ACCEPTED = (0.90, 0.98)
_PRINTED = re.compile(r"(-?[\d.]+) \+- ([\d.]+)")
#: Printed decimals are rounded: half of the last place is added to the standard deviation.
_ROUNDED = {"deg": 0.005, "m": 0.005, "1": 0.005, "ms": 0.05, "gain": 0.0005, "mrad": 0.005}


@dataclass(frozen=True, slots=True)
class Printed:
    """One printed figure: what it is, the manoeuvre, its error and its standard deviation."""

    quantity: str
    manoeuvre: str
    error: float
    sd: float

    @property
    def covered(self) -> bool:
        """Whether the true value is within 1.96 standard deviations."""
        return abs(self.error) <= NORMAL_95 * self.sd


def with_prior_errors(file: VehicleParameters, noise: SensorNoise, rng: np.random.Generator) -> VehicleParameters:
    """Return a vehicle file whose other entries are as wrong as the prior of the calibration expects."""
    inertia, roll, place = rng.normal(size=3)
    reach = 0.4 * file.wheelbase_m
    gain = max(0.0, file.roll_gradient_rad_per_m_s2 + 0.03 / GRAVITY_M_S2 * roll)
    changed = {
        "yaw_inertia_kg_m2": file.yaw_inertia_kg_m2 * math.exp(0.2 * inertia),
        "roll_gradient_rad_per_m_s2": gain,
        "imu_position_m": (noise.imu_x_m + reach * place, *file.imu_position_m[1:]),
    }
    return file.model_copy(update=changed)


def of_checks(drive: Drive, file: VehicleParameters, noise: SensorNoise) -> Iterator[tuple[str, float, float]]:
    """Yield name, error and standard deviation of the figures in the texts of checks, against the simulated car."""
    true = {
        "truth.sideslip_rad.offset": (-math.degrees(noise.rtk_heading_offset_rad), "deg"),
        "ay_m_s2.place": (noise.imu_x_m - noise.rtk_x_m, "m"),
        "ay_m_s2.gain": (1.0 + GRAVITY_M_S2 * file.roll_gradient_rad_per_m_s2, "1"),
        "ay_m_s2.delay": (0.0, "ms"),
        "yaw_rate_rad_s.gain": (1.0, "gain"),
        "yaw_rate_rad_s.delay": (0.0, "ms"),
        "vehicle.steering": (1.0, "1"),
        "vehicle.understeer": (1e3 * file.understeer_gradient_rad_per_m_s2(file.assumed_friction), "mrad"),
    }
    for check in drive.plan.checks:
        printed = _PRINTED.search(check.evidence)
        if check.name in true and printed is not None:
            value, place = true[check.name]
            yield f"check `{check.name}`", float(printed[1]) - value, float(printed[2]) + _ROUNDED[place]


def of_calibration(
    drive: Drive, file: VehicleParameters, wrong: VehicleParameters, noise: SensorNoise, rng: np.random.Generator
) -> Iterator[tuple[str, float, float]]:
    """Yield name, error and standard deviation of the calibrated parameters whose true value the car has."""
    signals = drive.whole().signals
    gain, delay_s = math.exp(0.08 * rng.normal()), 0.02 * rng.normal()
    time_s = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    late = gain * np.interp(time_s - delay_s, time_s, signals.steer_rad)
    calibration = calibrate(replace(signals, steer_rad=late), wrong)
    if calibration.refused:
        return
    mu = file.assumed_friction
    true = {
        joint.FRONT_STIFFNESS: file.cornering_stiffness_n_per_rad(True, mu),
        joint.REAR_STIFFNESS: file.cornering_stiffness_n_per_rad(False, mu),
        joint.INERTIA: file.yaw_inertia_kg_m2,
        joint.STEER_RATIO: wrong.steering_ratio * gain,
        joint.STEER_DELAY: -delay_s,
        joint.AY_GAIN: 1.0 + GRAVITY_M_S2 * file.roll_gradient_rad_per_m_s2,
        joint.IMU_X: noise.imu_x_m,
    }
    for p in calibration.parameters:
        if p.name in true:
            error = math.log(p.value / true[p.name]) if p.log else p.value - true[p.name]
            yield f"calibrated {p.name}", error, p.sd
    if calibration.understeer is not None:
        error = calibration.understeer.drive - file.understeer_gradient_rad_per_m_s2(mu)
        yield "calibrated understeer gradient", error, calibration.understeer.drive_sd


def of_friction(drive: Drive, friction: float) -> Iterator[tuple[str, float, float]]:
    """Yield the friction estimate once a second where the drive shows it."""
    estimate = drive.whole().signals.friction
    source = drive.friction
    std = source.std
    for i in np.flatnonzero(source.observable)[::100]:
        yield "friction estimate", float(estimate[i]) - friction, float(std[i])


def measured(cars: int, seed: int) -> list[Printed]:
    """Simulate the cars, read their drives, and return all that is printed with a ±."""
    results: list[Printed] = []
    for simulated, raw, noise in simulated_drives(cars, seed, DRIVEN, steer_gain=0.0):
        rng = np.random.default_rng([seed, simulated.car, 1])
        wrong_file = with_prior_errors(simulated.file.with_stiffness(*simulated.factors), noise, rng)
        friction, printed = float(simulated.file.assumed_friction), list[tuple[str, float, float]]()
        for name, file in (("wrong", wrong_file), ("right", simulated.file)):
            car = Car.of(file.model_copy(update={"friction": None}))
            with as_read(raw, car, ReadOptions(friction="auto", prefer_truth="rtk")) as drive:
                drive.friction = friction_of(drive.plan, car.vehicle, drive.options, validated=name == "right")
                printed += [(f"{text}, {name} file", error, sd) for text, error, sd in of_friction(drive, friction)]
                if name == "wrong":
                    printed += [*of_checks(drive, simulated.file, noise)]
                    printed += [*of_calibration(drive, simulated.file, wrong_file, noise, rng)]
        results += [Printed(name, simulated.manoeuvre, error, sd) for name, error, sd in printed]
    return results


def coverage_table(printed: Sequence[Printed]) -> str:
    """Return the share of true values within ± 1.96 sd by quantity, and by manoeuvre where it differs most."""
    body = []
    for name in sorted({p.quantity for p in printed}):
        some = [p for p in printed if p.quantity == name]
        share = float(np.mean([p.covered for p in some]))
        by = {m: [p.covered for p in some if p.manoeuvre == m] for m in dict.fromkeys(p.manoeuvre for p in some)}
        least = min(by, key=lambda m: np.mean(by[m]))
        spread = float(np.sqrt(np.mean([(p.error / p.sd) ** 2 for p in some])))
        low, high = ACCEPTED
        verdict = "yes" if low <= share <= high else "too wide" if share > high else "no"
        worst = f"{np.mean(by[least]):.0%} ({least})"
        body.append([name, str(len(some)), f"{share:.0%}", f"{spread:.2f}", worst, verdict])
    head = ["figure", "values", "within ± 1.96 sd", "RMS error / sd", "lowest of a manoeuvre", "90 to 98 %"]
    return table(head, body, right_from=1)


def fill_page(page: Path, cars: int = CARS) -> None:
    """Write the table into its place in a page."""
    text = coverage_table(measured(cars, SEED))
    write(page, fill(page.read_text(encoding="utf-8"), {"plus-minus": text}, str(page)))


if __name__ == "__main__":
    fill_page(DOCS / "calibration.md")
