"""Simulate a plan: driver and vehicle in one compiled loop."""

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.signals import FloatArray
from truthsim.driver import (
    MEMORY_SIZE,
    PROGRESS,
    Driver,
    move_steering,
    pedal_torques_n_m,
    preview_steer_rad,
    standing,
    target_speed_m_s,
    track_progress_m,
)
from truthsim.manoeuvres import CONTROL_STEP_S, PATH_STEP_M, Plan
from truthsim.road import read_road
from truthsim.vehicle import (
    OBSERVED,
    OBSERVED_SIZE,
    ROAD_SIZE,
    STATE_SIZE,
    Vehicle,
    derivative,
    observe,
    see,
    standing_state,
)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Recorded motion of the vehicle.

    Attributes
    ----------
    times_s : [N], every ``period_s``.
    observed : [N, phases, columns of ``truthsim.vehicle.OBSERVED``]; phase j is ``phases_s[j]`` after the row's time.
    """

    times_s: FloatArray
    phases_s: FloatArray
    observed: FloatArray

    def column(self, name: str, phase: int = 0) -> FloatArray:
        """Return one observed quantity, [N]."""
        return self.observed[:, phase, OBSERVED.index(name)]


# positional: called only below, with the columns of one record
@njit(cache=True)
def _loop(
    start_speed_m_s: float,
    steer_table: FloatArray,
    path: FloatArray,
    stops: FloatArray,
    torque_table: FloatArray,
    road_table: FloatArray,
    friction: float,
    vehicle: Vehicle,
    driver: Driver,
    state: FloatArray,
    rows: int,
    period: int,
    phases: FloatArray,
    substeps: int,
    observed: FloatArray,
) -> None:
    """Drive, and write the observed quantities to ``observed`` [rows, phases, columns]."""
    follows = path.shape[0] > 0
    memory = np.zeros(MEMORY_SIZE)
    scratch, stage, view = np.zeros(STATE_SIZE), np.zeros(STATE_SIZE), np.zeros(OBSERVED_SIZE)
    k1, k2, k3, k4 = np.zeros(STATE_SIZE), np.zeros(STATE_SIZE), np.zeros(STATE_SIZE), np.zeros(STATE_SIZE)
    road = np.zeros(ROAD_SIZE)
    dt = CONTROL_STEP_S / substeps
    distance = 0.0
    steer, next_steer = 0.0, 0.0
    if not follows:
        next_steer = steer_table[0]
    for k in range((rows - 1) * period + int(phases[-1]) + 1):
        steer = next_steer
        see(state, view)
        speed = view[3]
        brake_hold = False
        if follows:
            memory[PROGRESS] = track_progress_m(path, PATH_STEP_M, memory[PROGRESS], view[0], view[1], 5.0)
            target, target_rate = target_speed_m_s(path, PATH_STEP_M, stops, memory)
            brake_hold = standing(stops, memory, speed, CONTROL_STEP_S)
            course = view[2] + (np.arctan2(view[4], speed) if speed > 3.0 else 0.0)
            demand = preview_steer_rad(driver, path, PATH_STEP_M, memory[PROGRESS], view[0], view[1], course, speed)
            next_steer = steer if brake_hold else move_steering(driver, memory, demand, CONTROL_STEP_S)
        else:
            target, target_rate = start_speed_m_s, 0.0
            next_steer = steer_table[min(k + 1, steer_table.shape[0] - 1)]
        drive, brake = pedal_torques_n_m(driver, memory, target, target_rate, speed, CONTROL_STEP_S)
        if brake_hold:
            drive, brake = 0.0, driver.hold_brake_n_m

        if k < torque_table.shape[0] and torque_table[k, 0] == torque_table[k, 0]:
            drive, brake = torque_table[k, 0], torque_table[k, 1]
        at_m = memory[PROGRESS] if follows else distance
        distance += speed * CONTROL_STEP_S
        read_road(
            road_table,
            PATH_STEP_M,
            at_m,
            vehicle.cg_to_front_axle_m,
            vehicle.cg_to_rear_axle_m,
            friction,
            road,
        )

        row = k // period
        for j in range(phases.shape[0]):
            if k - row * period == int(phases[j]) and row < rows:
                observe(state, steer, drive, brake, road, vehicle, scratch, observed[row, j])

        for i in range(substeps):
            a = steer + (next_steer - steer) * i / substeps
            c = steer + (next_steer - steer) * (i + 1) / substeps
            b = 0.5 * (a + c)
            derivative(state, a, drive, brake, road, vehicle, k1, view)
            for n in range(STATE_SIZE):
                stage[n] = state[n] + 0.5 * dt * k1[n]
            derivative(stage, b, drive, brake, road, vehicle, k2, view)
            for n in range(STATE_SIZE):
                stage[n] = state[n] + 0.5 * dt * k2[n]
            derivative(stage, b, drive, brake, road, vehicle, k3, view)
            for n in range(STATE_SIZE):
                stage[n] = state[n] + dt * k3[n]
            derivative(stage, c, drive, brake, road, vehicle, k4, view)
            for n in range(STATE_SIZE):
                state[n] += dt / 6.0 * (k1[n] + 2.0 * k2[n] + 2.0 * k3[n] + k4[n])


def simulate_motion(
    plan: Plan,
    friction: float,
    *,
    vehicle: Vehicle | None = None,
    driver: Driver | None = None,
    period_s: float = 0.01,
    phases_s: tuple[float, ...] = (0.0,),
    substeps: int = 1,
) -> Motion:
    """Simulate a plan (RK4 at 1 ms over ``substeps``) and record the observable quantities.

    Parameters
    ----------
    friction : of the road under all wheels, unless the plan contains a road.
    period_s, phases_s : times to record, in whole milliseconds; phases ascend and lie in [0, period).
    """
    vehicle = Vehicle() if vehicle is None else vehicle
    driver = Driver() if driver is None else driver
    period = round(period_s / CONTROL_STEP_S)
    phases = np.round(np.array(phases_s) / CONTROL_STEP_S)
    rows = int(np.floor(plan.duration_s / period_s + 1e-9)) + 1
    observed = np.full((rows, phases.shape[0], OBSERVED_SIZE), np.nan)
    _loop(
        plan.start_speed_m_s,
        plan.steer_rad,
        plan.path,
        plan.stops,
        plan.torque_n_m,
        plan.road,
        friction,
        vehicle,
        driver,
        standing_state(vehicle, plan.start_speed_m_s),
        rows,
        period,
        phases,
        substeps,
        observed,
    )
    return Motion(np.arange(rows, dtype=np.float64) * period_s, phases * CONTROL_STEP_S, observed)
