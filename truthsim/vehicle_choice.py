"""Name a vehicle in one word: a shipped one, a file, another of its kind, or a modified one.

``NAME[~SEED][,CHANGE=VALUE]...``: ``sedan``, ``my_car.toml``, ``suv~7`` (the SUV that ``truthsim.randomisation`` draws
with seed 7), ``sedan,mass=1.2,cg=0.1``. Changes: ``mass`` (factor, inertias with it), ``cg`` (metres towards the rear),
``height`` (of the CG, factor), ``stiffness`` (of all tyres' cornering, factor), ``tyres`` (tyres of another vehicle).
"""

import math

from pdhef_logtool.records.errors import UsageError
from truthsim.randomisation import randomise
from truthsim.vehicle import Vehicle
from truthsim.vehicle_files import load_vehicle

CHANGES = ("mass", "cg", "height", "stiffness", "tyres")


def choose_vehicle(text: str) -> Vehicle:
    """Return the vehicle that a text names.

    Raises
    ------
    UsageError
        The vehicle is unknown, or a change is wrong.
    """
    name, *changes = text.split(",")
    kind, wave, seed = name.partition("~")
    vehicle = load_vehicle(kind)
    if wave:
        if not seed.isdecimal():
            raise _wrong(text, "NAME~SEED with a whole number")
        vehicle = randomise(vehicle, int(seed))
    for change in changes:
        vehicle = _change(vehicle, text, *change.partition("=")[::2])
    return vehicle


def _wrong(text: str, expected: str) -> UsageError:
    return UsageError(
        expected=expected, got=repr(text), where="vehicle", remedy="for example sedan, suv~7 or sedan,mass=1.2,cg=0.1"
    )


def _change(vehicle: Vehicle, text: str, name: str, value: str) -> Vehicle:
    if name not in CHANGES:
        raise _wrong(text, f"a change of {', '.join(CHANGES)}")
    if name == "tyres":
        other = load_vehicle(value)
        return vehicle._replace(front_tyre=other.front_tyre, rear_tyre=other.rear_tyre)
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if name == "cg":
        if not -vehicle.cg_to_front_axle_m < number < vehicle.cg_to_rear_axle_m:
            raise _wrong(text, "cg between the axles")
        return vehicle._replace(
            cg_to_front_axle_m=vehicle.cg_to_front_axle_m + number,
            cg_to_rear_axle_m=vehicle.cg_to_rear_axle_m - number,
        )
    if not 0.5 <= number <= 2.0:
        raise _wrong(text, f"{name} from 0.5 to 2")
    if name == "height":
        return vehicle._replace(cg_height_m=number * vehicle.cg_height_m)
    if name == "stiffness":
        front, rear = vehicle.front_tyre, vehicle.rear_tyre
        return vehicle._replace(
            front_tyre=front._replace(stiffness_peak=number * front.stiffness_peak),
            rear_tyre=rear._replace(stiffness_peak=number * rear.stiffness_peak),
        )
    return vehicle._replace(
        mass_kg=number * vehicle.mass_kg,
        yaw_inertia_kg_m2=number * vehicle.yaw_inertia_kg_m2,
        roll_inertia_kg_m2=number * vehicle.roll_inertia_kg_m2,
        pitch_inertia_kg_m2=number * vehicle.pitch_inertia_kg_m2,
    )
