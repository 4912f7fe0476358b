"""Wrong signs and units contradict rigid-body kinematics; a right mapping and a quiet drive do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.drive.plausibility import plausibility_warnings
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, load_mapping, read_signals
from pdhef_logtool.records.signals import SIGNAL_UNITS, Channel

T0 = 1_700_000_000_000_000_000
MAPPINGS = Path(__file__).parents[1] / "reference" / "mappings"


def channel(name: str, time_s: np.ndarray, values: np.ndarray) -> Channel:
    stamps = T0 + np.rint(time_s * 1e9).astype(np.int64)
    return Channel(name, SIGNAL_UNITS[name], f"/t.{name}", stamps, stamps, np.asarray(values, dtype=np.float64))


def drive(
    seed: int = 0, duration_s: float = 60.0, calm: bool = False, wheel_radius_m: float = 0.3
) -> dict[str, Channel]:
    """A car on a winding road at changing speed, by kinematics alone; every sensor with noise of its own."""
    rng = np.random.default_rng(seed)

    def slow(t: np.ndarray, phases: np.ndarray) -> np.ndarray:
        return sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.07, 0.19, 0.31), phases, strict=True)) / 3.0

    steer_phase, speed_phase = rng.uniform(0, 6.28, 3), rng.uniform(0, 6.28, 3)
    lively = 0.0 if calm else 1.0

    def state(t: np.ndarray) -> tuple[np.ndarray, ...]:
        speed = 15.0 + lively * 6.0 * slow(t, speed_phase)
        steer = lively * 0.05 * slow(t, steer_phase)
        yaw_rate = speed * steer / (2.7 + 0.002 * speed**2)
        return steer, yaw_rate, speed

    imu_s = np.arange(0.0, duration_s, 0.01)
    can_s = np.arange(0.003, duration_s, 0.02)
    _, yaw_rate, speed = state(imu_s)
    can_steer, _, can_speed = state(can_s)

    def noisy(values: np.ndarray, std: float) -> np.ndarray:
        return values + std * rng.standard_normal(values.shape[0])

    channels = {
        "steer_rad": (can_s, noisy(can_steer, 0.0008)),
        "yaw_rate_rad_s": (imu_s, noisy(yaw_rate, 0.004)),
        "ay_m_s2": (imu_s, noisy(yaw_rate * speed, 0.5)),
        "ax_m_s2": (imu_s, noisy(np.gradient(speed, imu_s), 0.5)),
        "speed_m_s": (can_s, noisy(can_speed, 0.05)),
        "wheel_speed_rl_m_s": (can_s, noisy(can_speed, 0.1)),
        "wheel_speed_fr_rad_s": (can_s, noisy(can_speed / wheel_radius_m, 0.1)),
    }
    return {name: channel(name, t, v) for name, (t, v) in channels.items()}


MISTAKES = {
    "steer_rad": [-1.0, 180 / np.pi, np.pi / 180, -180 / np.pi],
    "yaw_rate_rad_s": [-1.0, 180 / np.pi, np.pi / 180, -180 / np.pi],
    "ay_m_s2": [-1.0, 1 / 9.81, 9.81],
    "ax_m_s2": [-1.0, 1 / 9.81, 9.81],
    "speed_m_s": [-1.0, 3.6, 1 / 3.6],
    "wheel_speed_rl_m_s": [-1.0, 3.6, 1 / 3.6, 1 / 0.3],
    "wheel_speed_fr_rad_s": [-1.0, 60 / (2 * np.pi), 0.3],
}
CASES = [(name, factor) for name, factors in MISTAKES.items() for factor in factors]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), calm=st.booleans())
def test_right_drives_raise_no_warning(seed: int, calm: bool) -> None:
    assert plausibility_warnings(drive(seed, calm=calm)) == ()


@pytest.mark.parametrize(("name", "factor"), CASES)
def test_every_mistake_is_found_and_its_signal_named(name: str, factor: float) -> None:
    channels = drive(3)
    wrong = replace(channels[name], values=channels[name].values * factor)
    warnings = plausibility_warnings({**channels, name: wrong})
    assert warnings
    for warning in warnings:
        assert name in warning.signals
        # A wheel speed in km/h looks like rad/s on a common wheel, but no other signal is suspected.
        assert warning.suspects == (name,)
        assert name in warning.message
        assert "\n" not in warning.message
    assert {w.kind for w in warnings} == {"sign" if factor == -1.0 else "unit"}


@pytest.mark.parametrize("name", ["steer_rad", "yaw_rate_rad_s", "ay_m_s2", "ax_m_s2"])
def test_a_quiet_drive_accuses_nobody(name: str) -> None:
    channels = drive(5, calm=True)
    for factor in MISTAKES[name]:
        wrong = replace(channels[name], values=channels[name].values * factor)
        assert plausibility_warnings({**channels, name: wrong}) == ()


def test_the_correlation_stands_in_the_message() -> None:
    channels = drive(1)
    wrong = replace(channels["ay_m_s2"], values=-channels["ay_m_s2"].values)
    (warning,) = plausibility_warnings({**channels, "ay_m_s2": wrong})
    assert warning.correlation < -0.9
    assert warning.gain == pytest.approx(-1.0, abs=0.1)
    assert f"correlation {warning.correlation:.2f}" in str(warning)


def test_a_swapped_axis_is_said_to_be_unrelated() -> None:
    channels = drive(2)
    rng = np.random.default_rng(1)
    time_s = np.arange(0.0, 60.0, 0.01)
    other = 3.0 * np.sin(2 * np.pi * 0.43 * time_s + 1.0) + rng.standard_normal(time_s.shape[0])
    warnings = plausibility_warnings({**channels, "ay_m_s2": channel("ay_m_s2", time_s, other)})
    assert [w.kind for w in warnings] == ["unrelated"]


def test_exchanged_steering_angles() -> None:
    channels = drive(4)
    as_wheel = replace(channels["steer_rad"], values=channels["steer_rad"].values * 16.0)
    (warning,) = plausibility_warnings({**channels, "steer_rad": as_wheel})
    assert "steering-wheel angle" in warning.message
    del channels["steer_rad"]
    right = replace(as_wheel, name="steering_wheel_rad")
    assert plausibility_warnings({**channels, "steering_wheel_rad": right}) == ()
    wrong = replace(right, values=right.values / 16.0)
    (warning,) = plausibility_warnings({**channels, "steering_wheel_rad": wrong})
    assert "road-wheel angle" in warning.message


def test_standing_or_short_or_missing_data_says_nothing() -> None:
    channels = drive(6)
    standing = {n: replace(c, values=0.0 * c.values) for n, c in channels.items()}
    assert plausibility_warnings(standing) == ()
    assert plausibility_warnings(drive(6, duration_s=8.0)) == ()
    assert plausibility_warnings({}) == ()
    empty = {n: replace(c, stamps_ns=c.stamps_ns[:0], values=c.values[:0]) for n, c in channels.items()}
    assert plausibility_warnings(empty) == ()
    assert plausibility_warnings({"speed_m_s": channels["speed_m_s"]}) == ()


def test_a_gap_and_an_absurd_stamp_do_no_harm() -> None:
    channels = drive(7, duration_s=120.0)
    for name, c in list(channels.items()):
        keep = (c.stamps_ns < T0 + 40_000_000_000) | (c.stamps_ns > T0 + 70_000_000_000)
        stamps = c.stamps_ns[keep]
        stamps[0] = 1_000_000_000  # 1970
        channels[name] = replace(c, stamps_ns=stamps, arrival_ns=stamps, values=c.values[keep])
    assert plausibility_warnings(channels) == ()
    wrong = replace(channels["yaw_rate_rad_s"], values=-channels["yaw_rate_rad_s"].values)
    assert {w.suspects for w in plausibility_warnings({**channels, "yaw_rate_rad_s": wrong})} == {("yaw_rate_rad_s",)}


# --------------------------------------------------------------------------------------------- real drives

DRIVES = [
    ("revs_250lm_a.mcap", "revs_250lm"),
    ("f1tenth_hoons_run2.bag", "f1tenth"),
    ("f1tenth_xray_run24.bag", "f1tenth"),
    ("comma2k19_segment.mcap", "comma2k19"),
    ("lunda_v40", "lunda_v40"),
]


def read_drive(shared_dir: Path, file: str, mapping_name: str) -> dict[str, Channel]:
    log = open_log(shared_dir / "data" / "drives" / file)
    mapping = load_mapping(MAPPINGS / f"{mapping_name}.toml")
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    signals = read_signals(log, mapping, clocks, log.start_ns, log.end_ns).signals
    log.close()
    return signals


@pytest.mark.parametrize(("file", "mapping_name"), DRIVES)
def test_recorded_drives_raise_no_false_warning(shared_dir: Path, file: str, mapping_name: str) -> None:
    assert plausibility_warnings(read_drive(shared_dir, file, mapping_name)) == ()


def test_every_mistake_is_found_on_a_recorded_drive(shared_dir: Path) -> None:
    channels = read_drive(shared_dir, "revs_250lm_a.mcap", "revs_250lm")
    for name, factor in CASES:
        if name in channels:
            wrong = replace(channels[name], values=channels[name].values * factor)
            suspects = {w.suspects for w in plausibility_warnings({**channels, name: wrong})}
            assert suspects == {(name,)}, (name, factor)


def test_the_instrument_with_its_yaw_rate_to_the_right(shared_dir: Path) -> None:
    channels = read_drive(shared_dir, "lunda_v40", "lunda_v40")
    wrong = replace(channels["yaw_rate_rad_s"], values=-channels["yaw_rate_rad_s"].values)
    warnings = plausibility_warnings({**channels, "yaw_rate_rad_s": wrong})
    assert {(w.kind, w.suspects) for w in warnings} == {("sign", ("yaw_rate_rad_s",))}


def test_weak_excitation_is_no_evidence(shared_dir: Path) -> None:
    channels = read_drive(shared_dir, "comma2k19_segment.mcap", "comma2k19")
    # A highway at 0.1 m/s² of lateral acceleration: its correlation with yaw rate × speed is 0.6.
    wrong = replace(channels["ay_m_s2"], values=-channels["ay_m_s2"].values)
    assert plausibility_warnings({**channels, "ay_m_s2": wrong}) == ()
