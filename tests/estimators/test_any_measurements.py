"""The filters take the measurements that there are: any of them may be missing for a while, or from the whole log."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from reference_car import signals_at

from pdhef_logtool import Car, ReadOptions, estimate, read_drive, score
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, default_vehicle
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.gnss_aided import GnssAided
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import Options
from pdhef_logtool.estimators.table import make_estimator, runnable
from pdhef_logtool.model.drive_model import DriveModel, read_driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import RATIO, REAR_STIFFNESS
from pdhef_logtool.records.signals import GNSS_COMPONENTS, Signals
from pdhef_logtool.records.tracks import StateTrack
from studies import reference as study
from truthsim.batch import DriveSpec
from truthsim.drive import write_drive

NAMES = ("open-loop", "phy-ukf", "physics", "pd-hef")
STEERING = ("steer_rad", "steering_wheel_rad")
SALOON = Car.load("saloon")
GAP_S = (60.0, 80.0)


def without(*missing: str) -> object:
    """Return a function that removes signals from a mapping."""
    return lambda _log, mapping, _tell: replace(
        mapping, signals={k: v for k, v in mapping.signals.items() if k not in missing}
    )


def sideslip_rmse(log: Path, names: tuple[str, ...], *missing: str) -> dict[str, float]:
    """Return the RMSE by estimator of a log that lacks signals."""
    with read_drive(log, SALOON, adjust=without(*missing)) as drive:
        rows = score(estimate(drive, names)).filter(signal="sideslip_rad", segment="all", metric="rmse")
    return dict(zip(rows["estimator"], rows["value"], strict=True))


def test_physics_runs_on_what_there_is_and_what_there_is_helps(sample_logs_dir):
    whole = sideslip_rmse(sample_logs_dir / "dlc.mcap", NAMES)
    for missing in (("ay_m_s2",), ("yaw_rate_rad_s",), ("ay_m_s2", "yaw_rate_rad_s")):
        less = sideslip_rmse(sample_logs_dir / "dlc.mcap", NAMES, *missing)
        assert less.keys() == whole.keys() == set(NAMES)
        assert whole["physics"] < less["physics"] < 1.02 * less["open-loop"], missing


@pytest.mark.parametrize("also", [(), ("ay_m_s2",), ("ax_m_s2",)])
def test_without_steering_the_rear_axle_determines_the_sideslip(also, sample_logs_dir):
    less = sideslip_rmse(sample_logs_dir / "dlc.mcap", ("zero", "physics", "pd-hef"), *STEERING, *also)
    assert less["physics"] == less["pd-hef"] < 0.1 * less["zero"]


def test_speed_alone_is_not_enough():
    names = ("physics", "pd-hef", "pd-hef-smoothed")
    ready, skipped = runnable(names, SALOON, frozenset({"speed_m_s", "ax_m_s2"}))
    assert (ready, len(skipped)) == ([], 3)
    assert {s.reason for s in skipped} == {"the log has no ay_m_s2, steer_rad, yaw_rate_rad_s"}


@pytest.fixture(scope="module")
def road(sample_logs_dir):
    with read_drive(sample_logs_dir / "road.mcap", SALOON) as drive:
        return drive.whole()


def with_gap(road: WholeDrive, *names: str) -> tuple[WholeDrive, np.ndarray]:
    """Return two minutes of the road without some signals for 20 s, and where that is."""
    time_s = (road.signals.stamps_ns - road.signals.stamps_ns[0]) * 1e-9
    end = int(np.searchsorted(time_s, 120.0))
    gap = ((time_s > GAP_S[0]) & (time_s < GAP_S[1]))[:end]
    signals = road.signals.rows(0, end)
    for name in names:
        signals = replace(signals, **{name: np.where(gap, np.nan, getattr(signals, name))})
    return replace(road, signals=signals, truth=road.truth.rows(0, end)), gap


def physics_of(drive: WholeDrive) -> StateTrack:
    return run_estimator(make_estimator("physics", SALOON), calibrated_signals(drive.signals, SALOON))


@pytest.fixture(scope="module")
def whole(road):
    return physics_of(with_gap(road)[0])


@pytest.mark.parametrize("name", ["steer_rad", "ay_m_s2", "yaw_rate_rad_s", "ax_m_s2", "speed_m_s"])
def test_a_gap_of_20_s_widens_the_interval_that_covers(name, road, whole):
    drive, gap = with_gap(road, name)
    track = physics_of(drive)
    assert track.valid[10:].all()
    assert np.isfinite(track.sideslip_rad[10:]).all()
    scored = gap & drive.truth.valid & (drive.truth.vx_m_s > 3.0)
    error = (track.sideslip_rad - drive.truth.sideslip_rad)[scored]
    zero = drive.truth.sideslip_rad[scored]
    assert np.sqrt(np.mean(error**2)) <= 1.02 * np.sqrt(np.mean(zero**2))
    assert np.mean(np.abs(error) < 1.96 * track.sideslip_std_rad[scored]) >= 0.9
    assert np.median((track.sideslip_std_rad / whole.sideslip_std_rad)[gap]) >= 1.0 - 1e-9
    after = np.flatnonzero(gap)[-1] + 500
    np.testing.assert_allclose(track.sideslip_rad[after:], whole.sideslip_rad[after:], atol=2e-4)


def test_without_steering_a_y_and_yaw_rate_there_is_no_estimate(road):
    drive, gap = with_gap(road, "steer_rad", "yaw_rate_rad_s", "ay_m_s2")
    track, within = physics_of(drive), np.flatnonzero(gap)
    assert not track.valid[within[-1] - 500 : within[-1]].any()
    assert track.valid[within[-1] + 100 :].all()


def test_a_log_without_steering_keeps_the_prior_of_its_car(sample_logs_dir):
    car = Car(default_vehicle())
    with read_drive(sample_logs_dir / "dlc.mcap", car, adjust=without(*STEERING)) as drive:
        model = DriveModel.fit(drive)
        calibration = model.posterior
        assert calibration.text == "not calibrated: all parameters keep their prior"
        assert (calibration.parameters, calibration.refused) == ((), "")
        assert len(calibration.varied) == 6
        estimator = make_estimator("physics", model.car)
        assert estimator.causal  # it contains no data of the log


def test_without_a_y_the_yaw_rate_calibrates(sample_logs_dir):
    car, fits = Car(default_vehicle()), []
    for missing in ((), ("ay_m_s2",)):
        with read_drive(sample_logs_dir / "sweep.mcap", car, adjust=without(*missing)) as drive:
            driving = read_driving(drive)
        assert driving.has_ay is not bool(missing)
        fits.append({p.name: p for p in fit_car(driving, car.vehicle).parameters})
    for name in (RATIO, REAR_STIFFNESS):
        both, alone = (fit[name] for fit in fits)
        assert both.sd < alone.sd
        assert abs(np.log(both.value / alone.value)) < 1.96 * np.hypot(both.sd, alone.sd)


# ---- GNSS velocity in ``physics``: benefit on a simulated car, causality, and samples that the filter must ignore ----

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


# ---- Signals of a drive for the vehicle of its posterior: the friction that the car has reached ----

CALIBRATED = Car(default_vehicle(), self_calibrated=Posterior(default_vehicle()))
FILE = CALIBRATED.vehicle.assumed_friction
#: a_y of the bend over that at the peak forces of the file.
REACHED = 1.2


def bend(seconds: float = 3.0) -> Signals:
    """Return signals of straight driving with a bend beyond the friction of the file in the middle."""
    t = np.arange(0.0, 10.0, 0.01)
    gain = 1.0 + GRAVITY_M_S2 * CALIBRATED.vehicle.roll_gradient_rad_per_m_s2
    ay = REACHED * gain * CALIBRATED.vehicle.most_ay_m_s2(FILE) * (np.abs(t - 5.0) < 0.5 * seconds)
    return signals_at((t * 1e9).astype(np.int64), speed_m_s=np.full(t.size, 20.0), ay_m_s2=-ay)


def test_the_friction_is_at_least_the_reached_one_and_does_not_anticipate():
    signals = bend()
    friction = calibrated_signals(signals, CALIBRATED).friction
    assert (friction[:350] == FILE).all() and (np.diff(friction) >= 0.0).all()
    np.testing.assert_allclose(friction[-1], REACHED * FILE, rtol=1e-3)
    earlier = calibrated_signals(signals.rows(0, 400), CALIBRATED).friction
    np.testing.assert_array_equal(earlier, friction[:400])


def test_jolts_and_a_friction_of_the_log_do_not_raise_it():
    assert (calibrated_signals(bend(0.02), CALIBRATED).friction == FILE).all()
    given = replace(bend(), friction=np.full(1000, 0.3))
    assert (calibrated_signals(given, CALIBRATED).friction == 0.3).all()
    assert np.isnan(calibrated_signals(bend(), Car(CALIBRATED.vehicle)).friction).all()
