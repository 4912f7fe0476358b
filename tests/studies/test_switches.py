"""The table of switches: both sides on the same stamps, and no harm hidden."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track
from studies import switches
from studies.condition_drives import ConditionDrive

VEHICLE = default_vehicle()
COUNT, LATE_STEPS = 400, 4


@pytest.fixture(scope="module")
def drive() -> ConditionDrive:
    """Weave at 20 m/s with a slip angle that only the truth knows; everything arrives four stamps late."""
    t = np.arange(COUNT) * 0.01
    stamps = np.arange(COUNT) * 10_000_000 + 10**9
    nan = np.full(COUNT, np.nan)
    beta = 0.02 * np.sin(3.0 * t)
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=stamps + LATE_STEPS * 10_000_000,
        steer_rad=0.02 * np.sin(3.0 * t),
        ax_m_s2=np.zeros(COUNT),
        ay_m_s2=2.0 * np.sin(3.0 * t),
        yaw_rate_rad_s=0.1 * np.sin(3.0 * t),
        speed_m_s=np.full(COUNT, 20.0),
        friction=np.ones(COUNT),
        wheel_speed_m_s=np.stack([nan] * 4, axis=1),
    )
    truth = make_track(
        "truth", stamps, vx_m_s=np.full(COUNT, 20.0), vy_m_s=20.0 * np.tan(beta),
        yaw_rate_rad_s=signals.yaw_rate_rad_s, ay_m_s2=signals.ay_m_s2, valid=np.ones(COUNT, dtype=np.bool_),
    )  # fmt: skip
    return ConditionDrive("weave", signals, truth, 3.0)


def line(on: list[float], off: list[float], *, default: bool = True) -> switches.Line:
    switch = switches.Switch("standstill", "stops", switches.run_plain, switches.run_plain, {"physics": default})
    return switches.Line(switch, "physics", np.array(on), np.array(off), np.full(len(on), 100.0))


def test_without_prediction_the_newest_arrived_step_stands_as_it_is(drive: ConditionDrive) -> None:
    ukf = PhysicsUkf(VEHICLE)
    steps, _ = ukf.run(drive.signals, None)
    track = switches.run_unpredicted(ukf, drive)
    np.testing.assert_array_equal(track.vy_m_s[LATE_STEPS:], steps.x[:-LATE_STEPS, 1])
    assert not track.valid[:LATE_STEPS].any()
    assert not np.array_equal(switches.run_plain(ukf, drive).vy_m_s[100:], track.vy_m_s[100:])


def test_steering_that_counts_when_it_arrives_is_old_and_nothing_waits_for_it(drive: ConditionDrive) -> None:
    seen: list[Signals] = []

    class Watching:
        name, causal = "watching", True

        def run(self, signals: Signals, _state: None) -> tuple[Steps, None]:
            seen.append(signals)
            return make_steps(*np.zeros((3, len(signals)))), None

    switches.run_late_steering(Watching(), drive)  # type: ignore[arg-type]
    late = round(switches.LATE_S / 0.01)
    np.testing.assert_allclose(seen[0].steer_rad[late:], drive.signals.steer_rad[:-late], atol=1e-12)
    np.testing.assert_array_equal(seen[0].ready_ns, drive.signals.stamps_ns)


def test_options_reach_all_filters_of_the_mixture() -> None:
    plain = AdaptivePhysics(PhysicsFilter(VEHICLE))
    for name in ("biases", "slip_gate"):
        switched = switches.with_option(plain, name, value=name == "biases")
        assert isinstance(switched, AdaptivePhysics)
        for one in (switched.physics, *switched.filters):
            assert one.vehicle.physics.biases == (name == "biases")
            assert one.slip_gate == (name == "biases")
    assert not plain.physics.vehicle.physics.biases


def test_a_part_of_physics_is_switched_in_its_model_and_ships_as_the_table_says() -> None:
    shipped = make_estimator("physics", Car.load("saloon", network="none"))
    assert isinstance(shipped, AdaptivePhysics)
    for part, on in shipped.physics.vehicle.physics:
        assert {s.default["physics"] for s in switches.SWITCHES if s.name == f"part {part.replace('_', ' ')}"} == {on}
        switched = switches.with_option(shipped, part, value=not on)
        assert isinstance(switched, AdaptivePhysics)
        was, now = shipped.physics.vehicle.physics, switched.physics.vehicle.physics
        assert {n for n, has in now if has != getattr(was, n)} == {part}
        assert switched.physics.q_std == shipped.physics.q_std


def test_both_sides_are_scored_where_both_say_something(drive: ConditionDrive) -> None:
    ukf = PhysicsUkf(VEHICLE)
    switch = switches.Switch("x", "stops", switches.run_plain, switches.run_unpredicted, {})
    on, off, samples = switches.compare(switch, ukf, drive)
    assert samples == switches.run_unpredicted(ukf, drive).valid.sum()
    assert on != off
    same = switches.Switch("x", "stops", switches.run_plain, switches.run_plain, {})
    assert switches.compare(same, ukf, drive)[0] == switches.compare(same, ukf, drive)[1]


def test_harm_is_said_and_so_is_a_better_setting_than_the_shipped_one(monkeypatch: pytest.MonkeyPatch) -> None:
    off = [1.0, 2.0, 3.0, 4.0, 5.0]
    cases = {
        "helps": line([0.5 * x for x in off], off),
        "**harms**": line([1.5 * x for x in off], off),
        "changes nothing": line(off, off),
        "no matter": line([1.001 * x for x in off], off),
        "open": line(off, off[::-1]),
    }
    for says, case in cases.items():
        assert case.says == says
    monkeypatch.setattr(switches, "SWITCHES", tuple(x.switch for x in cases.values()))
    text = switches.page([cases["**harms**"]], "command", "0" * 64, "car")
    assert text.count("- standstill, `physics` on `stops` (ships on): median 1.50") == 2
    assert "Nothing, as far" not in text
    monkeypatch.setattr(switches, "SWITCHES", (cases["helps"].switch,))
    text = switches.page([cases["helps"]], "command", "0" * 64, "car")
    assert "Nothing, as far" in text
    assert "Nowhere, as far" in text
