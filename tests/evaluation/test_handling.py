"""Key figures of manoeuvres against responses in closed form, of estimates and of ground truth alike."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool import Car, read_drive
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.metrics.handling import METRICS
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

T0 = 1_700_000_000_000_000_000
T = np.arange(0.0, 8.0, 0.01)
STAMPS = T0 + np.round(T * 1e9).astype(np.int64)
VEHICLE = Car.load().vehicle
WHEELBASE_M = VEHICLE.cg_to_front_axle_m + VEHICLE.cg_to_rear_axle_m
DAMPING, OMEGA = 0.5, 8.0


def figures(steer, name, inside, truth, **estimates):
    signals = signals_at(STAMPS, steer_rad=steer)
    tracks = {k: make_track(k, STAMPS, **c) for k, c in estimates.items()}
    calibrated = CalibratedSignals(signals, VEHICLE)
    drive = EvaluatedDrive("x", tracks, make_track("truth", STAMPS, **truth), signals, {name: inside}, 3.0, calibrated)
    rows = evaluate_drive(drive, [m.name for m in METRICS])
    assert {row.segment for row in rows} <= {"all"}
    return {(row.estimator, row.signal, row.metric): row.value for row in rows}


def second_order(since):
    """Unit step response of a damped oscillator."""
    s = np.maximum(since, 0.0)
    root = math.sqrt(1.0 - DAMPING**2)
    turn = OMEGA * root * s
    return 1.0 - np.exp(-DAMPING * OMEGA * s) * (np.cos(turn) + DAMPING / root * np.sin(turn))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_step_has_the_figures_of_its_oscillator(side):
    rise = np.clip((T - 1.0) / 0.1, 0.0, 1.0)  # half of it at 1.05 s
    found = figures(
        side * 0.03 * rise, "step-steer", (T > 0.5) & (T < 6.0),
        {
            "yaw_rate_rad_s": side * 0.3 * second_order(T - 1.05), "ay_m_s2": side * 6.0 * second_order(T - 1.05),
            "sideslip_rad": side * (0.001 - 0.02 * second_order(T - 1.05)),
        },
        late={"yaw_rate_rad_s": side * 0.3 * second_order(T - 1.15), "ay_m_s2": np.full(len(T), np.nan)},
    )  # fmt: skip
    fine = np.arange(0.0, 1.0, 1e-5)
    time = fine[np.argmax(second_order(fine) >= 0.9)]
    overshoot = math.exp(-math.pi * DAMPING / math.sqrt(1.0 - DAMPING**2))
    for signal, size in (("yaw_rate_rad_s", 0.3), ("ay_m_s2", 6.0)):
        assert found["truth", signal, "step_response_time"] == pytest.approx(time, abs=1e-3)
        assert found["truth", signal, "step_overshoot"] == pytest.approx(overshoot, abs=2e-3)
        assert found["truth", signal, "step_peak"] == pytest.approx(side * size * (1.0 + overshoot), rel=2e-3)
    peak_s = math.pi / (OMEGA * math.sqrt(1.0 - DAMPING**2))
    assert found["truth", "yaw_rate_rad_s", "step_peak_time"] == pytest.approx(peak_s, abs=0.006)  # stamps every 10 ms
    tb = found["truth", "yaw_rate_rad_s", "step_peak_time"] * side * -0.02
    assert found["truth", "sideslip_rad", "step_tb"] == pytest.approx(tb, rel=1e-3)
    assert found["late", "yaw_rate_rad_s", "step_response_time"] == pytest.approx(time + 0.1, abs=1e-3)
    assert ("late", "ay_m_s2", "step_peak") not in found


def test_a_sine_with_dwell_has_the_ratios_of_its_decay():
    hz = 0.7
    steer = np.where(0.75 / hz > T, np.sin(2 * np.pi * hz * T), -1.0)
    steer = np.where(0.75 / hz + 0.5 < T, np.sin(2 * np.pi * hz * (T - 0.5)), steer)
    complete = 1.0 / hz + 0.5
    steer = 0.1 * np.where(complete <= T, 0.0, steer)
    rate = np.where(complete > T, 0.4 * steer / 0.1, -0.4 * np.exp(-(T - complete) / 0.8))
    peak = np.where((0.5 / hz < T) & (complete > T), -0.4, rate)  # held at its peak until the steering is complete
    found = figures(steer, "sine-with-dwell", (T >= 0.0) & (complete >= T), {"yaw_rate_rad_s": peak})
    at_zero = complete - math.asin(0.05) / (2 * np.pi * hz)
    for metric, after in (("dwell_ratio_1s", 1.0), ("dwell_ratio_1_75s", 1.75)):
        expected = math.exp(-(at_zero + after - complete) / 0.8)
        assert found["truth", "yaw_rate_rad_s", metric] == pytest.approx(expected, rel=0.02)


def test_the_understeer_gradient_is_the_slope_beyond_the_geometric_angle():
    speed, gradient = 20.0, 0.003
    ay = np.clip(0.8 * T, 0.0, 6.0)
    rate = ay / speed
    steer = WHEELBASE_M * rate / speed + gradient * ay + 0.02 * np.maximum(ay - 4.0, 0.0)  # and a limit
    motion = {"vx_m_s": np.full(len(T), speed), "yaw_rate_rad_s": rate, "ay_m_s2": ay}
    wrong = motion | {"ay_m_s2": 2.0 * ay}
    found = figures(steer, "ramp-steer", T < 7.5, motion, twice=wrong)
    assert found["truth", "ay_m_s2", "understeer_gradient"] == pytest.approx(gradient, rel=1e-6)
    assert found["twice", "ay_m_s2", "understeer_gradient"] == pytest.approx(0.5 * gradient, rel=1e-6)
    flat = figures(steer, "steady-circle", (T > 2.0) & (T < 2.5), motion)
    assert ("truth", "ay_m_s2", "understeer_gradient") not in flat  # one lateral acceleration has no slope


def test_a_lane_change_has_the_speed_of_its_first_stamp_and_other_drives_no_figures():
    speed = {"vx_m_s": 20.0 - T}
    found = figures(0.0 * T, "dlc-3888-2", ((T > 1.995) & (T < 4.0)) | (T > 6.0), speed)
    assert found == {("truth", "vx_m_s", "entry_speed"): pytest.approx(18.0)}
    assert figures(0.0 * T, "straight", T > 2.0, speed) == {}


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sine_with_dwell_displaces_the_car_by_its_lateral_acceleration(side):
    start, speed = 1.0, 20.0
    since = np.maximum(T - start, 0.0)
    wheel = np.deg2rad(5.0) / VEHICLE.steering_ratio
    steer = side * wheel * since / 0.205  # 5 degrees at the steering wheel between 0.20 and 0.21 s
    slide, rate = -0.3 * since**2, 0.4 * since
    motion = {"vx_m_s": 0.0 * T + speed, "vy_m_s": side * slide, "yaw_rate_rad_s": side * rate}
    found = figures(steer, "sine-with-dwell", (start <= T) & (T < 3.0), motion, straight={**motion, "vy_m_s": 0.0 * T})
    a, b = 0.21, 1.28  # v_y - v_y(a), and v_x r integrated twice, both from a to b
    slid = -0.1 * (b**3 - a**3) + 0.3 * a**2 * (b - a)
    turned = 0.4 * speed * ((b**3 - a**3) / 6.0 - a**2 * (b - a) / 2.0)
    assert found["truth", "position_m", "dwell_displacement"] == pytest.approx(slid + turned, rel=2e-3)
    assert found["straight", "position_m", "dwell_displacement"] == pytest.approx(turned, rel=2e-3)


def test_a_sine_sweep_has_the_frequency_response_of_its_lag():
    corner, gain, delay = 1.2, 8.0, 0.05
    hz = np.arange(0.5, 2.01, 0.25)  # whole periods in each spectrum
    time = np.arange(0.0, 20.0, 0.01)

    def answer(f):
        return gain / (1.0 + 1j * f / corner) * np.exp(-2j * np.pi * f * delay)

    def summed(f_response):
        return sum((np.exp(2j * np.pi * f * time + 1j * f**2) * f_response(f)).imag for f in hz)

    stamps = T0 + np.round(time * 1e9).astype(np.int64)
    signals = signals_at(stamps, steer_rad=0.01 * summed(lambda _: 1.0))
    noise = np.random.default_rng(1).normal(0.0, 0.1, len(time))
    rates = {"exact": 0.01 * summed(answer), "noisy": 0.01 * summed(answer) + noise}
    tracks = {name: make_track(name, stamps, yaw_rate_rad_s=rate) for name, rate in rates.items()}
    inside = {"sine-sweep": time >= 0.0}
    drive = EvaluatedDrive("x", tracks, None, signals, inside, 3.0, CalibratedSignals(signals, VEHICLE))
    found = {(r.estimator, r.metric): r.value for r in evaluate_drive(drive, [m.name for m in METRICS])}
    low = hz[0]
    bandwidth = corner * math.sqrt(2.0 * (1.0 + (low / corner) ** 2) - 1.0)
    assert found["exact", "sweep_gain"] == pytest.approx(abs(answer(low)), rel=0.02)
    assert found["exact", "sweep_phase"] == pytest.approx(-math.atan(1.0 / corner) - 2.0 * math.pi * delay, abs=0.02)
    assert found["exact", "sweep_bandwidth"] == pytest.approx(bandwidth, rel=0.02)
    assert found["exact", "sweep_coherence"] > 0.98 > 0.93 > found["noisy", "sweep_coherence"]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_braking_in_a_turn_has_the_figures_of_its_ramps(side):
    since = np.maximum(T - 2.5, 0.0)  # the manoeuvre begins 1.5 s before the brake
    vx = 20.0 - 4.0 * since
    rate, slip = 0.2 * vx / 20.0 * (1.0 + 0.1 * since), -0.01 - 0.02 * np.sin(np.pi * since)
    motion = {"vx_m_s": vx, "yaw_rate_rad_s": side * rate, "sideslip_rad": side * slip}
    holds = motion | {"yaw_rate_rad_s": side * 0.01 * vx, "sideslip_rad": np.full(len(T), np.nan)}
    inside = (T > 0.995) & (T < 4.505)
    found = figures(0.0 * T + 0.03 * side, "brake-in-turn", inside, motion, holds=holds)
    assert found["truth", "yaw_rate_rad_s", "brake_yaw_ratio"] == pytest.approx(1.1, rel=1e-6)
    assert found["holds", "yaw_rate_rad_s", "brake_yaw_ratio"] == pytest.approx(1.0, rel=1e-6)
    assert found["truth", "vx_m_s", "brake_deceleration"] == pytest.approx(4.0, rel=1e-6)
    assert found["truth", "sideslip_rad", "brake_sideslip"] == pytest.approx(-0.02 * side, rel=1e-3)
    assert ("holds", "sideslip_rad", "brake_sideslip") not in found


NAMES = ("step-steer", "sine-with-dwell", "ramp-steer", "dlc-3888-2", "brake-in-turn", "sine-sweep")


@pytest.mark.parametrize("name", NAMES)
def test_unknown_steering_leaves_the_figures_that_need_none(name):
    rate = 0.2 + 0.1 * np.sin(4.0 * T)
    motion = {"vx_m_s": 20.0 - T, "vy_m_s": -0.1 * rate, "yaw_rate_rad_s": rate, "ay_m_s2": 20.0 * rate}
    steer = 0.03 * np.clip(T - 1.0, 0.0, 1.0) + 0.01 * np.sin(4.0 * T)
    none = figures(np.full(len(T), np.nan), name, T < 7.5, motion)
    without = {"entry_speed", "brake_yaw_ratio", "brake_deceleration", "brake_sideslip", "step_peak", "step_overshoot"}
    assert {metric for _, _, metric in none} <= without
    whole = figures(steer, name, T < 7.5, motion)
    some = figures(np.where((T < 0.05) | (np.arange(len(T)) % 7 == 3), np.nan, steer), name, T < 7.5, motion)
    assert whole.keys() == some.keys() and len(whole) >= 1 and all(map(math.isfinite, some.values()))
    assert some["truth", "vx_m_s", "entry_speed"] == pytest.approx(19.95, abs=0.02) if name == "dlc-3888-2" else True


# ---- Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out ----

MINUTE_S = np.arange(0, 60, 0.01)
MINUTE_STAMPS_NS = T0 + np.round(MINUTE_S * 1e9).astype(np.int64)


def drive() -> Signals:
    """Speed 20 + 4 sin(0.3 t), yaw rate 0.1 sin(0.5 t), no slip: a_x = v̇, a_y = v r exactly."""
    speed = 20 + 4 * np.sin(0.3 * MINUTE_S)
    rate = 0.1 * np.sin(0.5 * MINUTE_S)
    measured = np.where(np.arange(MINUTE_S.size) % 5 == 0, speed, np.nan)
    columns = {"ax_m_s2": 1.2 * np.cos(0.3 * MINUTE_S), "ay_m_s2": speed * rate, "yaw_rate_rad_s": rate}
    return signals_at(MINUTE_STAMPS_NS, steer_rad=0.0, speed_m_s=measured, **columns)


def test_figures_of_a_segment_are_formulas_over_its_stamps_and_steps():
    n = MINUTE_S.size
    rng = np.random.default_rng(1)
    nis, dof = rng.chisquare(2, n), rng.choice([0.0, 1.0, 2.0], n)
    track = make_track("e", MINUTE_STAMPS_NS, nis=nis, nis_dof=dof, diverged=rng.random(n) < 0.1)
    mask, has_nis, ratio = rng.random(n) < 0.7, dof > 0, nis / np.where(dof > 0, dof, 1.0)
    pairs = (has_nis & mask)[1:] & (has_nis & mask)[:-1]
    speed, step_s = 20 + 4 * np.sin(0.3 * MINUTE_S), 0.01
    held = speed[np.arange(n) // 5 * 5]
    expected = {
        "nis": (nis[mask & has_nis].mean(), (mask & has_nis).sum()),
        "nis_dof": (dof[mask & has_nis].mean(), (mask & has_nis).sum()),
        "diverged": (track.diverged[mask].mean(), mask.sum()),
        "nis_autocorrelation": (np.corrcoef(ratio[:-1][pairs], ratio[1:][pairs])[0, 1], pairs.sum()),
        "exposure_s": (mask.sum() * step_s, mask.sum()),
        "exposure_m": (held[mask].sum() * step_s, mask.sum()),
    }
    found = evaluate_drive(EvaluatedDrive("drive", {"e": track}, None, drive(), {"turn": mask}, 3.0))
    rows = {r.metric: (r.value, r.n) for r in found if r.segment == "turn"}
    for metric, (value, count) in expected.items():
        assert rows[metric] == (pytest.approx(value, rel=1e-9), count)


SALOON = Car.load("saloon")
LOADED = SALOON.physics_vehicle


@pytest.fixture(scope="module")
def lane_change(sample_logs_dir):
    with read_drive(sample_logs_dir / "dlc.mcap", SALOON) as drive:
        return drive.whole()


def figure(
    tracks: list[StateTrack], drive: WholeDrive, vehicle: VehicleParameters = LOADED, delay_s: float = 0.0
) -> list[float]:
    named = {str(i): track for i, track in enumerate(tracks)}
    calibrated = CalibratedSignals(corrected_anew(drive.signals, SALOON.vehicle, vehicle), vehicle, delay_s)
    evaluated = EvaluatedDrive("", named, None, drive.signals, {}, 3.0, calibrated)
    return [row.value for row in evaluate_drive(evaluated, ("yaw_consistency",))]


def test_the_true_sideslip_explains_the_yaw_rate_and_zero_does_not(sample_logs_dir):
    with read_drive(sample_logs_dir / "road.mcap", SALOON) as drive:
        whole = drive.whole()
    road = replace(whole, signals=whole.signals.rows(0, 6000), truth=whole.truth.rows(0, 6000))
    zero = run_estimator(make_estimator("zero", SALOON), road.signals)
    true, none = figure([road.truth, zero], road)
    assert true < 0.1 * float(np.sqrt(np.nanmean(road.signals.yaw_rate_rad_s**2)))
    assert none > 3.0 * true


def test_a_gyro_bias_and_a_steering_delay_that_the_log_calibrated_are_taken_off(lane_change):
    signals, delay = lane_change.signals, 5
    late = np.concatenate([np.full(delay, signals.steer_rad[0]), signals.steer_rad[:-delay]])
    spoilt = replace(signals, steer_rad=late, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.02)
    bias = SALOON.vehicle.sensors.yaw_rate_bias_rad_s + 0.02
    sensors = LOADED.sensors.model_copy(update={"yaw_rate_bias_rad_s": bias})
    vehicle = LOADED.model_copy(update={"sensors": sensors})
    step_s = float(np.median(np.diff(signals.stamps_ns))) * 1e-9
    drive = replace(lane_change, signals=spoilt)
    (clean,), (ignored,) = (figure([lane_change.truth], of) for of in (lane_change, drive))
    (corrected,) = figure([lane_change.truth], drive, vehicle, -delay * step_s)
    assert corrected < 1.3 * clean < ignored


def test_there_is_no_figure_without_steering_or_speed(lane_change):
    nothing = np.full(len(lane_change.signals), np.nan)
    for name in ("steer_rad", "speed_m_s"):
        blind = replace(lane_change.signals, **{name: nothing})
        assert figure([lane_change.truth], replace(lane_change, signals=blind)) == []


SPEED, RATE, VY = 20.0 + 0.0 * MINUTE_S, 0.1 * np.sin(0.5 * MINUTE_S), 0.4 * np.sin(0.8 * MINUTE_S)
VY_RATE, YAW_ACCELERATION = 0.32 * np.cos(0.8 * MINUTE_S), 0.05 * np.cos(0.5 * MINUTE_S)
LEANING = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.008, "imu_position_m": (0.7, 0.0, 0.0)})


def signals() -> Signals:
    """Return the readings of the vehicle's sensors for the motion above."""
    felt = VY_RATE + SPEED * RATE
    ay = (1.0 + GRAVITY_M_S2 * 0.008) * felt + 0.7 * YAW_ACCELERATION
    speed = np.where(np.arange(MINUTE_S.size) % 5 == 0, SPEED, np.nan)
    return signals_at(MINUTE_STAMPS_NS, steer_rad=0.0, ax_m_s2=0.0, ay_m_s2=ay, yaw_rate_rad_s=RATE, speed_m_s=speed)


def track(vy: np.ndarray) -> StateTrack:
    return make_track("e", MINUTE_STAMPS_NS, vx_m_s=SPEED, vy_m_s=vy, valid=np.ones(MINUTE_S.size, bool))


def d2(of: Signals, vy: np.ndarray) -> MetricRow:
    read = CalibratedSignals(of, LEANING)
    (row,) = evaluate_drive(EvaluatedDrive("drive", {"e": track(vy)}, None, of, {}, 3.0, read), ("d2",))
    return row


def driven(of: Signals, vy: np.ndarray) -> float:
    """Return the part of the consistency residual that correlates with the driving."""
    return driven_consistency(track(vy), CalibratedSignals(of, LEANING), 3.0)


def test_what_a_wrong_model_does_goes_with_the_driving_and_a_rough_road_does_not():
    wrong = VY + 0.02 * SPEED * RATE
    assert driven(signals(), VY) < 2e-3
    assert driven(signals(), wrong) == pytest.approx(d2(signals(), wrong).value, rel=0.02)
    road = replace(signals(), ay_m_s2=signals().ay_m_s2 + 0.3 * np.sin(2.3 * MINUTE_S))
    assert d2(road, VY).value > 0.1
    assert driven(road, VY) < 0.1 * d2(road, VY).value


def test_it_is_not_told_of_too_little_driving():
    short = CalibratedSignals(signals().rows(0, 900), LEANING)
    assert np.isnan(driven_consistency(track(VY).rows(0, 900), short, 3.0))
    assert np.isnan(driven(signals(), np.full(MINUTE_S.size, np.nan)))


def test_the_true_lateral_velocity_contradicts_nothing_once_the_sensors_are_known():
    row = d2(signals(), VY)
    assert (row.signal, row.metric, row.unit, row.segment) == ("vy_m_s", "d2", "m/s", "all")
    assert row.value < 2e-3
    assert row.n == MINUTE_S.size - 200 - 4  # two seconds before the first, and no speed behind the last sample


def test_it_is_the_change_of_the_error_over_two_seconds():
    error = 0.3 * np.sin(0.4 * MINUTE_S)
    change = error[200:] - error[:-200]
    found = d2(signals(), VY + error).value
    assert found == pytest.approx(float(np.sqrt(np.mean(change**2))), rel=0.01)
    assert d2(signals(), VY + 5.0).value < 2e-3  # a constant is not seen
