"""Self-calibration: recovered parameters of a known car, and rejected drives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import FRICTION, Drive, cut, drive, keep, with_noise

from pdhef_logtool.car.model import TaughtParameter
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators.calibration import calibration as rules
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, self_calibrate
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving, driving_of
from pdhef_logtool.estimators.calibration.joint import LIKE, REAR_STIFFNESS, like_drives, parameters_of, with_taught
from pdhef_logtool.records.signals import Signals

RIGHT = default_vehicle()


def wrong(front: float, rear: float, vehicle: VehicleParameters = RIGHT) -> VehicleParameters:
    """Return a vehicle with the axle stiffness multiplied by factors and unchanged peak forces."""

    def of(tyre: AxleTyre, factor: float) -> AxleTyre:
        assert tyre.B is not None
        return tyre.model_copy(update={"B": tyre.B * factor})

    tyres = Tyres(front=of(vehicle.tyres.front, front), rear=of(vehicle.tyres.rear, rear))
    return vehicle.model_copy(update={"tyres": tyres})


def sweep(amplitude: float) -> Callable[[float], float]:
    """Return steering that sweeps from 0.2 to 1.2 Hz in 20 s, again and again."""
    return lambda t: amplitude * math.sin(2.0 * math.pi * (0.2 * (t % 20.0) + 0.025 * (t % 20.0) ** 2))


@cache
def wide() -> Drive:
    return drive(sweep(0.02), 60.0)


def driving(signals: Signals, vehicle: VehicleParameters) -> Driving:
    return driving_of(signals, vehicle)


def found(signals: Signals, vehicle: VehicleParameters) -> SelfCalibration:
    return self_calibrate([driving(signals, vehicle)], vehicle)


def stiffness_errors(calibration: SelfCalibration) -> list[tuple[float, float]]:
    """Return, by axle, the error of the logarithm of the cornering stiffness, and its sd."""
    by = {p.name: p for p in calibration.parameters}
    pairs = []
    for axle, front in (("front", True), ("rear", False)):
        parameter = by[f"{axle} cornering stiffness"]
        true = RIGHT.cornering_stiffness_n_per_rad(front, FRICTION)
        pairs.append((math.log(parameter.value / true), parameter.sd))
    return pairs


@pytest.mark.slow
@pytest.mark.parametrize(("front", "rear"), [(1.0, 1.0), (2.0, 0.5), (0.5, 0.7)])
def test_a_sweep_finds_the_stiffness_within_its_own_posterior_whatever_the_file_says(front: float, rear: float) -> None:
    calibration = found(with_noise(wide().signals, 3), wrong(front, rear))
    assert not calibration.refused
    for error, sd in stiffness_errors(calibration):
        assert abs(error) < min(3.0 * sd, 0.13)
        assert sd < 0.15


def test_biases_offset_and_gain_of_the_sensors_are_found() -> None:
    signals = with_noise(wide().signals, 4)
    signals = replace(signals, ay_m_s2=1.05 * signals.ay_m_s2 + 0.1, steer_rad=signals.steer_rad + 0.005)
    file = RIGHT.model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
    by = {p.name: p for p in found(signals, file).parameters}
    for name, true in (("roll gain", 1.05), ("a_y bias", 0.1), ("steering offset", 0.005)):
        assert abs(by[name].value - true) < 3.0 * by[name].sd, name


@pytest.mark.parametrize("metres", [-1.71, 0.0, 1.0])
def test_the_position_of_the_accelerometer_is_found(metres: float) -> None:
    """The first one is at the rear axle, where v_y is small and a_y alone agrees with no sideslip at all."""
    signals = with_noise(wide().signals, 7)
    turning = np.gradient(wide().r, signals.stamps_ns * 1e-9)
    moved = replace(signals, ay_m_s2=signals.ay_m_s2 + metres * turning)
    by = {p.name: p for p in found(moved, RIGHT).parameters}
    position = by["lever of a_y"]
    assert position.excited
    assert abs(position.value - metres) < 1.96 * position.sd


@pytest.mark.parametrize("share", [0.5, 0.3])
def test_a_slippery_road_is_found_although_the_file_is_of_a_dry_one(share: float) -> None:
    """The file's tyres have the stiffness of the car's and more grip, as a file for asphalt has of a car on ice."""
    dry = Tyres(**{n: t.model_copy(update={"B": share * t.B, "D_n": t.D_n / share}) for n, t in RIGHT.tyres})
    file = RIGHT.model_copy(update={"tyres": dry, "friction": None})
    signals = with_noise(drive(sweep(0.08), 20.0).signals, 12)
    by = {p.name: p for p in found(replace(signals, friction=np.full(len(signals), np.nan)), file).parameters}
    peak = by["peak force over the file's"]
    assert peak.excited
    assert abs(math.log(peak.value / (share * FRICTION))) < min(3.0 * peak.sd, 0.2)


def test_errors_that_no_parameter_explains_leave_the_prior() -> None:
    signals = with_noise(wide().signals, 10)
    rng = np.random.default_rng(11)
    rate, ay = (std * rng.standard_normal(len(signals)) for std in (1.0, 15.0))
    unexplained = replace(signals, yaw_rate_rad_s=signals.yaw_rate_rad_s + rate, ay_m_s2=signals.ay_m_s2 + ay)
    for p in found(unexplained, RIGHT).parameters:
        distance = math.log(p.value / p.prior) if p.log else p.value - p.prior
        assert abs(distance) < 2.0 * p.prior_sd, p.name


def test_slow_driving_calibrates_and_very_slow_driving_is_refused() -> None:
    file = wrong(0.6, 0.6).model_copy(update={"relaxation_length_m": 0.1})  # the forces of this car do not lag
    slow = found(with_noise(drive(sweep(0.08), 60.0, speed=7.0).signals, 9), file)
    assert not slow.refused
    for error, sd in stiffness_errors(slow):
        assert abs(error) < 1.96 * sd
    walking = found(drive(sweep(0.02), 20.0, speed=RIGHT.low_speed_blend_m_s - 1.0).signals, RIGHT)
    assert "0 s above" in walking.refused
    short = found(drive(sweep(0.02), 4.0).signals, RIGHT)
    assert "are needed" in short.refused
    assert short.vehicle is RIGHT


def test_what_straight_driving_does_not_excite_keeps_its_prior() -> None:
    straight = found(with_noise(drive(lambda _t: 0.0, 60.0).signals, 5), RIGHT)
    assert not straight.refused
    for p in straight.parameters:
        if p.name.endswith("cornering stiffness"):
            assert not p.excited
            assert p.value == pytest.approx(p.prior, rel=0.1)
    assert "not excited: front cornering stiffness" in straight.text


def test_a_right_file_decides_what_gentle_driving_cannot_and_a_wrong_one_does_not() -> None:
    signals = with_noise(drive(sweep(0.001), 20.0).signals, 3)

    def level_error(file: VehicleParameters) -> float:
        return abs(stiffness_errors(found(signals, file))[1][0])

    right, wrong_level, without_file = (level_error(file) for file in (wrong(1.001, 1.001), wrong(2.0, 0.5), RIGHT))
    assert right < 0.7 * without_file
    assert wrong_level < 0.7 * math.log(2.0)


def test_a_car_that_slides_all_the_time_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rules, "SLIDING_RAD", 0.001)
    signals = wide().signals
    slides = found(signals, RIGHT)
    assert "the rear axle slides in" in slides.refused
    assert slides.sliding_friction == pytest.approx(np.abs(signals.ay_m_s2).max() / 9.81, rel=0.1)


def test_a_taught_prior_that_the_driving_contradicts_is_not_used() -> None:
    log, rear = driving(wide().signals, RIGHT), RIGHT.cornering_stiffness_n_per_rad(False, FRICTION)
    untaught, right, absurd = (
        self_calibrate([log], RIGHT, taught=taught)
        for taught in (
            (),
            [TaughtParameter(name=REAR_STIFFNESS, value=rear, std=0.1)],
            [TaughtParameter(name=REAR_STIFFNESS, value=0.06 * rear, std=1e-4)],
        )
    )
    assert absurd.vehicle == untaught.vehicle and not absurd.refused
    assert right.vehicle != untaught.vehicle and not right.refused


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.05, 12.0), max_size=8))
def test_drives_of_a_group_are_alike_in_their_level_and_groups_ascend(levels: list[float]) -> None:
    groups = [[levels[k] for k in group] for group in like_drives(levels)]
    assert sorted(level for group in groups for level in group) == sorted(levels)
    assert all(min(group) >= LIKE[1] * max(group) for group in groups)
    assert all(max(low) < LIKE[1] * max(high) for low, high in pairwise(groups))


def test_of_priors_at_several_levels_the_nearest_one_counts() -> None:
    taught = [TaughtParameter(name=REAR_STIFFNESS, value=v, std=0.2, ay_m_s2=a) for v, a in ((1e5, 2.0), (2e5, 7.0))]
    parameters = parameters_of(RIGHT)

    def rear(level_m_s2: float) -> float:
        moved = with_taught(parameters, taught, level_m_s2)
        assert [p for p in moved if p.name != REAR_STIFFNESS] == [p for p in parameters if p.name != REAR_STIFFNESS]
        return next(p.mean for p in moved if p.name == REAR_STIFFNESS)

    assert [rear(level) for level in (0.0, 2.0, 3.0, 5.0, 9.0)] == pytest.approx([1e5, 1e5, 1e5, 2e5, 2e5])
    assert rear(0.1) == next(p.mean for p in parameters if p.name == REAR_STIFFNESS)


def test_steering_that_does_not_explain_the_yaw_rate_is_refused() -> None:
    signals = wide().signals
    assert "of the yaw rate" in found(replace(signals, steer_rad=-2.0 * signals.steer_rad), RIGHT).refused


@pytest.mark.slow
def test_a_file_that_contradicts_the_drive_is_told() -> None:
    slow = drive(sweep(0.01), 40.0).signals
    agrees, contradicts = (self_calibrate([driving(slow, v)], v).understeer for v in (RIGHT, wrong(2.0, 0.6)))
    assert agrees is not None and not agrees.contradicts
    assert contradicts is not None and contradicts.contradicts
    assert "contradicts" in contradicts.text


def test_the_calibrated_vehicle_reads_its_signals_with_what_was_found() -> None:
    signals = wide().signals
    calibration = found(replace(signals, steer_rad=signals.steer_rad + 0.005), RIGHT)
    assert calibration.vehicle.steer_offset_rad == pytest.approx(0.005, abs=1e-3)
    assert calibration.vehicle.physics.names == ("lag", "roll", "bank")
    assert calibration.vehicle.mass_kg == RIGHT.mass_kg
    assert calibration.vehicle_file is RIGHT


def test_a_pause_of_a_day_costs_no_memory() -> None:
    signals = wide().signals
    day = np.where(np.arange(len(signals)) < 3000, 0, 86_400 * 10**9)
    paused = driving(replace(signals, stamps_ns=signals.stamps_ns + day, ready_ns=signals.ready_ns + day), RIGHT)
    assert paused.columns.shape[1] < 60 / STEP_S + 200
    assert len(paused.stretches) == 2


def test_a_pool_knows_more_than_each_of_its_logs() -> None:
    logs = [driving(with_noise(cut(wide().signals, a, a + 2000), a), RIGHT) for a in (0, 2000, 4000)]
    alone, pool = self_calibrate(logs[:1], RIGHT), self_calibrate(logs, RIGHT)
    assert pool.logs == 3
    for (_, together), (_, single) in zip(stiffness_errors(pool), stiffness_errors(alone), strict=True):
        assert together < single


def test_a_pool_states_what_its_drives_differ_in() -> None:
    """A steering offset in one of three drives widens the pooled posterior to include the offset of every drive."""
    parts = [with_noise(cut(wide().signals, a, a + 2000), a) for a in (0, 2000, 4000)]

    def offset(*added_rad: float) -> tuple[float, float]:
        logs = [driving(replace(s, steer_rad=s.steer_rad + x), RIGHT) for s, x in zip(parts, added_rad, strict=True)]
        found = next(p for p in self_calibrate(logs, RIGHT).parameters if p.name == "steering offset")
        return found.value, found.sd

    (_, alike), (value, apart) = offset(0.0, 0.0, 0.0), offset(0.0, 0.0, 0.01)
    assert alike < 0.003
    assert apart > 1.5 * alike
    assert all(abs(value - true) < 1.96 * apart for true in (0.0, 0.01))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0.05, 0.98))
def test_any_losses_give_a_grid_whose_stretches_are_whole(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    signals = keep(wide().signals, rng.uniform(size=len(wide().signals)) < share)
    lost = np.where(rng.uniform(size=len(signals)) < 0.1, np.nan, signals.ay_m_s2)
    d = driving(replace(signals, ay_m_s2=lost), RIGHT)
    for a, b in d.stretches:
        assert np.isfinite(d.columns[:, a:b]).all()
        assert (d.columns[1, a:b] > RIGHT.low_speed_blend_m_s).all()
    assert (np.diff(d.stretches.ravel()) > 0).all()


def test_the_vehicles_of_the_band_spread_as_the_posterior_does() -> None:
    """Their joint spread is 70 % to 105 % of the posterior standard deviation of the cornering stiffness."""
    calibration = found(with_noise(wide().signals, 3), wrong(2.0, 0.5))
    assert len(calibration.varied) == 5
    by = {p.name: p for p in calibration.parameters}
    middle = calibration.vehicle
    for axle, front in (("front", True), ("rear", False)):
        at = math.log(middle.cornering_stiffness_n_per_rad(front, middle.assumed_friction))
        away = [math.log(v.cornering_stiffness_n_per_rad(front, v.assumed_friction)) - at for v in calibration.varied]
        sd = by[f"{axle} cornering stiffness"].sd
        assert 0.7 * sd < math.sqrt(sum(x**2 for x in away)) < 1.05 * sd


@pytest.mark.slow
def test_less_driving_spreads_them_wider() -> None:
    def spread(signals: Signals) -> float:
        of = found(signals, RIGHT)
        at = of.vehicle.cornering_stiffness_n_per_rad(False, of.vehicle.assumed_friction)
        return sum(math.log(v.cornering_stiffness_n_per_rad(False, v.assumed_friction) / at) ** 2 for v in of.varied)

    signals = with_noise(wide().signals, 3)
    assert spread(cut(signals, 0, 2000)) > 1.2 * spread(signals)
