"""Manoeuvres reach their targets, spins and missed targets are reported, and invalid requests give a one-line error."""

import numpy as np
import pytest

from pdhef_logtool.records.errors import SimulationError, UsageError
from truthsim import manoeuvres
from truthsim.drive import reference_steer_rad, simulate_drive
from truthsim.vehicle import Vehicle

G = 9.80665


@pytest.mark.slow
@pytest.mark.parametrize("name", manoeuvres.MANOEUVRES)
def test_every_manoeuvre_reaches_what_it_is_for_without_a_spin(name):
    manoeuvre = manoeuvres.MANOEUVRES[name]
    drive = simulate_drive(name, duration_s=40.0 if name == "road" else None)
    assert not drive.spun and not drive.lifted
    assert drive.peak_ay_m_s2 >= manoeuvre.least_share * manoeuvre.friction * G
    # NHTSA's full angle spins this car without stability control: it is lowered, and that is said.
    assert bool(drive.notes) == (name == "fishhook")


@pytest.mark.slow
def test_lane_change_is_the_standard_s_course_and_peaks_near_0_7_g():
    lane_change = simulate_drive("dlc", seed=1)
    assert 0.65 <= lane_change.peak_ay_m_s2 / G <= 0.75
    assert manoeuvres.ISO_3888_1_M == (15.0, 30.0, 25.0, 25.0, 15.0, 15.0)
    plan = manoeuvres.MANOEUVRES["dlc"].plan(manoeuvres.Request(100.0 / 3.6, 0.85, 0, 9.5, 1.0))
    x, y = plan.path[:, 0], plan.path[:, 1]
    start = 2.0 * 100.0 / 3.6 + 15.0
    side = (x >= start + 30.0) & (x <= start + 55.0)
    assert np.all(np.abs(y[side] - 3.5) < 1e-9) and y.max() == pytest.approx(3.5)
    assert np.all(np.abs(y[(x <= start) | (x >= start + 80.0)]) < 1e-9)
    # Out and back, and on course again at the end.
    assert lane_change.truth["y_m"].max() == pytest.approx(3.5 * lane_change.scale, rel=0.25)
    assert abs(lane_change.truth["y_m"][-1]) < 0.3
    assert abs(lane_change.truth["vx_m_s"] * 3.6 - 100.0).max() < 5.0


def test_sine_with_dwell_is_fmvss_126_s():
    period = 1.0 / 0.7
    t = np.array([-0.1, 0.0, 0.25 * period, 0.5 * period, 0.75 * period, 0.75 * period + 0.25, 0.75 * period + 0.5])
    assert manoeuvres.sine_with_dwell(t) == pytest.approx([0.0, 0.0, 1.0, 0.0, -1.0, -1.0, -1.0], abs=1e-12)
    late = 0.75 * period + 0.5 + np.array([0.125 * period, 0.25 * period - 1e-9, 0.25 * period + 1e-3, 3.0])
    assert manoeuvres.sine_with_dwell(late) == pytest.approx([-np.sqrt(0.5), 0.0, 0.0, 0.0], abs=1e-6)
    drive = simulate_drive("sine-with-dwell")
    assert drive.speed_km_h == 80.0
    steer = drive.truth["steer_rad"]
    # Four times the angle at 0.3 g, and the car coasts once the steering begins.
    linear = 0.3 * G * (2.87 / (80.0 / 3.6) ** 2 + 0.0031)
    assert steer.max() == pytest.approx(4.0 * linear, rel=0.1)
    assert steer.max() == pytest.approx(4.0 * reference_steer_rad(80.0 / 3.6, 0.85, Vehicle()), rel=1e-3)
    held = np.flatnonzero(steer <= steer.min() * 0.9999)
    assert np.ptp(held) * 0.01 == pytest.approx(0.5, abs=0.03)
    assert drive.truth["vx_m_s"][-1] < 80.0 / 3.6 - 0.5


def test_fishhook_is_nhtsa_s():
    top, rate = 0.2, np.deg2rad(720.0) / 16.0
    ramp = top / rate
    t = np.array([0.0, 0.5 * ramp, ramp, ramp + 0.25, ramp + 0.25 + ramp, ramp + 0.25 + 2 * ramp, 3 * ramp + 3.25])
    assert manoeuvres.fishhook(t, top) == pytest.approx([0.0, 0.1, 0.2, 0.2, 0.0, -0.2, -0.2])
    assert manoeuvres.fishhook(np.array([3 * ramp + 4.25, 3 * ramp + 5.25, 60.0]), top) == pytest.approx(
        [-0.1, 0.0, 0.0]
    )
    drive = simulate_drive("fishhook", keep_spins=True)
    reference = reference_steer_rad(80.0 / 3.6, 0.85, Vehicle())
    assert np.abs(drive.truth["steer_rad"]).max() == pytest.approx(6.5 * reference, rel=1e-3)


@pytest.mark.parametrize("speed_km_h", [40.0, 60.0])
def test_severe_lane_change_stays_between_the_cones(speed_km_h):
    drive = simulate_drive("dlc-3888-2", speed_km_h=speed_km_h)
    low, high = manoeuvres.iso_3888_2_corridor_m(drive.truth["x_m"] - manoeuvres.iso_3888_2_start_m(speed_km_h / 3.6))
    assert np.isfinite(low).sum() > 100
    assert np.all(drive.truth["y_m"] >= low - 0.1) and np.all(drive.truth["y_m"] <= high + 0.1)
    # Coasting through, and faster than the standard's course can be driven is refused.
    assert drive.truth["vx_m_s"][-1] < speed_km_h / 3.6 - 0.1
    with pytest.raises(UsageError, match="70"):
        simulate_drive("dlc-3888-2", speed_km_h=90.0)


def test_the_friction_jumps_down_and_up_again():
    drive = simulate_drive("mu-jump")
    third = 80.0 / 3.6 * 12.0 / 3.0
    for wheel, ahead in (("fl", 1.16), ("rr", -1.71)):
        friction, place = drive.truth[f"friction_{wheel}"], drive.truth["x_m"] + ahead
        assert np.all(friction[place < third - 3.0] == 0.85)
        middle = (place > third + 3.0) & (place < 2.0 * third - 10.0)
        assert friction[middle] == pytest.approx(0.425)
        assert friction[-50:] == pytest.approx(0.85)
    # Half the friction: the same steering gives less than on the dry parts.
    a_y = np.abs(drive.truth["ay_m_s2"])
    slippery = drive.truth["friction"] < 0.5
    assert 0.3 * G < a_y[slippery].max() < 0.43 * G < a_y[~slippery].max()


def test_a_banked_road_leans_both_ways_and_climbs():
    drive = simulate_drive("banked-road")
    bank, grade, a_y = drive.truth["bank_rad"], drive.truth["grade_rad"], drive.truth["ay_m_s2"]
    assert np.abs(bank).max() == pytest.approx(0.10, rel=0.02) and np.abs(grade).max() == pytest.approx(0.06, rel=0.05)
    hard = np.abs(a_y) > 2.0
    # Leaning left (negative) is inward in a left-hand bend (positive a_y); both kinds are there.
    assert (bank * np.sign(a_y))[hard].min() < -0.09 and (bank * np.sign(a_y))[hard].max() > 0.05
    assert np.ptp(drive.truth["z_m"]) > 5.0
    assert np.abs(drive.truth["vx_m_s"] * 3.6 - 80.0).max() < 5.0


@pytest.mark.slow
def test_a_road_is_ordinary_and_has_a_standstill():
    truth = simulate_drive("road", seed=3, duration_s=120.0).truth
    standing = np.hypot(truth["vx_m_s"], truth["vy_m_s"]) < 0.02
    edges = np.flatnonzero(np.diff(np.concatenate([[0], standing.astype(int), [0]])))
    stops = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 500]
    assert stops
    assert np.abs(truth["ay_m_s2"]).max() < 4.5 and np.abs(truth["ax_m_s2"]).max() < 3.5
    assert truth["vx_m_s"].max() * 3.6 < 113.0 and truth["vx_m_s"].min() > -0.15
    assert np.abs(truth["ay_m_s2"]).std() > 0.3  # it does have bends
    # The car is at rest once its body has stopped rocking, also on a slope and a banked road.
    for start, end in stops:
        still = slice(start + 200, end - 20)
        assert np.abs(truth["grade_rad"][still]).max() > 1e-3
        for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2"):
            assert np.abs(truth[name][still]).max() < 1e-3, name


def test_a_spin_is_dropped_unless_asked_for():
    # A car oversteers if its rear axle steers out of the bend.
    loose = Vehicle()._replace(rear_compliance_rad_per_n=-4e-5)
    with pytest.raises(SimulationError, match="--keep-spins") as caught:
        simulate_drive("dlc-3888-2", speed_km_h=70.0, vehicle=loose)
    assert "spun" in str(caught.value)
    drive = simulate_drive("dlc-3888-2", speed_km_h=70.0, vehicle=loose, keep_spins=True)
    assert drive.spun and np.degrees(drive.peak_sideslip_rad) > 20.0
    assert any("spun" in note for note in drive.notes)
    assert drive.facts()["spun"] is True and drive.metadata()["spun"] == "true"
    assert drive.command.endswith("--keep-spins")


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("dlc", {"speed_km_h": 900.0}, ("speed", "900")),
        ("dlc", {"friction": 0.0}, ("friction", "0")),
        ("dlc", {"friction": float("nan")}, ("friction", "nan")),
        ("dlc", {"seed": -1}, ("seed", "-1")),
        ("road", {"duration_s": 0.0}, ("duration", "0")),
        ("road", {"rtk_rate_hz": 33}, ("RTK", "33")),
        ("dlc", {"amplitude": 0.0}, ("amplitude", "0")),
    ],
)
def test_bad_requests_are_one_clear_line(name, options, words):
    with pytest.raises(UsageError) as caught:
        simulate_drive(name, **options)
    assert all(word in str(caught.value) for word in words)
