"""The watch for divergence: exact kinematics with and without an error of the estimate, and the wrong branch itself."""

import json
import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import make_signals

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, default_vehicle
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.estimators.divergence import watched_track
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.results.run_report import lines_of
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import rendered
from truthsim.drive import simulate_drive, write_drive

pytestmark = pytest.mark.slow

IMU_X_M, IMU_Y_M = 0.8, -0.3
VEHICLE = default_vehicle().model_copy(update={"imu_position_m": (IMU_X_M, IMU_Y_M, 0.0)})
TILT = 1.0 + GRAVITY_M_S2 * VEHICLE.roll_gradient_rad_per_m_s2
SPEED_M_S = 25.0
FRICTION = 0.85


def motion(
    share: float = 0.9, duration_s: float = 12.0, hz: float = 0.4, seed: int = 0, delay_ns: int = 10_000_000
) -> tuple[Signals, StateTrack]:
    """Return sensor signals and true state of a slalom up to a share of the grip, at irregular 100 Hz."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.008, 0.012, round(duration_s * 100))
    t = np.concatenate([[0.0], np.cumsum(np.round(dt * 1e9) * 1e-9)])
    w = 2.0 * math.pi * hz
    peak = share * FRICTION * GRAVITY_M_S2 / SPEED_M_S
    r, r_dot, r_dot2 = peak * np.sin(w * t), peak * w * np.cos(w * t), -peak * w * w * np.sin(w * t)
    vy, vy_dot = -0.8 * r_dot, -0.8 * r_dot2
    ay = vy_dot + SPEED_M_S * r
    speed, friction = np.full(len(t), SPEED_M_S), np.full(len(t), FRICTION)
    felt = TILT * ay + IMU_X_M * r_dot - IMU_Y_M * r * r
    signals = make_signals(dt, delay_ns, ay_m_s2=felt, yaw_rate_rad_s=r, speed_m_s=speed, friction=friction)
    covariance = np.tile(np.diag([0.01, 0.01, 1e-5]), (len(t), 1, 1))
    state = {"vx_m_s": speed, "vy_m_s": vy, "yaw_rate_rad_s": r, "covariance": covariance}
    track = make_track("f", signals.stamps_ns, **state)
    return signals, track


def off_by(track: StateTrack, degrees: float, from_s: float, to_s: float, rise_s: float = 0.3) -> StateTrack:
    """Return the track with its sideslip off by an angle between two times, up and down within ``rise_s``."""
    t = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    shape = np.clip((t - from_s) / rise_s, 0.0, 1.0) - np.clip((t - to_s) / rise_s, 0.0, 1.0)
    return replace(track, vy_m_s=track.vy_m_s + SPEED_M_S * math.tan(math.radians(degrees)) * shape)


def seconds(signals: Signals) -> np.ndarray:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def flags(track: StateTrack, signals: Signals) -> np.ndarray:
    return watched_track(track, signals, VEHICLE).diverged


@settings(deadline=None, max_examples=20)
@given(share=st.floats(0.0, 1.0), hz=st.floats(0.1, 1.5), seed=st.integers(0, 99))
def test_the_true_motion_is_never_flagged(share, hz, seed):
    signals, truth = motion(share, hz=hz, seed=seed)
    rng, stds = np.random.default_rng(seed), (VEHICLE.sensors.ay_std_m_s2, VEHICLE.sensors.yaw_rate_std_rad_s)
    ay, rate = (rng.normal(0.0, std, len(signals)) for std in stds)
    noisy = replace(signals, ay_m_s2=signals.ay_m_s2 + ay, yaw_rate_rad_s=signals.yaw_rate_rad_s + rate)
    assert not flags(truth, noisy).any()


@settings(deadline=None, max_examples=20)
@given(degrees=st.floats(8.0, 40.0), rise_s=st.floats(0.02, 1.0), sign=st.sampled_from([-1, 1]))
def test_an_error_is_flagged_while_it_grows_and_taken_back_with_it(degrees, rise_s, sign):
    signals, truth = motion()
    found, t = flags(off_by(truth, sign * degrees, 5.0, 7.0, rise_s), signals), seconds(signals)
    assert not found[t < 5.0].any()
    grown = 5.0 + rise_s
    assert found[(t > grown + 0.1) & (t < grown + 0.5)].all()
    # The leaky integrator forgets up to 1 − e^(−2/3) of the error. This part changes sign when the error ends.
    left = degrees * (1.0 - math.exp(-(2.0 + rise_s) / 3.0))
    assert left > 2.9 or not found[t > 7.0 + rise_s + 0.1].any()


def test_in_the_linear_range_bank_and_bias_are_no_divergence():
    signals, truth = motion(share=0.3)
    banked = replace(signals, ay_m_s2=signals.ay_m_s2 + 1.0)  # 10 % of bank
    assert not flags(truth, banked).any()


def test_bank_and_gain_near_the_limit_are_no_divergence():
    signals, truth = motion(duration_s=25.0, hz=0.02)
    banked = replace(signals, ay_m_s2=1.07 * signals.ay_m_s2 + GRAVITY_M_S2 * 0.04)
    assert not flags(truth, banked).any()


def test_noise_that_the_drive_shows_is_no_divergence():
    signals, truth = motion()
    noisy = replace(signals, ay_m_s2=signals.ay_m_s2 + np.random.default_rng(0).normal(0.0, 40.0, len(signals)))
    shown = FilterNoise(r_std={"ay_m_s2": 40.0})
    assert flags(truth, noisy).any() and not watched_track(truth, noisy, VEHICLE, shown).diverged.any()
    assert watched_track(off_by(truth, 40.0, 5.0, 7.0), noisy, VEHICLE, shown).diverged.any()


def test_what_comes_later_changes_no_flag():
    signals, truth = motion()
    wrong = off_by(truth, 20.0, 5.0, 7.0)
    whole = flags(wrong, signals)
    end = 600
    part = flags(wrong.rows(0, end), signals.rows(0, end))
    assert whole[:end].any()
    np.testing.assert_array_equal(part, whole[:end])


def test_the_watch_adds_to_what_an_estimator_says_itself_and_leaves_those_without_a_covariance():
    signals, truth = motion()
    own = np.zeros(len(signals), dtype=np.bool_)
    own[:10] = True
    wrong = off_by(truth, 20.0, 5.0, 7.0)
    np.testing.assert_array_equal(flags(replace(wrong, diverged=own), signals), own | flags(wrong, signals))
    plain = replace(wrong, covariance=np.empty((0, 3, 3)))
    assert watched_track(plain, signals, VEHICLE) is plain


def test_a_filter_on_the_wrong_branch_is_flagged_at_once_in_every_output(sample_logs_dir, tmp_path):
    """A growing sine on a slippery road: beyond the peak of the tyres, the true sideslip still moderate."""
    drive = simulate_drive(
        "sine-sweep", speed_km_h=100.0, friction=0.3, amplitude=1.08, seed=7302, keep_spins=True, tolerance=0.01
    )
    write_drive(drive, sweep := tmp_path / "sweep.mcap")
    names = ("phy-ukf", "physics", "zero")
    config = RunConfig(car=sample_logs_dir / "vehicle_mu03.toml", estimators=names, keep="estimates")
    result = run_logs([str(sweep)], tmp_path, config, report=False)
    folder = tmp_path / "logs" / "sweep"
    table = pl.read_parquet(folder / "estimates.parquet")
    true = table.filter(pl.col("estimator") == "truth").select("stamp_ns", true="sideslip_rad")
    report = json.loads((folder / "report.json").read_text())
    text = rendered(render_run, result, 160)
    for name in names[:2]:
        of = table.filter(pl.col("estimator") == name).join(true, on="stamp_ns").sort("stamp_ns")
        beta, truth = np.degrees(of["sideslip_rad"].to_numpy()), np.degrees(of["true"].to_numpy())
        t = (of["stamp_ns"].to_numpy() - of["stamp_ns"][0]) * 1e-9
        wrong = abs(beta - truth) > 8.0
        start = float(t[int(np.flatnonzero(wrong)[0])])
        # It is the wrong branch: within two seconds the estimate is far beyond the truth.
        soon = (t >= start) & (t <= start + 2.0)
        assert (abs(beta)[soon] > 2.5 * abs(truth)[soon]).any()
        assert abs(beta)[soon].max() > 25.0
        said = of["diverged"].to_numpy()
        assert not said[t < start - 1.0].any()
        first = float(t[int(np.flatnonzero(said)[0])])
        assert first < start + 0.1
        assert said[wrong].mean() > 0.7
        spans = [s for s in report["segments"] if s["name"] == f"{name} diverged"]
        assert (spans[0]["start_ns"] - int(of["stamp_ns"][0])) * 1e-9 == pytest.approx(first, abs=1e-6)
        (line,) = lines_of("diverged", report, name)
        assert line.startswith("diverged for ") and line in text
    assert not table.filter(pl.col("estimator") == "zero")["diverged"].any()
