"""GNSS velocity in ``physics``: benefit on a simulated car, causality, and samples that the filter must ignore."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool import Car, ReadOptions, read_drive
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.gnss_aided import GnssAided
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import Options
from pdhef_logtool.estimators.table import make_estimator, runnable
from pdhef_logtool.records.signals import GNSS_COMPONENTS, Signals
from studies import reference as study
from truthsim.batch import DriveSpec
from truthsim.drive import write_drive

AVAILABLE = frozenset({"steer_rad", "speed_m_s", "ay_m_s2", "yaw_rate_rad_s"})


CAR = study.ROOT / "sample_logs" / "vehicle.toml"
#: A receiver's velocity arrives so late.
LATE_S = 0.06
DRIVES = {
    "fishhook": study.SIMULATED["fishhook, 70 km/h"],
    "low grip": DriveSpec("fishhook", 55.0, 0.5, 13, 14.0),
    "road": replace(study.SIMULATED["road, 20 s"], duration_s=45.0),
}


@dataclass(frozen=True)
class GnssDrive:
    """Signals without and with GNSS velocity, and the true velocity [N] at their stamps."""

    signals: Signals
    aided: Signals
    vx_m_s: np.ndarray
    vy_m_s: np.ndarray


@cache
def gnss_drive(name: str) -> GnssDrive:
    """Simulate a drive, read its log with the vehicle file of the car, and add the velocity of a receiver."""
    drive = DRIVES[name].simulate()
    with TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_drive(drive, log)
        with read_drive(log, Car.load(CAR), None, ReadOptions(waived=study.SPIN_CHECKS)) as opened:
            signals = opened.whole().signals
    t = (signals.stamps_ns - drive.start_ns) * 1e-9
    names = ("vx_m_s", "vy_m_s", "yaw_rad", "roll_rate_rad_s")
    motion = study.Motion(signals.stamps_ns, *(np.interp(t, drive.times_s, drive.truth[name]) for name in names))
    stamps_ns, made = study.made_gnss(motion, study.RECEIVERS[study.MADE], "")
    velocity = np.full((len(t), 2), np.nan)
    velocity[np.minimum(np.searchsorted(signals.stamps_ns, stamps_ns), len(t) - 1)] = made
    late_s = np.where(np.isfinite(velocity[:, 0]), LATE_S, np.nan)
    aided = replace(signals, gnss_velocity_m_s=velocity, gnss_late_s=late_s)
    return GnssDrive(signals, aided, motion.vx_m_s, motion.vy_m_s)


@pytest.fixture(scope="module")
def bare():
    return Car(Car.load(CAR).vehicle)


def _aided(car):
    estimator = make_estimator("physics", car, Options(gnss=True))
    assert isinstance(estimator, GnssAided)
    return estimator


def _error_deg(drive, track):
    beta = np.arctan2(drive.vy_m_s, drive.vx_m_s)
    used = (drive.vx_m_s > 3.0) & track.valid
    error = np.degrees(np.angle(np.exp(1j * (track.sideslip_rad - beta))))[used]
    return float(np.sqrt(np.mean(error**2))), float(
        np.mean(np.abs(error) < 1.96 * np.degrees(track.sideslip_std_rad[used]))
    )


def test_gnss_corrects_a_limit_manoeuvre_of_a_car_with_wrong_tyres(bare):
    drive = gnss_drive("low grip")
    causality = CausalityCheck()
    plain, _ = _error_deg(drive, run_estimator(make_estimator("physics", bare), drive.aided))
    aided, coverage = _error_deg(drive, run_estimator(_aided(bare), drive.aided, causality=causality))
    assert not causality.failed
    assert plain > 0.8
    assert aided < 0.6 * plain
    assert coverage > 0.7


@settings(max_examples=8, deadline=None)
@given(share=st.floats(0.1, 0.8), late_s=st.floats(0.0, 0.4))
def test_a_sample_acts_when_it_arrives_and_not_before(bare, share, late_s):
    signals = gnss_drive("low grip").aided
    signals = replace(signals, gnss_late_s=np.full(len(signals), late_s))
    estimator = _aided(bare)
    one, _ = estimator.run(signals, None)
    acts = np.flatnonzero(one.aid[:, 1] < 1.0)
    sampled = np.flatnonzero(np.isfinite(signals.gnss_velocity_m_s[:, 0]))
    k = sampled[np.searchsorted(sampled, acts[int(share * len(acts))] - round(late_s * 100.0))]
    other = signals.gnss_velocity_m_s.copy()
    other[k] += 0.05
    two, _ = estimator.run(replace(signals, gnss_velocity_m_s=other), None)
    differs = np.flatnonzero((one.aid != two.aid).any(axis=1))
    assert signals.ready_ns[differs[0]] >= signals.stamps_ns[k] + round(late_s * 1e9)
    assert signals.ready_ns[differs[0]] - signals.stamps_ns[k] < round((late_s + 0.3) * 1e9)


def test_without_a_sample_the_estimate_is_that_of_the_filter_bit_for_bit(bare):
    signals = gnss_drive("fishhook").signals
    plain = run_estimator(make_estimator("physics", bare), signals)
    aided = run_estimator(_aided(bare), signals)
    np.testing.assert_array_equal(aided.vy_m_s, plain.vy_m_s)
    np.testing.assert_array_equal(aided.covariance, plain.covariance)


#: Wrong velocities [N, 2] of a receiver, from the time and the right ones.
FAULTS = {
    "multipath": lambda t, v: v + 0.35 * ((t > 20.0) & (t < 25.0))[:, None],
    "swapped": lambda _, v: v[:, ::-1].copy(),
    "outage": lambda t, v: np.where(t[:, None] > 15.0, np.nan, v),
    "wild": lambda t, v: v + 5.0 * (np.random.default_rng(1).random(len(t)) < 0.2)[:, None],
    "slow clock": lambda _, v: v,
    "lag": lambda _, v: np.roll(v, 20, axis=0),
    "noise": lambda _, v: v + 0.4 * np.random.default_rng(2).standard_normal(v.shape),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("driven", ["road", "fishhook"])
def test_wrong_gnss_costs_nothing(bare, driven, fault):
    drive = gnss_drive(driven)
    signals, t = drive.aided, (drive.aided.stamps_ns - drive.aided.stamps_ns[0]) * 1e-9
    velocity = FAULTS[fault](t, signals.gnss_velocity_m_s)
    if fault == "slow clock":
        signals = replace(signals, gnss_late_s=np.full(len(t), 3.0))
    plain, _ = _error_deg(drive, run_estimator(make_estimator("physics", bare), signals))
    aided, _ = _error_deg(drive, run_estimator(_aided(bare), replace(signals, gnss_velocity_m_s=velocity)))
    assert aided < plain + max(0.05 * plain, 0.003)


def test_identity_is_another_one_only_where_gnss_acts(bare):
    plain = resolve(make_estimator("physics", bare))
    (off,), _ = runnable(("physics",), bare, AVAILABLE | GNSS_COMPONENTS, Options())
    (without,), _ = runnable(("physics",), bare, AVAILABLE, Options(gnss=True))
    (aided,), _ = runnable(("physics",), bare, AVAILABLE | GNSS_COMPONENTS, Options(gnss=True))
    (smoothed,), _ = runnable(("pd-hef-smoothed",), bare, AVAILABLE | GNSS_COMPONENTS, Options(gnss=True))
    assert resolve(off) == resolve(without) == plain
    assert resolve(aided).algorithm == "gnss-aided"
    assert resolve(aided).options["estimator"] == plain.algorithm
    assert resolve(smoothed).algorithm != "gnss-aided"
