"""Vehicle parameters: validated records of vehicle.toml."""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pdhef_logtool.records.geometry import GRAVITY_M_S2 as GRAVITY_M_S2
from pdhef_logtool.records.readings import POSSIBLE_FRICTION
from pdhef_logtool.records.signals import Signals

#: A car is at a standstill below this share of its low-speed blend.
STANDSTILL_SHARE = 0.1

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Friction = Annotated[float, Field(ge=POSSIBLE_FRICTION[0], le=POSSIBLE_FRICTION[1])]
#: From 0.1 m for a 1:10 car to 7 m for a truck, for any position of the CG.
AxleDistance = Annotated[float, Field(ge=0.01, le=15)]
#: Positions inside a truck, m; lengths of a car in mm are outside.
Coordinate = Annotated[float, Field(ge=-25, le=25)]
#: A list in TOML.
Position = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
#: Accelerometer noise; rigidly mounted sensors of a 1:10 car have 5 m/s².
AccelerationStd = Annotated[float, Field(gt=0, le=30)]
#: A larger value is a mounting error, which belongs in the mapping.
AccelerationBias = Annotated[float, Field(ge=-5, le=5)]
AngleStd = Annotated[float, Field(gt=0, le=0.5)]
#: Interval between samples of a sensor, and longest use of a sample.
SensorTime = Annotated[float, Field(gt=0, le=30)]

#: Remedy for a wrong entry.
REMEDY = "see docs/formats.md for every entry and its unit"
#: Cars with a shorter wheelbase are models.
SHORTEST_ROAD_CAR_M = 1.2
#: Shape factor of a tyre with ``cornering_stiffness_n_per_rad`` (typical lateral C, Pacejka 2012).
STIFFNESS_TYRE_SHAPE = 1.35


class Record(BaseModel):
    """Frozen record that rejects unknown entries, wrong types and values that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True, allow_inf_nan=False)


class AxleTyre(Record):
    """Axle magic formula at friction 1 (Eq 2, docs/method.md#model), or a cornering stiffness alone.

    ``D_n`` is the axle's peak force in N at friction 1. Eq 2 scales the whole curve with friction, including the
    stiffness, which is constant for real tyres. With ``reference_friction``, the friction of the measured curve, B
    becomes B · reference / friction: the peak follows friction, the stiffness is constant (similarity, Pacejka 2012,
    section 4.2).
    A tyre with ``cornering_stiffness_n_per_rad`` has this stiffness at any friction and saturates at friction · F_z.
    """

    B: Positive | None = None
    C: Annotated[float, Field(gt=0, le=3)] | None = None  # 1 to 2 by Pacejka 2012; the force turns round beyond 2
    D_n: Positive | None = None
    E: Annotated[float, Field(ge=-100, le=1)] | None = None
    cornering_stiffness_n_per_rad: Positive | None = None
    reference_friction: Friction | None = None

    @property
    def keeps_stiffness(self) -> bool:
        """Whether the slope at zero slip is the same at any friction."""
        return self.cornering_stiffness_n_per_rad is not None or self.reference_friction is not None

    @model_validator(mode="after")
    def _one_form(self) -> "AxleTyre":
        magic = [v is not None for v in (self.B, self.C, self.D_n, self.E)]
        stiffness = self.cornering_stiffness_n_per_rad is not None
        if not (all(magic) and not stiffness) and not (stiffness and not any(magic)):
            raise ValueError("give either all of B, C, D_n, E or cornering_stiffness_n_per_rad alone")
        if stiffness and self.reference_friction is not None:
            raise ValueError("reference_friction belongs to B, C, D_n, E")
        return self


class Tyres(Record):
    """The two axles' tyres."""

    front: AxleTyre
    rear: AxleTyre


class Sensors(Record):
    """Sensor profile, ``[sensors]`` of vehicle.toml.

    Noise is white and 1 sigma; it is R of the filters with sensor-level noise. A bias is reading minus true value. Bias
    and gain are corrected before any estimator receives the signal. The defaults, profile ``production``, are for a
    production car (docs/method.md#sensors).

    Attributes
    ----------
    ax_std_m_s2 : noise of the longitudinal acceleration.
    ay_std_m_s2 : noise of the lateral acceleration.
    yaw_rate_std_rad_s : noise of the yaw rate.
    speed_std_m_s : noise of the speed.
    steer_std_rad : noise of the road-wheel angle.
    ax_bias_m_s2 : bias of the longitudinal acceleration.
    ay_bias_m_s2 : bias of the lateral acceleration.
    yaw_rate_bias_rad_s : bias of the yaw rate.
    yaw_rate_gain : reading of the yaw rate over the true value.
    yaw_rate_delay_s : delay of the gyro's stamps; unless it is 0 it replaces ``latency_s`` of the mapping.
    ay_bias_std_m_s2 : standard deviation between drives of the remaining bias of a_y.
    yaw_rate_bias_std_rad_s : standard deviation between drives of the remaining bias of the yaw rate.
    steer_bias_std_rad : standard deviation between drives of the remaining bias of the road-wheel angle.
    imu_rate_hz : rate above which samples of a_y and yaw rate are correlated by road and body motion, for the detection
        of noise bursts.
    imu_span_s : longest time of three intervals between samples in which noise bursts and spikes are detected.
    imu_hold_s : longest use of a sample in the divergence monitor; after it, the channel is missing.
    speed_hold_s : longest use of a speed sample.
    steer_hold_s : longest use of a steering sample in a filter.
    stuck_samples : smallest number of equal samples of a stuck channel; repeated samples of a recorder need more.
    speed_zero_m_s : speeds below are a standstill, or wheels without pulses.
    speed_least_m_s : lowest speed that wheels with few pulses report; a step between it and 0 is not wheel slip.
    still_yaw_rate_rad_s : largest yaw rate at a standstill, noise and bias included.
    """

    ax_std_m_s2: AccelerationStd = 0.12
    ay_std_m_s2: AccelerationStd = 0.12
    yaw_rate_std_rad_s: Annotated[float, Field(gt=0, le=3)] = 0.004
    speed_std_m_s: Annotated[float, Field(gt=0, le=20)] = 0.08
    steer_std_rad: AngleStd = 0.0008
    ax_bias_m_s2: AccelerationBias = 0.0
    ay_bias_m_s2: AccelerationBias = 0.0
    yaw_rate_bias_rad_s: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    yaw_rate_gain: Annotated[float, Field(ge=0.5, le=2.0)] = 1.0
    yaw_rate_delay_s: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    ay_bias_std_m_s2: AccelerationStd = 0.08
    yaw_rate_bias_std_rad_s: AngleStd = 0.0015
    steer_bias_std_rad: AngleStd = 0.0008
    imu_rate_hz: Annotated[float, Field(gt=0, le=10_000)] = 100.0
    imu_span_s: SensorTime = 0.16
    imu_hold_s: SensorTime = 0.1
    speed_hold_s: SensorTime = 0.5
    steer_hold_s: SensorTime = 0.2
    stuck_samples: Annotated[int, Field(ge=2, le=10_000)] = 5
    speed_zero_m_s: Annotated[float, Field(ge=0, le=5)] = 0.05
    speed_least_m_s: Annotated[float, Field(ge=0, le=20)] = 1.0
    still_yaw_rate_rad_s: Annotated[float, Field(ge=0, le=0.5)] = 0.05

    @property
    def measurement_std(self) -> tuple[float, float, float]:
        """Standard deviations of the measurements a_y, yaw rate, speed."""
        return self.ay_std_m_s2, self.yaw_rate_std_rad_s, self.speed_std_m_s


#: Sensor profiles by name.
SENSOR_PROFILES = {"production": Sensors()}


class PhysicsParts(Record):
    """Parts of the model of ``physics`` beside the static single track; each needs evidence.

    See docs/method.md#physics.
    """

    lag: bool = False
    load_transfer: bool = False
    braking: bool = False
    roll: bool = False
    biases: bool = False
    bank: bool = False
    force_scale: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the enabled parts."""
        return tuple(name for name, has in self if has)


class VehicleParameters(Record):
    """Parameters of a vehicle for the single-track model. SI units, ISO 8855.

    See docs/formats.md#vehicletoml.

    Ranges include 1:10 cars and trucks of 40 t. Relations reject entries that contradict each other.
    """

    name: str = "unnamed"
    mass_kg: Annotated[float, Field(ge=0.5, le=60_000)]
    yaw_inertia_kg_m2: Positive
    cg_to_front_axle_m: AxleDistance
    cg_to_rear_axle_m: AxleDistance
    track_m: Annotated[float, Field(gt=0, le=4)] = 1.55
    cg_height_m: Annotated[float, Field(ge=0, le=4)] = 0.55
    wheel_radius_m: Annotated[float, Field(ge=0.01, le=1.5)] = 0.30
    steering_ratio: Annotated[float, Field(ge=0.2, le=60)] = (
        16.0  # 1: the log contains road-wheel angles; trucks up to 30
    )
    steer_offset_rad: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    #: Cars have 0.005 to 0.015 (3 to 8 degrees per g), trucks up to 0.03; a value in degrees is out of range.
    roll_gradient_rad_per_m_s2: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0
    friction: Friction | None = None
    imu_position_m: Position = (0.0, 0.0, 0.0)
    truth_position_m: Position = (0.0, 0.0, 0.0)
    gnss_antenna_position_m: Position | None = None
    low_speed_blend_m_s: Annotated[float, Field(ge=0.01, le=30)] = 3.0
    #: Distance over which a lateral axle force builds up; 0.3-0.7 m for cars (docs/method.md#physics; Pacejka 2012,
    #: chapter 7).
    relaxation_length_m: Annotated[float, Field(ge=0, le=10)] = 0.5
    #: Relative loss of lateral force per load for each relative excess of load: −p_Dy2/p_Dy1, 0.145/0.990 for
    #: the 205/60 R15 of Pacejka 2012, appendix 3.
    load_sensitivity: Annotated[float, Field(ge=0, lt=1)] = 0.15
    #: Undamped natural frequency and damping ratio of body roll; 1.5-2 Hz and 0.3-0.4 for cars
    #: (docs/method.md#physics).
    roll_frequency_rad_s: Annotated[float, Field(ge=2, le=60)] = 11.0
    roll_damping: Annotated[float, Field(ge=0.02, le=3)] = 0.35
    #: 0.7 of the height of the CG for the default sedan (docs/method.md#physics).
    cg_over_roll_axis_m: Annotated[float, Field(ge=0, le=3)] = 0.4
    physics: PhysicsParts = PhysicsParts()
    sensors: Sensors = Sensors()
    tyres: Tyres

    @model_validator(mode="after")
    def _entries_agree(self) -> "VehicleParameters":
        axles = ("cg_to_front_axle_m", "cg_to_rear_axle_m")
        wrong = [
            f"{', '.join(self._told(e) for e in (*entries.split(), *axles))} contradict one another: {what} is "
            f"{values[0]:.3g}, plausible is {low:g} to {high:g}"
            for what, entries, values, low, high in self._relations()
            if min(values) > high or max(values) < low
        ]
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def _told(self, entry: str) -> str:
        given = entry in self.model_fields_set or "." in entry
        return entry if given else f"{entry} (left out: {getattr(self, entry)})"

    def _relations(self) -> Iterator[tuple[str, str, tuple[float, ...], float, float]]:
        """Yield name, entries beside the axle distances, values (one must be in range), and range of each relation."""
        length = self.wheelbase_m
        # Near 1 for cars; 0.5 for the paper's sedan, 3.6 for the 1:10 car of the F1TENTH model (a guess of its authors,
        # which a fit may double).
        inertia = self.yaw_inertia_kg_m2 / (self.mass_kg * self.cg_to_front_axle_m * self.cg_to_rear_axle_m)
        yield "I_z / (m l_f l_r)", "mass_kg yaw_inertia_kg_m2", (inertia,), 0.15, 8.0
        for axle, front in (("front", True), ("rear", False)):
            load, over = self.axle_load_n(front), f"over static load of the {axle} axle"
            if getattr(self.tyres, axle).D_n is not None:
                # From ice at friction 1 of the file to 2 for a racing tyre; 4 for an inaccurate curve.
                peak = self.magic_formula(front, 1.0)[2] / load
                yield f"peak force {over}", f"tyres.{axle}.D_n mass_kg", (peak,), 0.1, 5.0
            # Per rad: trucks and 1:10 cars 5, cars 8 to 25, racing cars 40. Eq 2 scales it with friction; the curve
            # must be plausible at friction 1 or at the file's.
            slopes = tuple(self.cornering_stiffness_n_per_rad(front, mu) / load for mu in (1.0, self.assumed_friction))
            least = 0.5 if length < SHORTEST_ROAD_CAR_M else 2.0  # model cars slide on smooth floors
            yield f"cornering stiffness {over} in 1/rad", f"tyres.{axle} mass_kg", slopes, least, 100.0
        # From a kart, with a track as long as the wheelbase, to a coach with a third of it.
        yield "track over wheelbase", "track_m", (self.track_m / length,), 0.15, 1.5
        # A laden truck: 2.2 m over 3.5 m.
        yield "height of the CG over wheelbase", "cg_height_m", (self.cg_height_m / length,), 0.0, 1.2
        # 0.2 for cars; 1.5 for a 1:10 car with the default.
        relaxation = self.relaxation_length_m / length
        yield "relaxation length over wheelbase", "relaxation_length_m", (relaxation,), 0.0, 3.0
        # Speeds scale with √(g L): 0.6 for the default sedan, 0.17 for the 1:10 car.
        blend = self.low_speed_blend_m_s / math.sqrt(GRAVITY_M_S2 * length)
        yield "low-speed limit over sqrt(g wheelbase)", "low_speed_blend_m_s", (blend,), 0.0, 3.0

    @property
    def wheelbase_m(self) -> float:
        """Distance between the axles."""
        return self.cg_to_front_axle_m + self.cg_to_rear_axle_m

    @property
    def standstill_m_s(self) -> float:
        """Speed below which the car is at a standstill and the direction of its velocity is noise."""
        return STANDSTILL_SHARE * self.low_speed_blend_m_s

    @property
    def assumed_friction(self) -> float:
        """Friction of the file, or 1 if the file has no entry (docs/formats.md#vehicletoml)."""
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

    def most_ay_m_s2(self, friction: float) -> float:
        """Return the lateral acceleration at which both axles have their peak force."""
        return sum(self.magic_formula(front, friction)[2] for front in (True, False)) / self.mass_kg

    def cornering_stiffness_n_per_rad(self, front: bool, friction: float) -> float:
        """Slope of the axle's lateral force at zero slip."""
        b, c, d, _ = self.magic_formula(front, friction)
        return b * c * d

    def with_stiffness(self, front: float, rear: float) -> "VehicleParameters":
        """Return the vehicle with the cornering stiffness of its axles multiplied; peak forces stay."""

        def tyre(of: AxleTyre, factor: float) -> AxleTyre:
            name = "B" if of.B is not None else "cornering_stiffness_n_per_rad"
            return of.model_copy(update={name: factor * getattr(of, name)})

        tyres = Tyres(front=tyre(self.tyres.front, front), rear=tyre(self.tyres.rear, rear))
        return self.model_copy(update={"tyres": tyres})

    def understeer_gradient_rad_per_m_s2(self, friction: float = 1.0) -> float:
        """Linear understeer gradient dδ/da_y = m (l_r C_r − l_f C_f) / (L C_f C_r)."""
        cf = self.cornering_stiffness_n_per_rad(True, friction)
        cr = self.cornering_stiffness_n_per_rad(False, friction)
        lf, lr = self.cg_to_front_axle_m, self.cg_to_rear_axle_m
        return self.mass_kg * (lr * cr - lf * cf) / (self.wheelbase_m * cf * cr)


def correct_signals(signals: Signals, vehicle: VehicleParameters) -> Signals:
    """Correct the signals for steering offset, sensor biases and gyro gain; all estimators receive the result."""
    sensors = vehicle.sensors
    return replace(
        signals,
        steer_rad=signals.steer_rad - vehicle.steer_offset_rad,
        ax_m_s2=signals.ax_m_s2 - sensors.ax_bias_m_s2,
        ay_m_s2=signals.ay_m_s2 - sensors.ay_bias_m_s2,
        yaw_rate_rad_s=(signals.yaw_rate_rad_s - sensors.yaw_rate_bias_rad_s) / sensors.yaw_rate_gain,
    )


def corrected_anew(signals: Signals, was: VehicleParameters, vehicle: VehicleParameters) -> Signals:
    """Return signals that were corrected for the vehicle ``was`` (ratio, offset, biases), corrected for ``vehicle``."""
    before, after = was.sensors, vehicle.sensors
    if (was.steering_ratio, was.steer_offset_rad, before) == (vehicle.steering_ratio, vehicle.steer_offset_rad, after):
        return signals
    raw = replace(
        signals,
        steer_rad=(signals.steer_rad + was.steer_offset_rad) * (was.steering_ratio / vehicle.steering_ratio),
        ax_m_s2=signals.ax_m_s2 + before.ax_bias_m_s2,
        ay_m_s2=signals.ay_m_s2 + before.ay_bias_m_s2,
        yaw_rate_rad_s=signals.yaw_rate_rad_s * before.yaw_rate_gain + before.yaw_rate_bias_rad_s,
    )
    return correct_signals(raw, vehicle)


DEFAULT_VEHICLE_NAME = "sedan"


@cache
def default_vehicle() -> VehicleParameters:
    """Return the paper's sedan (Table 3) with nominal tyres at friction 0.85, the default without a vehicle file."""
    text = Path(__file__).with_name(f"{DEFAULT_VEHICLE_NAME}.toml").read_text(encoding="utf-8")
    return VehicleParameters.model_validate(tomllib.loads(text))
