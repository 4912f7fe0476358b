"""Manoeuvres: every one of the simulator is found, on both sides, at any rate and time; ordinary roads have few."""

from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import signals_at

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.alignment import align, plan_alignment
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES, RULES, find_manoeuvres, manoeuvre_masks
from pdhef_logtool.evaluation.segments import SEGMENTS, segment_masks
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, load_mapping, read_signals
from truthsim.drive import simulate_drive
from truthsim.sensors import SensorNoise
from truthsim.vehicle_choice import choose_vehicle

T0 = 1_700_000_000_000_000_000
VEHICLE = default_vehicle()
#: Recognised manoeuvre of each manoeuvre of the simulator.
EXPECTED = {
    **{name: name for name in ("dlc", "dlc-3888-2", "sine-sweep", "sine-with-dwell", "fishhook", "step-steer")},
    **{name: name for name in ("ramp-steer", "brake-in-turn", "power-off-in-turn", "steady-circle", "slalom")},
    "sine-sweep-wide": "sine-sweep",
    "mu-jump": "slalom",
}
RATES_HZ = st.sampled_from([40.0, 62.5, 100.0, 200.0])
NOISY = SensorNoise(
    acceleration_m_s2=0.25, yaw_rate_rad_s=0.008, steer_rad=0.0016, steer_bias_rad=0.004, yaw_rate_bias_rad_s=0.004
)


def signals(t, steer, speed, yaw_rate, ax, ay, start_ns=T0):
    stamps = start_ns + np.round(np.asarray(t) * 1e9).astype(np.int64)
    columns = {"ax_m_s2": ax, "ay_m_s2": ay, "yaw_rate_rad_s": yaw_rate, "speed_m_s": speed}
    return signals_at(stamps, steer_rad=steer, **columns)


def as_signals(drive):
    """Sensor values of a simulated drive, on the stamps of its IMU."""
    imu, steering, wheels = (drive.channels[c] for c in ("imu", "steering", "wheels"))
    t = imu.times_s
    speed = np.interp(t, wheels.times_s, 0.5 * (wheels.fields["rl_m_s"] + wheels.fields["rr_m_s"]))
    steer = np.interp(t, steering.times_s, steering.fields["steer_rad"])
    return signals(t, steer, speed, *(imu.fields[name] for name in ("yaw_rate_rad_s", "ax_m_s2", "ay_m_s2")))


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
    return signals(t, steer, np.full(t.size, speed), rates, 0.0 * t, speed * rates)


@pytest.mark.parametrize("name", EXPECTED)
def test_every_manoeuvre_of_the_simulator_is_found_on_both_sides(name):
    s = simulated(name)
    [found] = find_manoeuvres(s, VEHICLE)
    [other] = find_manoeuvres(mirrored(s), VEHICLE)
    assert found.name == EXPECTED[name]
    assert other == replace(found, side=other.side, text=other.text) and other.side != found.side
    assert T0 + 500_000_000 <= found.start_ns < found.end_ns <= s.stamps_ns[-1] + 20_000_000
    # Smoothed to 3 Hz, so a little below the peak.
    assert found.peak_ay_m_s2 == pytest.approx(np.abs(s.ay_m_s2).max(), abs=1.0)
    assert found.speed_m_s == pytest.approx(np.nanmedian(s.speed_m_s[:100]), rel=0.06)


@pytest.mark.slow
def test_other_speeds_cars_friction_and_noise():
    missed = []
    for number, (name, expected) in enumerate(EXPECTED.items()):
        usual = {"dlc": 90.0, "dlc-3888-2": 52.0, "slalom": 55.0}.get(name, 80.0)
        other = {"friction": 1.0, "speed_km_h": round(0.85 * usual), "vehicle_name": "hatchback", "noise": NOISY}
        if number % 2:
            other = {"friction": 0.6, "speed_km_h": usual, "vehicle_name": "sedan~3"}
        s = simulated(name, seed=number, **other)
        missed += [(name, names(s))] if names(s) != [expected] else []
    assert not missed


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(sorted(EXPECTED)), st.integers(0, 10**12), RATES_HZ, st.booleans())
def test_neither_time_nor_rate_nor_side_changes_what_is_found(name, shift_ns, rate_hz, mirror):
    s = simulated(name)
    t = (s.stamps_ns - T0) * 1e-9
    to = np.arange(0.0, t[-1], 1.0 / rate_hz)
    columns = (np.interp(to, t, c) for c in (s.steer_rad, s.speed_m_s, s.yaw_rate_rad_s, s.ax_m_s2, s.ay_m_s2))
    other = signals(to, *columns, start_ns=T0 + shift_ns)
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
    s = signals(np.arange(len(joined[0])) * 0.01, *joined)
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
