"""Random simulated cars, each with individual sensors and an individual vehicle file.

Saloons, SUVs and hatchbacks of all loads, heights, tyres and wear, with sensors of all qualities. The file of a car is
fitted to a ramp steer (``fit_vehicle``), as after a measurement.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdhef_logtool.car.vehicle import Tyres, VehicleParameters
from pdhef_logtool.records.errors import SimulationError
from studies.defaults import fit_nominal_tyres as nominal
from studies.pages import read_toml
from truthsim.linear_theory import understeer_gradient_rad_per_m_s2
from truthsim.sensors import SensorNoise
from truthsim.vehicle import GRAVITY_M_S2, Vehicle
from truthsim.vehicle_choice import choose_vehicle

KINDS = ("sedan", "suv")
#: Share of the cars that get the tyres of the other kind.
OTHER_TYRES_SHARE = 0.3
#: Ranges of the uniform draws, factors on the usual 1-sigma of sensors, and ranges of their other values.
_DRAWS = read_toml(Path(__file__).with_suffix(".toml"))
STEER_GAIN = 0.01
#: Less understeer than this no maker sells: 0.5 degrees per g.
LEAST_UNDERSTEER = np.radians(0.5) / GRAVITY_M_S2
#: Entries of the vehicle file that are those of the simulated car.
_MEASURED = (
    "mass_kg", "yaw_inertia_kg_m2", "cg_to_front_axle_m", "cg_to_rear_axle_m", "track_m", "cg_height_m",
)  # fmt: skip
#: A ramp steer at this friction shows the axles' curves.
FIT_FRICTION = 0.85


@dataclass(frozen=True, slots=True)
class DrawnCar:
    """One car: its name as ``--vehicle`` takes it, its file, and the sensors that it has."""

    text: str
    vehicle: VehicleParameters
    sensors: tuple[tuple[str, float], ...]


def draw_car(rng: np.random.Generator, base: VehicleParameters, kinds: tuple[str, ...] = KINDS) -> DrawnCar:
    """Draw a car that understeers and can be driven through a ramp steer, with its vehicle file."""
    while True:
        kind = str(rng.choice(kinds))
        words = [f"{kind}~{rng.integers(2**31)}"]
        words += [f"{name}={rng.uniform(*limits):.3f}" for name, limits in _DRAWS["ranges"].items()]
        if rng.uniform() < OTHER_TYRES_SHARE:
            words.append(f"tyres={KINDS[1 - KINDS.index(kind)] if kind in KINDS else KINDS[0]}")
        text = ",".join(words)
        car = choose_vehicle(text)
        if understeer_gradient_rad_per_m_s2(car, FIT_FRICTION) < LEAST_UNDERSTEER:
            continue
        try:
            fitted = fit_vehicle(car, FIT_FRICTION, base)
        except (SimulationError, ValueError):
            continue  # rolls over or spins in the ramp
        entries = {"name": text, "wheel_radius_m": car.wheel_radius_m, "steering_ratio": car.steering_ratio}
        return DrawnCar(text, fitted.model_copy(update=entries), _sensors(rng))


def _sensors(rng: np.random.Generator) -> tuple[tuple[str, float], ...]:
    usual = SensorNoise()._asdict()
    values = {
        name: usual[name] * float(np.exp(rng.uniform(np.log(low), np.log(high))))
        for name, (low, high) in _DRAWS["sensor_factors"].items()
    }
    values |= {name: float(rng.uniform(*limits)) for name, limits in _DRAWS["sensors"].items()}
    values["steer_gain"] = STEER_GAIN
    return tuple((name, round(value, 6)) for name, value in sorted(values.items()))


def fit_vehicle(car: Vehicle, friction: float, vehicle: VehicleParameters) -> VehicleParameters:
    """Return the vehicle file with mass, geometry, axle tyres and roll gradient of a simulated car on a road.

    Raises
    ------
    SimulationError
        The car cannot be driven through the ramp.
    """
    motion = nominal.ramp(friction, car)
    if not np.isfinite(motion.column("ay_m_s2")).all():
        raise SimulationError(expected="a finite ramp steer", got="NaN or infinity", where="fit of a vehicle file")
    tyres, loads_n = {}, nominal.axle_loads_n(car)
    for axle, (alpha, force) in nominal.axle_curves(map(motion.column, nominal.MOTION), car).items():
        # Beyond the peak the car slides in ever other ways; the curve is fitted up to it.
        whole = slice(0, int(np.argmax(force)) + 1)
        tyres[axle] = nominal.fit_axle(alpha[whole] / friction, force[whole] / friction, loads_n[axle])
    linear_m_s2 = min(nominal.LINEAR_A_Y_M_S2, 0.5 * friction * GRAVITY_M_S2)
    roll = nominal.roll_gradient_rad_per_m_s2(motion, linear_m_s2)
    fitted = {"roll_gradient_rad_per_m_s2": roll, "tyres": Tyres(front=tyres["front"], rear=tyres["rear"])}
    return vehicle.model_copy(update={entry: getattr(car, entry) for entry in _MEASURED} | fitted)
