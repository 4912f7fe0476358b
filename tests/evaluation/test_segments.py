"""Segments: a drive staged from known manoeuvres, mirror symmetry, gaps, and intervals that give the masks back."""

from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_car import make_signals, signals_at

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.alignment import align, plan_alignment
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES, RULES, find_manoeuvres, manoeuvre_masks
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S, operating_space
from pdhef_logtool.evaluation.reasons import LISTED_INTERVALS, Interval, reason_intervals, sensor_faults
from pdhef_logtool.evaluation.segments import SEGMENTS, driven_speed, find_intervals, moving_mask, segment_masks
from pdhef_logtool.evaluation.smoothing import RUN_GAP_S, smooth
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, load_mapping, read_signals
from pdhef_logtool.records.reasons import REASONS, SPIKE_AY, STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from truthsim.drive import simulate_drive
from truthsim.sensors import SensorNoise
from truthsim.vehicle_choice import choose_vehicle

T0 = 1_700_000_000_000_000_000
VEHICLE = default_vehicle()  # friction 0.85, blend 3 m/s


def staged():
    """0–10 stand, 10–15 accelerate, 15–25 straight, 25–30 left, 35–40 right, 45–51 slalom, 55–58 brake, to 65."""
    t = np.arange(0, 65, 0.01)
    speed = np.interp(t, [0, 10, 15, 55, 58, 65], [0, 0, 20, 20, 8, 8])
    ax = np.select([(t >= 10) & (t < 15), (t >= 55) & (t < 58)], [4.0, -4.0], 0.0)
    ay = np.select([(t >= 25) & (t < 30), (t >= 35) & (t < 40)], [3.0, -6.0], 0.0)
    ay = np.where((t >= 45) & (t < 51), 3.0 * np.sin(2 * np.pi * 0.5 * (t - 45)), ay)
    return t, speed, ax, ay


def signals(t, speed, ax, ay, noise=0.0, friction=np.nan):
    rng = np.random.default_rng(0)
    n = t.size
    measured = np.where(np.arange(n) % 5 == 0, speed, np.nan)  # a measurement every 50 ms
    rate = np.where(speed > 1, ay / np.maximum(speed, 1), 0.0)
    steer = ay * (2.87 / np.maximum(speed, 1.0) ** 2 + 0.003)
    columns = {"steer_rad": steer, "yaw_rate_rad_s": rate, "speed_m_s": measured, "friction": friction}
    columns |= {"ax_m_s2": ax + rng.normal(0, noise, n), "ay_m_s2": ay + rng.normal(0, noise, n)}
    return signals_at(T0 + np.round(t * 1e9).astype(np.int64), **columns)


def spans(masks, stamped, name):
    return [((s.start_ns - T0) * 1e-9, (s.end_ns - T0) * 1e-9) for s in find_intervals(stamped, {name: masks[name]})]


EXPECTED = {
    "standstill": [(0, 10)],
    "accelerating": [(10, 15)],
    "cornering-left": [(25, 30)],
    "cornering-right": [(35, 40)],
    "slalom": [(45, 51)],
    "braking": [(55, 58)],
    "straight": [(11, 25), (30, 35), (40, 45), (51, 65)],
}


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_staged_manoeuvres_are_found_where_they_are(noise):
    s = signals(*staged(), noise=noise)
    masks = segment_masks(s, None, VEHICLE)
    assert masks["all"].all()
    for name, expected in EXPECTED.items():
        found = spans(masks, s, name)
        assert len(found) == len(expected), (name, found)
        np.testing.assert_allclose(found, expected, atol=0.35, err_msg=name)


def test_grip_use_follows_friction():
    s = signals(*staged())
    t = (s.stamps_ns - T0) * 1e-9
    left, right = (t > 26) & (t < 29), (t > 36) & (t < 39)
    masks = segment_masks(s, None, VEHICLE)  # 3 m/s² is 0.36 of 0.85 g, 6 m/s² is 0.72 of it
    assert not masks["linear"][left].any()
    assert not masks["nonlinear"][left].any()
    assert masks["nonlinear"][right].all()
    slippery = segment_masks(signals(*staged(), friction=0.5), None, VEHICLE)  # 3 m/s² is 0.61 of 0.5 g
    assert slippery["nonlinear"][left].all()
    unknown = segment_masks(s, None, VEHICLE.model_copy(update={"friction": None}))  # 3 m/s² is 0.31 of g
    assert not unknown["linear"][left].any()
    assert not (masks["linear"] & masks["nonlinear"]).any()


def test_the_truth_is_preferred_and_its_gaps_are_in_no_segment():
    t, speed, ax, ay = staged()
    s = signals(t, speed, ax, 0 * ay)
    hole = (t > 27) & (t < 27.3)
    truth = make_track(
        "truth", s.stamps_ns, vx_m_s=speed, yaw_rate_rad_s=s.yaw_rate_rad_s, ay_m_s2=np.where(hole, np.nan, ay)
    )
    masks = segment_masks(s, truth, VEHICLE)
    assert not masks["straight"][(t > 26) & (t < 29)].any()
    for name in ("linear", "nonlinear", "cornering-left"):
        assert not masks[name][hole].any()
    assert masks["cornering-left"][(t > 25.3) & (t < 27)].all()


def test_a_gap_in_the_stamps_ends_an_interval_and_is_not_smoothed_across():
    t, speed, ax, ay = staged()
    keep = (t < 27) | (t > 28)
    s = signals(t[keep], speed[keep], ax[keep], ay[keep])
    found = spans(segment_masks(s, None, VEHICLE), s, "cornering-left")
    np.testing.assert_allclose(found, [(25, 27), (28, 30)], atol=0.1)
    step = np.where(t[keep] < 27.5, 0.0, 5.0)
    np.testing.assert_allclose(smooth(s.stamps_ns, step, 1.0), step, atol=1e-12)


def test_a_car_moves_in_reverse_too_and_may_move_where_its_speed_is_unknown():
    t, speed, ax, ay = staged()
    s = signals(t, speed, ax, ay)
    truth = make_track("truth", s.stamps_ns, vx_m_s=-speed)
    np.testing.assert_array_equal(driven_speed(s, truth), speed)
    assert moving_mask(s, truth, VEHICLE)[speed > 5.0].all()
    assert moving_mask(signals(t, np.nan * speed, ax, ay), None, VEHICLE).all()


def test_an_interval_ends_behind_its_last_stamp_and_a_car_at_rest_does_not_brake():
    t, speed, ax, ay = staged()
    s = signals(t, speed, np.where(t < 8, -4.0, ax), ay)
    masks = segment_masks(s, None, VEHICLE)
    (whole,) = find_intervals(s, {"all": masks["all"]})
    assert whole.end_ns == s.stamps_ns[-1] + 1
    assert not masks["braking"][t < 8].any()


STEP_NS = 10_000_000
START_NS = 1_700_000_000_000_000_123


def track_of(stamps_ns: np.ndarray, reason: np.ndarray) -> StateTrack:
    return make_track("pd-hef", stamps_ns, reason=reason)


def stamps(count: int) -> np.ndarray:
    return START_NS + STEP_NS * np.arange(count, dtype=np.int64)


def by_hand(stamps_ns: np.ndarray, reason: np.ndarray, bit: int) -> list[Interval]:
    """Split the stamps that have the bit where they are far apart."""
    marked = stamps_ns[reason & bit > 0]
    parts = np.split(marked, np.flatnonzero(np.diff(marked) > RUN_GAP_S * 1e9) + 1)
    return [Interval(int(part[0]), int(part[-1]) + 1) for part in parts if len(part)]


@pytest.mark.slow
@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 40), st.integers(0, 15)), min_size=1, max_size=60))
def test_intervals_are_those_found_by_hand(samples):
    # Steps of 20 to 800 ms, masks of the first four bits.
    steps, masks = zip(*samples, strict=True)
    stamps_ns = START_NS + np.cumsum(np.array(steps, dtype=np.int64)) * 20_000_000
    reason = np.array(masks, dtype=np.int64)
    track = track_of(stamps_ns, reason)
    expected = {r.name: by_hand(stamps_ns, reason, r.bit) for r in REASONS}
    assert reason_intervals(track) == {name: spans for name, spans in expected.items() if spans}


def test_faults_are_told_by_sensor_and_kind_with_the_longest_intervals():
    n = 40_000
    reason = np.zeros(n, dtype=np.int64)
    reason[np.arange(0, 35_000, 500)] |= SPIKE_AY  # 70 single ones
    reason[1_000:1_400] |= STUCK_YAW_RATE
    spike, stuck = sensor_faults(make_track("x", stamps(n), reason=reason)) or ()
    assert (spike["sensor"], spike["kind"], spike["count"]) == ("ay_m_s2", "spike", 70)
    assert len(spike["intervals"]) == LISTED_INTERVALS
    assert [i.start_ns for i in spike["intervals"]] == sorted(i.start_ns for i in spike["intervals"])
    assert (stuck["sensor"], stuck["kind"], stuck["count"]) == ("yaw_rate_rad_s", "stuck", 1)
    assert stuck["seconds"] == pytest.approx(3.99)
    assert sensor_faults(make_track("x", stamps(3))) is None
    assert sensor_faults(make_track("x", stamps(3), reason=np.zeros(3, dtype=np.int64))) == []


def steady_signals(speed: float, ay: float, seconds: float = 20.0) -> Signals:
    n = round(seconds * 100)
    columns = {"speed_m_s": np.full(n, speed), "ay_m_s2": np.full(n, ay)}
    return make_signals(np.full(n - 1, 0.01), **columns)


@pytest.mark.parametrize(("speed", "ay", "cell"), [(0.0, 0.5, (0, 0)), (27.0, -4.5, (5, 4)), (90.0, 30.0, (12, 12))])
def test_a_steady_drive_is_in_one_cell_for_as_long_as_it_lasts(speed, ay, cell):
    made = steady_signals(speed, ay)
    (found,) = operating_space(made, None, None, VEHICLE)["cells"]
    assert (found["speed"], found["ay"]) == cell
    assert found["seconds"] == pytest.approx(20.0)
    friction = np.repeat([0.3, 0.4, 0.9], [900, 200, 900])
    assert operating_space(replace(made, friction=friction), None, None, VEHICLE)["friction_median"] == 0.4
    assert found["scored"] == 0 and np.isnan(found["sideslip_mse_rad2"])


def test_cells_have_the_error_of_their_stamps():
    made = steady_signals(20.0, 0.2)
    n, at = len(made), np.arange(len(made))
    vx, ay = np.where(at < n // 2, 12.0, 33.0), np.where(at < n // 4, 0.5, 3.5)
    truth = make_track("truth", made.stamps_ns, vx_m_s=vx, vy_m_s=np.zeros(n), ay_m_s2=ay)
    off = np.where(at < n // 2, 0.01, 0.03)
    own = make_track("own", made.stamps_ns, vx_m_s=vx, vy_m_s=np.zeros(n), sideslip_rad=off)
    whole = operating_space(made, truth, own, VEHICLE)["cells"]
    error = {SPEED_EDGES_M_S[c["speed"]]: c["sideslip_mse_rad2"] for c in whole}
    assert error == {10.0: pytest.approx(1e-4), 30.0: pytest.approx(9e-4)}
    assert {AY_EDGES_M_S2[c["ay"]] for c in whole} >= {0.0, 3.0}
    assert sum(c["scored"] for c in whole) == n
    assert sum(c["seconds"] for c in whole) == pytest.approx(20.0)


def test_the_top_speed_is_that_of_the_drive_also_where_other_signals_are_unknown():
    made = steady_signals(20.0, 2.0)
    n, at = len(made), np.arange(len(made))
    columns = {"speed_m_s": np.where(at == n // 2, 41.0, 20.0), "ay_m_s2": np.where(at > n // 4, np.nan, 2.0)}
    some = Signals(**{**{f: getattr(made, f) for f in made.__slots__}, **columns})
    part = np.where(at < n // 4, 19.0, np.nan)  # ground truth of a part
    truth = make_track("truth", made.stamps_ns, vx_m_s=part, vy_m_s=0.0 * part, ay_m_s2=part / 10.0)
    for of in (None, truth):
        space = operating_space(some, of, None, VEHICLE)
        assert (space["speed_max_m_s"], space["ay_max_m_s2"]) == (41.0, pytest.approx(2.0, abs=0.11))


def test_a_gap_is_no_driving():
    made = steady_signals(10.0, 1.5, 4.0)
    stamps = made.stamps_ns + np.where(np.arange(len(made)) < 200, 0, 60_000_000_000)
    late = Signals(**{**{f: getattr(made, f) for f in made.__slots__}, "stamps_ns": stamps})
    assert sum(c["seconds"] for c in operating_space(late, None, None, VEHICLE)["cells"]) == pytest.approx(4.2, abs=0.1)


# ---- manoeuvres: each of the simulator is found, on both sides, at any rate and time; ordinary roads have few ----

#: Recognised manoeuvre of each manoeuvre of the simulator.
EXPECTED_MANOEUVRES = {
    **{name: name for name in ("dlc", "dlc-3888-2", "sine-sweep", "sine-with-dwell", "fishhook", "step-steer")},
    **{name: name for name in ("ramp-steer", "brake-in-turn", "power-off-in-turn", "steady-circle", "slalom")},
    "sine-sweep-wide": "sine-sweep",
    "mu-jump": "slalom",
}
RATES_HZ = st.sampled_from([40.0, 62.5, 100.0, 200.0])
NOISY = SensorNoise(
    acceleration_m_s2=0.25, yaw_rate_rad_s=0.008, steer_rad=0.0016, steer_bias_rad=0.004, yaw_rate_bias_rad_s=0.004
)


def steered(t, steer, speed, yaw_rate, ax, ay, start_ns=T0):
    stamps = start_ns + np.round(np.asarray(t) * 1e9).astype(np.int64)
    columns = {"ax_m_s2": ax, "ay_m_s2": ay, "yaw_rate_rad_s": yaw_rate, "speed_m_s": speed}
    return signals_at(stamps, steer_rad=steer, **columns)


def as_signals(drive):
    """Sensor values of a simulated drive, on the stamps of its IMU."""
    imu, steering, wheels = (drive.channels[c] for c in ("imu", "steering", "wheels"))
    t = imu.times_s
    speed = np.interp(t, wheels.times_s, 0.5 * (wheels.fields["rl_m_s"] + wheels.fields["rr_m_s"]))
    steer = np.interp(t, steering.times_s, steering.fields["steer_rad"])
    return steered(t, steer, speed, *(imu.fields[name] for name in ("yaw_rate_rad_s", "ax_m_s2", "ay_m_s2")))


@cache
def simulated(name, **changes):
    vehicle = changes.pop("vehicle_name", "sedan")
    drive = simulate_drive(name, vehicle=choose_vehicle(vehicle), vehicle_name=vehicle, tolerance=0.03, **changes)
    return as_signals(drive)


def mirrored(s):
    return replace(s, steer_rad=-s.steer_rad, ay_m_s2=-s.ay_m_s2, yaw_rate_rad_s=-s.yaw_rate_rad_s)


def names(s):
    return [m.name for m in find_manoeuvres(s, VEHICLE)]


def linear_car(t, steer, speed=22.0):
    """A car with a yaw rate that follows the steering with 0.1 s of delay."""
    lag = np.exp(-np.median(np.diff(t)) / 0.1)
    rate, rates = 0.0, []
    for wanted in steer * speed / (2.87 * (1.0 + speed**2 / 28.0**2)):
        rate = lag * rate + (1.0 - lag) * wanted
        rates.append(rate)
    rates = np.array(rates)
    return steered(t, steer, np.full(t.size, speed), rates, 0.0 * t, speed * rates)


@pytest.mark.parametrize("name", EXPECTED_MANOEUVRES)
def test_every_manoeuvre_of_the_simulator_is_found_on_both_sides(name):
    s = simulated(name)
    [found] = find_manoeuvres(s, VEHICLE)
    [other] = find_manoeuvres(mirrored(s), VEHICLE)
    assert found.name == EXPECTED_MANOEUVRES[name]
    assert other == replace(found, side=other.side, text=other.text) and other.side != found.side
    assert T0 + 500_000_000 <= found.start_ns < found.end_ns <= s.stamps_ns[-1] + 20_000_000
    # Smoothed to 3 Hz, so a little below the peak.
    assert found.peak_ay_m_s2 == pytest.approx(np.abs(s.ay_m_s2).max(), abs=1.0)
    assert found.speed_m_s == pytest.approx(np.nanmedian(s.speed_m_s[:100]), rel=0.06)


@pytest.mark.slow
def test_other_speeds_cars_friction_and_noise():
    missed = []
    for number, (name, expected) in enumerate(EXPECTED_MANOEUVRES.items()):
        usual = {"dlc": 90.0, "dlc-3888-2": 52.0, "slalom": 55.0}.get(name, 80.0)
        other = {"friction": 1.0, "speed_km_h": round(0.85 * usual), "vehicle_name": "hatchback", "noise": NOISY}
        if number % 2:
            other = {"friction": 0.6, "speed_km_h": usual, "vehicle_name": "sedan~3"}
        s = simulated(name, seed=number, **other)
        missed += [(name, names(s))] if names(s) != [expected] else []
    assert not missed


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(sorted(EXPECTED_MANOEUVRES)), st.integers(0, 10**12), RATES_HZ, st.booleans())
def test_neither_time_nor_rate_nor_side_changes_what_is_found(name, shift_ns, rate_hz, mirror):
    s = simulated(name)
    t = (s.stamps_ns - T0) * 1e-9
    to = np.arange(0.0, t[-1], 1.0 / rate_hz)
    columns = (np.interp(to, t, c) for c in (s.steer_rad, s.speed_m_s, s.yaw_rate_rad_s, s.ax_m_s2, s.ay_m_s2))
    other = steered(to, *columns, start_ns=T0 + shift_ns)
    [before] = find_manoeuvres(s, VEHICLE)
    [after] = find_manoeuvres(mirrored(other) if mirror else other, VEHICLE)
    assert after.name == before.name and (after.side != before.side) is mirror
    for end in ("start_ns", "end_ns"):
        # The first swing of a growing sine may be below the threshold at one rate and above it at another.
        limit_ns = 1_000_000_000 if before.name == "sine-sweep" else 250_000_000
        assert abs(getattr(after, end) - shift_ns - getattr(before, end)) < limit_ns


def test_the_manoeuvres_of_a_drive_are_told_apart():
    parts = [simulated(n) for n in ("dlc", "sine-with-dwell", "steady-circle")]
    columns = ("steer_rad", "speed_m_s", "yaw_rate_rad_s", "ax_m_s2", "ay_m_s2")
    joined = [np.concatenate([getattr(p, c) for p in parts]) for c in columns]
    s = steered(np.arange(len(joined[0])) * 0.01, *joined)
    whole = find_manoeuvres(s, VEHICLE)
    assert [m.name for m in whole] == ["dlc", "sine-with-dwell", "steady-circle"]
    masks = segment_masks(s, None, VEHICLE)
    assert set(MANOEUVRES) <= set(SEGMENTS)
    for name, mask in manoeuvre_masks(s.stamps_ns, whole).items():
        np.testing.assert_array_equal(masks[name], mask)
        assert mask.any() == (name in {m.name for m in whole})


@pytest.mark.parametrize(
    ("frequency_hz", "periods", "expected"),
    [(0.5, 1, "sine-steer"), (1.0, 1, "sine-steer"), (1.0, 6, "continuous-sine"), (0.4, 4, "slalom"), (0.2, 1, None)],
)
def test_sines_are_named_by_their_number_and_frequency(frequency_hz, periods, expected):
    t = np.arange(0.0, 16.0, 0.01)
    inside = (t >= 2.0) & (t < 2.0 + periods / frequency_hz)
    s = linear_car(t, np.where(inside, 0.03 * np.sin(2.0 * np.pi * frequency_hz * (t - 2.0)), 0.0))
    assert names(s) == ([] if expected is None else [expected])


def test_a_slow_step_is_none_and_a_log_without_steering_uses_the_path():
    t = np.arange(0.0, 8.0, 0.01)
    for rise_s, expected in ((0.15, ["step-steer"]), (1.0, [])):
        assert names(linear_car(t, 0.02 * np.clip((t - 2.0) / rise_s, 0.0, 1.0))) == expected
    slalom = simulated("slalom")
    blind = replace(slalom, steer_rad=np.full(len(slalom), np.nan))
    assert names(blind) == ["slalom"]


def test_nothing_is_found_without_speed_or_yaw_rate_nor_below_walking_pace():
    s = simulated("dlc")
    nan = np.full(len(s), np.nan)
    assert names(replace(s, speed_m_s=nan)) == names(replace(s, yaw_rate_rad_s=nan)) == []
    assert names(replace(s, speed_m_s=np.full(len(s), 0.9 * RULES.least_speed_m_s))) == []
    assert names(s.rows(0, 0)) == names(s.rows(0, 1)) == []


def test_roads_have_few_manoeuvres():
    found_s = 0.0
    for seed, speed_km_h in ((100, 130), (101, 90)):
        s = simulated("road", seed=seed, duration_s=90.0, friction=0.85, speed_km_h=speed_km_h)
        found_s += sum(m.end_ns - m.start_ns for m in find_manoeuvres(s, VEHICLE)) * 1e-9
    assert found_s <= 0.02 * 2 * 90.0


REFERENCE = Path(__file__).resolve().parents[1] / "reference"


@pytest.mark.parametrize(
    ("name", "mapping_name", "car", "expected"),
    [
        ("lunda_v40", "lunda_v40", "lunda_v40", ["sine-with-dwell"]),
        ("v40_slalom.mcap", "../../../studies/peers/v40_gnss", "lunda_v40", ["slalom"]),
        ("comma2k19_segment.mcap", "comma2k19", "comma2k19_rav4", []),
    ],
)
def test_recorded_manoeuvres_are_recognised(shared_dir, name, mapping_name, car, expected):
    vehicle = read_vehicle_file(REFERENCE / "vehicles" / f"{car}.toml").vehicle
    mapping = load_mapping(REFERENCE / "mappings" / f"{mapping_name}.toml")
    with closing(open_log(shared_dir / "data" / "drives" / name)) as log:
        clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
        channels = read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
    aligned, _ = align(channels.signals, plan_alignment(channels.signals, vehicle))
    assert [m.name for m in find_manoeuvres(aligned, vehicle)] == expected
