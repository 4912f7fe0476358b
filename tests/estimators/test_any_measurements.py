"""The filters take the measurements that there are: any of them may be missing for a while, or from the whole log."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import Car, estimate, read_drive, score
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator, runnable
from pdhef_logtool.model.drive_model import DriveModel, read_driving
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import RATIO, REAR_STIFFNESS
from pdhef_logtool.records.tracks import StateTrack

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
