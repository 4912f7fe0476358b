"""The model of ``physics`` in plain Python, from the equations at the head of ``vehicle_model``, and drives of it.

It shares no code with the compiled model, nor its integration steps, sigma points or order of evaluation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import reference_car
from reference_car import FRICTION, FRONT_M, MASS_KG, REAR_M, WHEELBASE_M, YAW_INERTIA, Drive, make_signals
from scipy.integrate import solve_ivp

from pdhef_logtool.car.vehicle import PhysicsParts, VehicleParameters, default_vehicle

TRACK_M, CG_HEIGHT_M, G = 1.57, 0.64, 9.80665
BANK_TIME_S, FORCE_SCALE_TIME_S, KINEMATIC_TIME_S = 5.0, 2.0, 0.1
BLEND_LOW_M_S, BLEND_HIGH_M_S = 1.5, 3.0
RELAXATION_M, SENSITIVITY, SWING_M = 0.5, 0.15, 0.4
ROLL_GRADIENT, ROLL_FREQUENCY, ROLL_DAMPING = 0.0105, 11.0, 0.35
ALL_PARTS = tuple(PhysicsParts.model_fields)


def parts(*names: str) -> PhysicsParts:
    return PhysicsParts(**dict.fromkeys(names, True))


def vehicle(*names: str, **changes) -> VehicleParameters:
    """The default sedan, which the oracle is, with parts."""
    return default_vehicle().model_copy(update={"physics": parts(*names), **changes})


def names_of(has: PhysicsParts) -> list[str]:
    """State entries in their order."""
    names = ["vx", "vy", "r", "b_ax", "ff", "fr"]
    for part, entries in (
        (has.roll, ["phi", "phi_dot"]),
        (has.bank, ["bank"]),
        (has.force_scale, ["s"]),
        (True, ["b_delta"]),
        (has.biases, ["b_ay", "b_r"]),
    ):
        names += entries if part else []
    return names


@dataclass(frozen=True)
class Oracle:
    """The ODE of a car with parts; without lag its forces are algebraic."""

    has: PhysicsParts
    imu: tuple[float, float] = (0.0, 0.0)

    def as_vehicle(self, **changes) -> VehicleParameters:
        update = {"physics": self.has, "imu_position_m": (*self.imu, 0.0), **changes}
        return default_vehicle().model_copy(update=update)

    def _named(self, x: np.ndarray) -> dict[str, float]:
        found = dict.fromkeys(names_of(parts(*ALL_PARTS)), 0.0)
        return found | dict(zip(names_of(self.has), map(float, x), strict=True))

    def tyres(self, x: np.ndarray, steer: float, ax: float, mu: float) -> tuple[float, float]:
        """Return the steady forces over the mass; ``x`` contains the lateral acceleration."""
        s = self._named(x)
        v = max(s["vx"], BLEND_LOW_M_S)
        vy = s["vy"] + (SWING_M * s["phi_dot"] if self.has.roll else 0.0)
        alpha = steer - s["b_delta"] - math.atan((vy + FRONT_M * s["r"]) / v), -math.atan((vy - REAR_M * s["r"]) / v)
        ay = s["phi"] / ROLL_GRADIENT if self.has.roll else self.lateral(x, steer)
        found = []
        for slip, front in zip(alpha, (True, False), strict=True):
            force = reference_car.magic_tyre(slip, mu, front) / MASS_KG
            if self.has.braking and ax < 0.0:
                arm = -REAR_M if front else FRONT_M
                force *= (1.0 + ax * CG_HEIGHT_M / (G * arm)) * math.sqrt(1.0 - (ax / (mu * G)) ** 2)
            own = force * WHEELBASE_M / (REAR_M if front else FRONT_M)
            if self.has.load_transfer:
                force *= self.transfer(ay) / self.transfer(own)
            found.append(force * (1.0 + s["s"]))
        return found[0], found[1]

    def transfer(self, ay: float) -> float:
        """Two wheels, each with the share of the load that is left or gained (Eq 7)."""
        x = min(1.0, abs(2.0 * CG_HEIGHT_M * ay / (G * TRACK_M)))
        return 0.5 * ((1 + x) * (1 - SENSITIVITY * x) + (1 - x) * (1 + SENSITIVITY * x))

    def share(self, vx: float) -> float:
        return min(1.0, max(0.0, (vx - BLEND_LOW_M_S) / (BLEND_HIGH_M_S - BLEND_LOW_M_S)))

    def lateral(self, x: np.ndarray, steer: float) -> float:
        w = self.share(x[0])
        return w * (x[4] * math.cos(steer) + x[5]) + (1.0 - w) * x[0] * x[2]

    def settled(self, x: np.ndarray, steer: float, ax: float, mu: float) -> np.ndarray:
        """The state with the forces to which the tyres settle."""
        x = np.array(x, dtype=float)
        for _ in range(40 if self.has.load_transfer else 1):
            x[4:6] = self.tyres(x, steer, ax, mu)
        return x

    def derivative(self, x: np.ndarray, steer: float, ax: float, mu: float) -> np.ndarray:
        if not self.has.lag:
            x = self.settled(x, steer, ax, mu)
        s = self._named(x)
        w = self.share(s["vx"])
        front = s["ff"] * math.cos(steer)
        to_f, to_r = self.tyres(x, steer, ax, mu)
        rolling = s["vx"] * math.tan(steer) / WHEELBASE_M
        rate = max(s["vx"], BLEND_LOW_M_S) / RELAXATION_M if self.has.lag else 0.0
        d = dict.fromkeys(s, 0.0)
        d["r"] = w * MASS_KG * (FRONT_M * front - REAR_M * s["fr"]) / YAW_INERTIA
        d["r"] += (1.0 - w) * (rolling - s["r"]) / KINEMATIC_TIME_S
        d["vy"] = w * (front + s["fr"] - G * s["bank"] - s["vx"] * s["r"])
        d["vy"] += (1.0 - w) * (REAR_M * rolling - s["vy"]) / KINEMATIC_TIME_S
        d["vx"] = ax - s["b_ax"] + s["vy"] * s["r"] + d["r"] * self.imu[1] + s["r"] ** 2 * self.imu[0]
        d["ff"], d["fr"] = rate * (to_f - s["ff"]), rate * (to_r - s["fr"])
        d["phi"] = s["phi_dot"]
        wanted = ROLL_GRADIENT * self.lateral(x, steer)
        d["phi_dot"] = ROLL_FREQUENCY**2 * (wanted - s["phi"])
        d["phi_dot"] -= 2.0 * ROLL_DAMPING * ROLL_FREQUENCY * s["phi_dot"]
        d["bank"], d["s"] = -s["bank"] / BANK_TIME_S, -s["s"] / FORCE_SCALE_TIME_S
        return np.array([d[name] for name in names_of(self.has)])

    def after(self, x: np.ndarray, steer: float, ax: float, mu: float, duration_s: float) -> np.ndarray:
        """The state ``duration_s`` later with inputs that stay."""

        def f(_t: float, y: np.ndarray) -> np.ndarray:
            return self.derivative(y, steer, ax, mu)

        end = solve_ivp(f, (0.0, duration_s), x, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
        return end if self.has.lag else self.settled(end, steer, ax, mu)

    def sensed_ay(self, x: np.ndarray, steer: float) -> float:
        """Return the reading of an accelerometer that leans with the body, at its place."""
        s = self._named(x)
        w = self.share(s["vx"])
        front = s["ff"] * math.cos(steer)
        r_dot = w * MASS_KG * (FRONT_M * front - REAR_M * s["fr"]) / YAW_INERTIA
        ay = self.lateral(x, steer)
        lean = s["phi"] if self.has.roll else ROLL_GRADIENT * ay
        return ay + G * lean + r_dot * self.imu[0] - s["r"] ** 2 * self.imu[1] + s["b_ay"]

    def drive(self, steer: Callable[[float], float], duration_s: float, n: int = 4, **start: float) -> Drive:
        """Drive at 100 Hz in Runge-Kutta steps; steering moves on between the stamps, the driver holds the speed."""
        count, h = round(duration_s * 100) + 1, 0.01 / n
        x = np.array([({"vx": 25.0} | start).get(name, 0.0) for name in names_of(self.has)])
        states, ax, sensed, ay = np.empty((count, x.size)), np.empty(count), np.empty(count), np.empty(count)
        for k in range(count):
            t0 = 0.01 * k
            if not self.has.lag:
                x = self.settled(x, steer(t0), 0.0, FRICTION)
            states[k], ax[k], ay[k] = x, -x[1] * x[2], self.lateral(x, steer(t0))
            sensed[k] = self.sensed_ay(x, steer(t0))

            def f(y: np.ndarray, at: float, a: float = float(ax[k])) -> np.ndarray:
                return self.derivative(y, steer(at), a, FRICTION)

            for i in range(n):
                x = reference_car.runge_kutta_step(f, x, t0 + i * h, h)
        speed = np.where(np.arange(count) % 2 == 0, states[:, 0], np.nan)
        columns = {"ax_m_s2": ax, "ay_m_s2": sensed, "yaw_rate_rad_s": states[:, 2], "speed_m_s": speed}
        steers = np.array([steer(0.01 * k) for k in range(count)])
        signals = make_signals(np.full(count - 1, 0.01), steer_rad=steers, **columns)
        return Drive(signals, states[:, 0], states[:, 1], states[:, 2], ay)
