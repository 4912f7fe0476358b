"""Manoeuvres reach what they are for, spins and misses are reported, and bad requests are one clear line."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from pdhef_logtool.errors import SimulationError
from truthsim.drive import Drive, simulate_drive
from truthsim.manoeuvres import ISO_3888_1_M, MANOEUVRES, PATH_STEP_M, Plan, Request
from truthsim.motion import simulate_motion
from truthsim.vehicle import Vehicle

G = 9.80665


@pytest.fixture(scope="module")
def lane_change() -> Drive:
    return simulate_drive("dlc", seed=1)


@pytest.fixture(scope="module")
def road() -> Drive:
    return simulate_drive("road", seed=3, duration_s=120.0)


def test_catalogue_is_complete_and_works() -> None:
    assert {"dlc", "sine-sweep", "road", "step-steer", "ramp-steer"} <= set(MANOEUVRES)
    for name, manoeuvre in MANOEUVRES.items():
        assert manoeuvre.name == name and manoeuvre.description and manoeuvre.duration_s > 0.0
        drive = simulate_drive(name, duration_s=40.0 if name == "road" else None)
        assert not drive.notes and not drive.spun, name
        assert drive.peak_ay_m_s2 >= manoeuvre.least_share * manoeuvre.friction * G, name


def test_lane_change_is_the_standard_s_course_and_peaks_near_0_7_g(lane_change: Drive) -> None:
    assert 0.65 <= lane_change.peak_ay_m_s2 / G <= 0.75
    assert ISO_3888_1_M == (15.0, 30.0, 25.0, 25.0, 15.0, 15.0)
    plan = MANOEUVRES["dlc"].plan(Request(100.0 / 3.6, 0.85, 0, 9.5, 1.0))
    x, y = plan.path[:, 0], plan.path[:, 1]
    start = 2.0 * 100.0 / 3.6 + 15.0
    side = (x >= start + 30.0) & (x <= start + 55.0)
    assert np.all(np.abs(y[side] - 3.5) < 1e-9) and y.max() == pytest.approx(3.5)
    assert np.all(np.abs(y[(x <= start) | (x >= start + 80.0)]) < 1e-9)
    # Out and back, and on course again at the end.
    assert lane_change.truth["y_m"].max() == pytest.approx(3.5 * lane_change.scale, rel=0.25)
    assert abs(lane_change.truth["y_m"][-1]) < 0.3
    assert abs(lane_change.truth["vx_m_s"] * 3.6 - 100.0).max() < 5.0


def test_sweep_reaches_nine_tenths_of_the_friction_limit() -> None:
    drive = simulate_drive("sine-sweep", seed=1)
    assert drive.friction == 0.3 and drive.speed_km_h == 60.0 and drive.duration_s == 12.0
    a_y = np.abs(drive.truth["ay_m_s2"])
    assert 0.90 * 0.3 * G <= a_y.max() <= 0.3 * G
    # Growing, and turning round faster at the end: 0.6 Hz at first, 1 Hz at last.
    assert a_y[:300].max() < 0.55 * a_y.max() and a_y[-200:].max() > 0.95 * a_y.max()
    crossings = drive.times_s[1:][np.diff(np.sign(drive.truth["steer_rad"])) != 0]
    assert np.diff(crossings)[1] == pytest.approx(0.5 / 0.63, rel=0.06)
    assert np.diff(crossings)[-1] == pytest.approx(0.5 / 0.98, rel=0.06)


def test_step_steer_is_iso_7401_s() -> None:
    drive = simulate_drive("step-steer")
    assert drive.peak_ay_m_s2 == pytest.approx(4.0, rel=0.01)
    steer = drive.truth["steer_rad"]
    assert np.all(steer[:100] == 0.0) and np.ptp(steer[120:]) == 0.0


def test_friction_limits_the_lateral_acceleration() -> None:
    plan = Plan(25.0, 6.0, steer_rad=np.concatenate([np.linspace(0.0, 0.12, 1000), np.full(5001, 0.12)]))
    for friction in (0.2, 0.5, 0.9):
        peak = np.abs(simulate_motion(plan, friction).column("ay_m_s2")[100:]).max() / G
        assert 0.75 * friction < peak < 1.02 * friction


def test_a_road_is_ordinary_and_has_a_standstill(road: Drive) -> None:
    truth = road.truth
    standing = np.hypot(truth["vx_m_s"], truth["vy_m_s"]) < 1e-3
    edges = np.flatnonzero(np.diff(np.concatenate([[0], standing.astype(int), [0]])))
    assert (edges[1::2] - edges[::2]).max() * 0.01 >= 5.0
    assert np.abs(truth["ay_m_s2"]).max() < 4.0 and np.abs(truth["ax_m_s2"]).max() < 3.5
    assert truth["vx_m_s"].max() * 3.6 < 92.0 and truth["vx_m_s"].min() > -0.01
    assert np.abs(truth["ay_m_s2"]).std() > 0.3  # it does have bends
    still = np.flatnonzero(standing)[250:-20]
    for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2"):
        assert np.abs(truth[name][still]).max() < 2e-4, name


def test_the_driver_keeps_to_the_road() -> None:
    plan = MANOEUVRES["road"].plan(Request(25.0, 0.85, 3, 120.0, 1.0))
    motion = simulate_motion(plan, 0.85)
    reach = int(motion.column("vx_m_s").clip(0.0).sum() * 0.01 / PATH_STEP_M) + 10
    for i in range(0, motion.times_s.shape[0], 500):
        gap = np.hypot(plan.path[:reach, 0] - motion.column("x_m")[i], plan.path[:reach, 1] - motion.column("y_m")[i])
        assert gap.min() < 0.6


def test_seeds_make_other_roads_and_other_noise_and_repeat(road: Drive) -> None:
    again = simulate_drive("road", seed=3, duration_s=120.0)
    other = simulate_drive("road", seed=4, duration_s=120.0)
    assert np.array_equal(again.truth["x_m"], road.truth["x_m"])
    assert np.array_equal(again.channels["imu"].fields["ay_m_s2"], road.channels["imu"].fields["ay_m_s2"])
    assert not np.array_equal(other.truth["x_m"], road.truth["x_m"])
    assert not np.array_equal(other.channels["imu"].fields["ay_m_s2"], road.channels["imu"].fields["ay_m_s2"])


def test_a_spin_is_reported() -> None:
    # A car whose rear axle steers out of the bend oversteers, and spins in ordinary driving.
    loose = Vehicle()._replace(rear_compliance_rad_per_n=-4e-5)
    drive = simulate_drive("road", vehicle=loose, speed_km_h=120.0, duration_s=60.0, seed=2)
    assert drive.spun and np.degrees(drive.peak_sideslip_rad) > 20.0
    assert any("spun" in note for note in drive.notes)
    assert drive.facts()["spun"] is True and drive.metadata()["spun"] == "true"


def test_an_amplitude_that_cannot_be_had_is_said() -> None:
    drive = simulate_drive("sine-sweep", speed_km_h=20.0, friction=1.0)
    assert any("only" in note for note in drive.notes)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("loop-the-loop", {}, ("dlc", "loop-the-loop", "--list")),
        ("dlc", {"speed_km_h": 900.0}, ("speed", "900")),
        ("dlc", {"friction": 0.0}, ("friction", "0")),
        ("dlc", {"friction": float("nan")}, ("friction", "nan")),
        ("dlc", {"seed": -1}, ("seed", "-1")),
        ("road", {"duration_s": 0.0}, ("duration", "0")),
        ("road", {"rtk_rate_hz": 33}, ("RTK", "33")),
    ],
)
def test_bad_requests_are_one_clear_line(name: str, options: dict[str, float], words: tuple[str, ...]) -> None:
    with pytest.raises(SimulationError) as caught:
        simulate_drive(name, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_command_makes_the_drive_again(lane_change: Drive) -> None:
    assert lane_change.command == "pdhef simulate dlc --speed 100 --mu 0.85 --seed 1"
    assert simulate_drive("road", duration_s=20.0).command.endswith("--seed 0 --duration 20")


def test_listing_the_manoeuvres_compiles_nothing() -> None:
    code = "import sys, truthsim.manoeuvres; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
