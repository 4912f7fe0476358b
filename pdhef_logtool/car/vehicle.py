"""Vehicle parameters: the records behind vehicle.toml, validated where they enter."""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.records.signals import Signals

GRAVITY_M_S2 = 9.80665

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

#: Shape factor of a tyre that is known by its cornering stiffness alone (typical lateral C, Pacejka 2012).
STIFFNESS_TYRE_SHAPE = 1.35


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class AxleTyre(_Record):
    """Axle magic formula at friction 1 (METHOD Eq 3), or a cornering stiffness alone.

    ``D_n`` is the axle's peak force in N at friction 1. Eq 3 scales the whole curve with friction, its stiffness too;
    real tyres keep theirs. With ``reference_friction``, the friction that the curve was measured at, B becomes
    B · reference / friction: the peak follows friction, the stiffness stays (similarity, Pacejka 2012, section 4.2).
    A tyre that is given by ``cornering_stiffness_n_per_rad`` keeps that stiffness at any friction and saturates at
    friction · F_z.
    """

    B: Positive | None = None
    C: Positive | None = None
    D_n: Positive | None = None
    E: Annotated[float, Field(le=1.0, allow_inf_nan=False)] | None = None
    cornering_stiffness_n_per_rad: Positive | None = None
    reference_friction: Positive | None = None

    @property
    def keeps_stiffness(self) -> bool:
        """Whether the slope at zero slip is the same at any friction."""
        return self.cornering_stiffness_n_per_rad is not None or self.reference_friction is not None

    @model_validator(mode="after")
    def _one_form(self) -> AxleTyre:
        magic = [v is not None for v in (self.B, self.C, self.D_n, self.E)]
        stiffness = self.cornering_stiffness_n_per_rad is not None
        if not (all(magic) and not stiffness) and not (stiffness and not any(magic)):
            raise ValueError("give either all of B, C, D_n, E or cornering_stiffness_n_per_rad alone")
        if stiffness and self.reference_friction is not None:
            raise ValueError("reference_friction belongs to B, C, D_n, E")
        return self


class Tyres(_Record):
    """The two axles' tyres."""

    front: AxleTyre
    rear: AxleTyre


class Sensors(_Record):
    """1-sigma white noise of the sensors, which is R of the sensor-level filters, and their constant biases.

    A bias is what the sensor reads too much; it is taken off before any estimator sees the signal. ``*_bias_std`` is
    the 1-sigma of what is left of it from drive to drive, for the filters that estimate it. The defaults are METHOD
    §9's for a production car's sensors.
    """

    ax_std_m_s2: Positive = 0.12
    ay_std_m_s2: Positive = 0.12
    yaw_rate_std_rad_s: Positive = 0.004
    speed_std_m_s: Positive = 0.08
    steer_std_rad: Positive = 0.0008
    ax_bias_m_s2: Finite = 0.0
    ay_bias_m_s2: Finite = 0.0
    yaw_rate_bias_rad_s: Finite = 0.0
    ay_bias_std_m_s2: Positive = 0.08
    yaw_rate_bias_std_rad_s: Positive = 0.0015
    steer_bias_std_rad: Positive = 0.0008


class FilterTuning(_Record):
    """Process and measurement 1-sigma that belong to this vehicle file, for one estimator.

    ``q_std`` holds one entry a state (per square root of second), ``r_std`` one a measurement.
    """

    q_std: tuple[NonNegative, ...] = ()
    r_std: dict[str, Positive] = Field(default_factory=dict)


class Network(_Record):
    """How far a residual network may be trusted on this vehicle, and on which evidence (``pdhef trust`` writes it).

    ``model_sha256`` is the network that the evidence is about: the cap holds for no other. None: for any.
    """

    trust_cap: Annotated[float, Field(ge=0, le=1)] = 0.0
    evidence: str = "none"
    model_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None

    @property
    def has_evidence(self) -> bool:
        """Whether the file says why; without, its cap counts for nothing."""
        return self.evidence.strip().lower() not in ("", "none")


class VehicleParameters(_Record):
    """Everything that the nominal single-track model needs to know of a vehicle (DESIGN §8). SI units, ISO 8855."""

    name: str = "unnamed"
    mass_kg: Positive
    yaw_inertia_kg_m2: Positive
    cg_to_front_axle_m: Positive
    cg_to_rear_axle_m: Positive
    track_m: Positive = 1.55
    cg_height_m: NonNegative = 0.55
    wheel_radius_m: Positive = 0.30
    steering_ratio: Positive = 16.0
    steer_offset_rad: Finite = 0.0
    roll_gradient_rad_per_m_s2: Finite = 0.0
    friction: Positive | None = None
    imu_position_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    truth_position_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    low_speed_blend_m_s: Positive = 3.0
    #: Way over which a lateral axle force builds up; 0.3-0.7 m for car tyres (METHOD §13; Pacejka 2012, chapter 7).
    relaxation_length_m: NonNegative = 0.5
    #: Share of lateral force per load that a tyre loses for each relative excess of load: −p_Dy2/p_Dy1, 0.145/0.990 for
    #: the 205/60 R15 of Pacejka 2012, appendix 3.
    load_sensitivity: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15
    sensors: Sensors = Sensors()
    tyres: Tyres
    filter: dict[str, FilterTuning] = Field(default_factory=dict)
    network: Network = Network()
    identification: dict[str, str | float | int | list[str]] = Field(default_factory=dict)

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles."""
        return self.cg_to_front_axle_m + self.cg_to_rear_axle_m

    @property
    def assumed_friction(self) -> float:
        """Friction of the file, or 1 where the file says nothing (DESIGN §8)."""
        return 1.0 if self.friction is None else self.friction

    def axle_load_n(self, front: bool) -> float:
        """Static vertical load of an axle in N."""
        arm = self.cg_to_rear_axle_m if front else self.cg_to_front_axle_m
        return self.mass_kg * GRAVITY_M_S2 * arm / self.wheelbase_m

    def magic_formula(self, front: bool, friction: float) -> tuple[float, float, float, float]:
        """Return B, C, peak force in N (friction applied) and E of an axle at a friction."""
        tyre = self.tyres.front if front else self.tyres.rear
        if tyre.cornering_stiffness_n_per_rad is None:
            assert tyre.B is not None and tyre.C is not None and tyre.D_n is not None and tyre.E is not None
            b = tyre.B if tyre.reference_friction is None else tyre.B * tyre.reference_friction / friction
            return b, tyre.C, friction * tyre.D_n, tyre.E
        peak = friction * self.axle_load_n(front)
        shape = STIFFNESS_TYRE_SHAPE
        return tyre.cornering_stiffness_n_per_rad / (shape * peak), shape, peak, 0.0

    def cornering_stiffness_n_per_rad(self, front: bool, friction: float) -> float:
        """Slope of the axle's lateral force at zero slip."""
        b, c, d, _ = self.magic_formula(front, friction)
        return b * c * d

    def understeer_gradient_rad_per_m_s2(self, friction: float = 1.0) -> float:
        """Linear understeer gradient dδ/da_y = m (l_r C_r − l_f C_f) / (L C_f C_r)."""
        cf = self.cornering_stiffness_n_per_rad(True, friction)
        cr = self.cornering_stiffness_n_per_rad(False, friction)
        lf, lr = self.cg_to_front_axle_m, self.cg_to_rear_axle_m
        return self.mass_kg * (lr * cr - lf * cf) / (self.wheelbase_m * cf * cr)


def vehicle_sha256(vehicle: VehicleParameters) -> str:
    """Return the hash of everything that a vehicle file says, whatever its layout and comments."""
    return hashlib.sha256(vehicle.model_dump_json().encode()).hexdigest()


def correct_signals(signals: Signals, vehicle: VehicleParameters) -> Signals:
    """Take the vehicle's steering offset and sensor biases off the signals; all estimators get the result."""
    sensors = vehicle.sensors
    return replace(
        signals,
        steer_rad=signals.steer_rad - vehicle.steer_offset_rad,
        ax_m_s2=signals.ax_m_s2 - sensors.ax_bias_m_s2,
        ay_m_s2=signals.ay_m_s2 - sensors.ay_bias_m_s2,
        yaw_rate_rad_s=signals.yaw_rate_rad_s - sensors.yaw_rate_bias_rad_s,
    )


#: Table 3 of the paper, with METHOD §2's nominal axle tyres. Used when no vehicle file is given.
DEFAULT_VEHICLE_NAME = "sedan"


def default_vehicle() -> VehicleParameters:
    """Return the paper's sedan (Table 3) with METHOD §2's tyres at friction 0.85."""
    return VehicleParameters(
        name=DEFAULT_VEHICLE_NAME,
        mass_kg=1440.0,
        yaw_inertia_kg_m2=1523.0,
        cg_to_front_axle_m=1.16,
        cg_to_rear_axle_m=1.71,
        track_m=1.57,
        cg_height_m=0.64,
        wheel_radius_m=0.30,
        steering_ratio=16.0,
        roll_gradient_rad_per_m_s2=0.0105,
        friction=0.85,
        tyres=Tyres(
            front=AxleTyre(B=12.3, C=1.41, D_n=7600.0, E=0.30),
            rear=AxleTyre(B=15.4, C=1.17, D_n=6110.0, E=0.20),
        ),
    )


def load_vehicle(path: Path) -> VehicleParameters:
    """Read vehicle.toml.

    Raises
    ------
    VehicleError
        The file is missing, is no TOML, or holds wrong, unknown or missing entries; all of them are named at once.
    """
    try:
        with path.open("rb") as f:
            raw: dict[str, Any] = tomllib.load(f)
    except FileNotFoundError:
        raise VehicleError(expected="a vehicle TOML file", got="no such file", where=str(path)) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise VehicleError(expected="a vehicle TOML file", got=str(error), where=str(path)) from None
    return vehicle_from_dict(raw, where=str(path))


def vehicle_from_dict(raw: dict[str, Any], *, where: str) -> VehicleParameters:
    """Build parameters from parsed TOML; problems are reported together.

    Raises
    ------
    VehicleError
        Entries are wrong, unknown or missing.
    """
    try:
        vehicle = VehicleParameters.model_validate(raw)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(p) for p in e['loc']) or 'file'}: {e['msg']}" for e in error.errors(include_url=False)
        )
        raise VehicleError(
            expected="the entries of vehicle.toml",
            got=problems,
            where=where,
            remedy="see docs/formats.md for every entry and its unit",
        ) from None
    if not math.isfinite(vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)):
        raise VehicleError(expected="tyres with a finite stiffness", got="an infinite one", where=where)
    return vehicle


def vehicle_to_toml(vehicle: VehicleParameters, comments: Mapping[str, str] | None = None) -> str:
    """Return vehicle.toml of the parameters; reading it back gives the same parameters.

    Parameters
    ----------
    comments : by dotted entry (``tyres.front.B``); ``""`` stands at the head of the file.
    """
    notes = dict(comments or {})
    lines = [f"# {line}" for line in notes.get("", "").splitlines()]
    document = vehicle.model_dump(exclude_none=True)
    _toml_table(document, (), notes, lines)
    return "\n".join(lines).strip("\n") + "\n"


def _toml_table(table: Mapping[str, Any], path: tuple[str, ...], notes: Mapping[str, str], lines: list[str]) -> None:
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping) or k == "r_std"}
    if path and plain:
        lines += ["", f"[{'.'.join(_toml_key(p) for p in path)}]"]
    for key, value in plain.items():
        note = notes.get(".".join((*path, key)))
        lines.append(f"{_toml_key(key)} = {_toml_value(value)}" + (f"  # {note}" if note else ""))
    for key, value in table.items():
        if key not in plain:
            _toml_table(value, (*path, key), notes, lines)


def _toml_key(key: str) -> str:
    return key if key and all(c.isascii() and (c.isalnum() or c in "-_") for c in key) else json.dumps(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_toml_key(k)} = {_toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)
