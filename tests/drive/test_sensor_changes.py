"""A sensor that changes in mid-drive is named with time and size, corrected, and costs the interval its certainty."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdhef_logtool import Car, read_drive
from pdhef_logtool.drive.sensor_changes import SensorChange, find_changes
from pdhef_logtool.drive.truth_steps import steps_from_truth
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.mapping import MappedChannels
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.runs.estimating import estimate_drive
from studies.peers.drives import PEER_DRIVES, mapping_of, vehicle_of
from tests.command_line import called
from tests.drive.test_checks import checked, survey, verdicts
from tests.run_report import follows

AT_S = 40.0
#: Sensor, gain and jump; NaN for a value that is stuck.
CHANGES = [
    ("yaw_rate_rad_s", 1.0, 0.05), ("yaw_rate_rad_s", 1.0, -0.05), ("yaw_rate_rad_s", 1.0, np.radians(2.0)),
    ("ay_m_s2", 1.0, 1.0), ("ay_m_s2", 1.0, -1.0), ("speed_m_s", 0.95, 0.0), ("speed_m_s", 1.05, 0.0),
    ("steer_rad", 1.0, np.nan), ("steer_rad", 1.0, np.radians(1.0)), ("steer_rad", 1.0, np.radians(10.0 / 16.0)),
]  # fmt: skip


@pytest.fixture(scope="module")
def road_and_truth(sample_logs_dir):
    """Return 80 s of a simulated country road with its ground truth [8000]."""
    with read_drive(sample_logs_dir / "road.mcap", sample_logs_dir / "vehicle.toml") as drive:
        whole = drive.whole()
    return whole.signals.rows(8000, 16000), whole.truth.rows(8000, 16000)


@pytest.fixture(scope="module")
def road(road_and_truth):
    return road_and_truth[0]


def seconds(signals: Signals) -> Any:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def changed(signals: Signals, name: str, jump: float, gain: float = 1.0) -> Signals:
    """Return signals with a jump or another gain of one sensor, or with its value stuck where the jump is NaN."""
    column, late = getattr(signals, name), seconds(signals) >= AT_S
    other = column[np.flatnonzero(late)[0]] if np.isnan(jump) else gain * column + jump
    return replace(signals, **{name: np.where(late & np.isfinite(column), other, column)})


def only(signals: Signals) -> tuple[Signals, SensorChange]:
    sound, (change,) = find_changes(signals)
    return sound, change


@pytest.mark.parametrize(("name", "gain", "jump"), CHANGES)
def test_a_change_is_named_within_2_s_and_corrected(road, name, gain, jump):
    signals = changed(road, name, jump, gain)
    sound, change = only(signals)
    stuck, size = np.isnan(jump), gain - 1.0 if gain != 1.0 else jump
    assert (change.sensor, change.kind) == (name, "stuck" if stuck else "gain" if gain != 1.0 else "jump")
    start_s, decided_s = ((t - road.stamps_ns[0]) * 1e-9 for t in (change.start_ns, change.known_ns))
    assert start_s == pytest.approx(AT_S, abs=0.15 if abs(jump) >= 0.05 or stuck else 2.0)
    assert decided_s < AT_S + 2.0
    assert stuck or abs(change.size - size) < max(3.0 * change.std, 0.1 * abs(size))
    after = seconds(road) > AT_S + 2.0
    error, planted = (np.nanmean((getattr(s, name) - getattr(road, name))[after] ** 2) for s in (sound, signals))
    assert error < (0.004**2 if stuck else 0.2 * planted)


@pytest.mark.parametrize(("name", "size", "rise_s"), [("steer_rad", np.radians(2.0), 0.6), ("ay_m_s2", 1.2, 1.5)])
def test_a_slide_and_a_bank_that_begin_slowly_are_no_jump(road, name, size, rise_s):
    """A slide moves the steering relation as an offset of the steering does, but not from one sample to the next."""
    ramp = size * np.clip((seconds(road) - AT_S) / rise_s, 0.0, 1.0)
    assert find_changes(replace(road, **{name: getattr(road, name) + ramp}))[1] == ()


@pytest.mark.parametrize(("name", "jump"), [("yaw_rate_rad_s", 0.05), ("ay_m_s2", 1.0), ("steer_rad", np.nan)])
def test_a_correction_uses_earlier_samples_alone(road, name, jump):
    signals = changed(road, name, jump)
    whole, change = only(signals)
    for after_s in (-1.0, 0.05, 3.0):
        count = int(np.searchsorted(signals.stamps_ns, change.known_ns + round(after_s * 1e9)))
        part, _ = find_changes(signals.rows(0, count))
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:count])


def test_a_sound_drive_stays_as_it_is(road):
    assert find_changes(road)[0] is road
    assert find_changes(road.rows(0, 1))[1] == ()


def test_a_coarse_speed_after_acceleration_is_not_stuck(road):
    """Speeds in km/h repeat for seconds while the car cruises; the acceleration before is no grade."""
    cruises = np.clip(seconds(road) - 20.0, 0.0, 6.0)
    speed, slope_m_s2 = (
        np.round(3.6 * (14.0 + 2.0 * cruises)) / 3.6,
        np.where((cruises > 0.0) & (cruises < 6.0), 2.0, 0.0),
    )
    quiet = replace(road, speed_m_s=speed, ax_m_s2=slope_m_s2 + 0.3)
    assert [c for c in find_changes(quiet)[1] if c.kind == "stuck"] == []


def test_stuck_readings_that_move_again_are_no_jump(sample_logs_dir):
    with read_drive(sample_logs_dir / "faults.mcap", sample_logs_dir / "vehicle.toml") as drive:
        assert drive.recorded().changes == ()


@pytest.mark.parametrize(
    ("log", "name", "factor", "addend"),
    [
        ("road", "yaw_rate_rad_s", 1.0, 0.01),
        ("road", "yaw_rate_rad_s", 1.1, 0.0),
        ("dlc", "ay_m_s2", 1.0, -0.8),
        ("road", "speed_m_s", 0.95, 0.0),
    ],
)
def test_ground_truth_shows_smaller_steps(sample_logs_dir, log, name, factor, addend):
    with read_drive(sample_logs_dir / f"{log}.mcap", sample_logs_dir / "vehicle.toml") as drive:
        sound, truth = drive.whole().signals, drive.whole().truth
    assert truth is not None
    at_s = 0.5 * seconds(sound)[-1]
    late = seconds(sound) >= at_s
    signals = replace(sound, **{name: getattr(sound, name) * np.where(late, factor, 1.0) + late * addend})
    assert steps_from_truth(sound, truth) == ()
    (step,) = steps_from_truth(signals, truth)
    expected = addend if addend else factor - 1.0
    assert (step.sensor, step.kind) == (name, f"{'jump' if addend else 'gain'}_from_truth")
    assert (step.start_ns - sound.stamps_ns[0]) * 1e-9 == pytest.approx(at_s, abs=2.5)
    assert step.size == pytest.approx(expected, rel=0.1)


def test_ground_truth_shows_a_gyro_that_becomes_late(road_and_truth):
    road, truth = road_and_truth
    gyro, late = road.yaw_rate_rad_s, seconds(road) >= AT_S
    (step,) = steps_from_truth(replace(road, yaw_rate_rad_s=np.where(late, np.roll(gyro, 10), gyro)), truth)
    assert (step.sensor, step.kind) == ("yaw_rate_rad_s", "delay_from_truth")
    assert step.size == pytest.approx(0.1, abs=0.01)


def test_a_bank_is_no_step_from_the_ground_truth(road_and_truth):
    road, truth = road_and_truth
    ramp = np.clip((seconds(road) - AT_S) / 2.0, 0.0, 1.0)
    assert steps_from_truth(replace(road, ay_m_s2=road.ay_m_s2 + 1.2 * ramp), truth) == ()
    assert steps_from_truth(road.rows(0, 1), truth.rows(0, 1)) == ()


def test_a_waived_sensor_is_not_changed(road):
    signals = changed(road, "ay_m_s2", 1.0)
    assert find_changes(signals, ["ay_m_s2"])[0] is signals


def test_a_recorded_steering_that_freezes_is_named(shared_dir):
    """The steering repeats one value for the last 2 s, while the car comes out of a bend at 17 m/s."""
    (drive,) = (d for d in PEER_DRIVES if d.log == "stanford_wet_1.mcap")
    folder = shared_dir / "data" / "drives"
    car = Car(vehicle_of(drive))
    with read_drive(folder / drive.log, car, mapping_of(drive)) as opened:
        (change,) = opened.whole().changes
    assert (change.sensor, change.kind) == ("steer_rad", "stuck")
    assert change.end_ns - change.start_ns == pytest.approx(1.98e9, abs=0.1e9)


def test_the_interval_is_wider_from_a_correction_on(sample_logs_dir):
    car = Car.load(sample_logs_dir / "vehicle.toml")
    with read_drive(sample_logs_dir / "sweep.mcap", car) as drive:
        sound = drive.whole()
    middle_ns = int(sound.signals.stamps_ns[600])
    change = SensorChange(
        "yaw_rate_rad_s", "jump", middle_ns, middle_ns, int(sound.signals.stamps_ns[-1]) + 1, 0.05, 0.01
    )
    changed = replace(sound, changes=(change,))
    physics = make_estimator("physics", car)
    before, after = (
        estimate_drive(d, DriveSignals.of(d.signals, car), [physics]).tracks["physics"] for d in (sound, changed)
    )
    np.testing.assert_array_equal(after.vy_m_s, before.vy_m_s)
    np.testing.assert_array_equal(after.sideslip_std_rad[:600], before.sideslip_std_rad[:600])
    assert np.nanmean((after.sideslip_std_rad / before.sideslip_std_rad)[700:]) > 1.02


@pytest.mark.slow
def test_a_run_names_the_change(tmp_path):
    log, out = tmp_path / "road.mcap", tmp_path / "out"
    fault = ("--fault", "bias0.05:yaw_rate:12:end")
    assert called("simulate", "road", "--duration", 25, "--seed", 3, *fault, "-o", log).returncode == 0
    ran = called("run", log, "-o", out, "-e", "physics", "--model", "off")
    assert ran.returncode == 3, ran.stderr
    assert "yaw_rate_rad_s.change: its bias jumps by 0.05" in ran.stdout
    report = json.loads((out / "logs" / "road" / "report.json").read_text())
    follows(report)
    assert [(f["sensor"], f["kind"]) for f in report["faults"]] == [("yaw_rate_rad_s", "jump")]
    assert "yaw_rate_rad_s.change" in (out / "logs" / "road" / "report.html").read_text()


@pytest.fixture(scope="module")
def sweep(sample_logs_dir):
    return survey(sample_logs_dir / "sweep.mcap")


def spoilt(found: MappedChannels, name: str, kind: str, share: tuple[float, float]) -> MappedChannels:
    """Return the log with a channel dead, stuck or noisy from one share of its samples to another."""
    channel = found.signals[name]
    values, n = channel.values.copy(), len(channel)
    part = slice(int(share[0] * n), int(share[1] * n))
    if kind == "dead":
        values[part] = 0.0
    elif kind == "stuck":
        values[part] = values[part.start]
    else:
        values[part] += 3.0 * np.random.default_rng(1).standard_normal(values[part].shape[0])
    return replace(found, signals={**found.signals, name: replace(channel, values=values)})


@pytest.mark.parametrize("kind", ["dead", "stuck", "noise"])
def test_a_sensor_that_fails_for_a_while_fails_nothing_else(sweep, kind):
    name = "ay_m_s2" if kind == "noise" else "yaw_rate_rad_s"
    for found in (sweep, spoilt(sweep, name, kind, (0.4, 0.7))):
        assert verdicts(checked(found), "failed") == set()
    most = verdicts(checked(spoilt(sweep, name, kind, (0.2, 0.9))), "failed")
    assert kind == "noise" or most == {"yaw_rate_rad_s.gain"}


def test_a_wheel_that_reads_0_in_a_bend_makes_no_unit_wrong(tmp_path, sample_logs_dir):
    """The rear wheels slip when the car brakes to a stop: their difference is no yaw rate any more."""
    path = tmp_path / "brake.mcap"
    words = "brake-in-turn --speed 90.46174692977121 --mu 0.9838833092370343 --seed 484091166 --duration 12.5 "
    words += "--amplitude 1.0865356241287265 --fault dead:wheel_fl:2.40:4.98"
    assert called("simulate", *words.split(), "-o", path).returncode == 0
    with read_drive(path, sample_logs_dir / "vehicle.toml") as opened:
        assert [c.name for c in opened.checks if c.verdict == "failed"] == []
        passed = {c.name for c in opened.checks if c.verdict == "passed"}
    assert {f"wheel_speed_{w}_m_s.unit" for w in ("fl", "fr", "rl", "rr")} <= passed


DRIVES = {
    "a path along one axis shows no frame":
        "sine-sweep --speed 54.13 --mu 0.825 --seed 1267727376 --duration 25 --amplitude 0.5055 --vehicle "
        "sedan~97894498",
    "the crossfall of a straight road decides no sign":
        "road --speed 46.71 --mu 0.689 --seed 8192170 --duration 25 --vehicle sedan~176164575",
    "noise across the path shows no scale":
        "road --speed 59.04 --mu 0.935 --seed 528562405 --duration 12.5 --vehicle sedan~1192796631",
    "a curvature that is noise decides no sign of a sideslip":
        "ramp-steer --speed 81.81 --mu 0.426 --seed 1068668474 --duration 12.5 --amplitude 0.2748",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("drive", DRIVES)
def test_nothing_is_wrong_with_a_sound_drive(drive, tmp_path, sample_logs_dir):
    log = tmp_path / "drive.mcap"
    assert called("simulate", *DRIVES[drive].split(), "-o", log).returncode == 0
    with read_drive(log, sample_logs_dir / "vehicle.toml") as read:
        assert [c for c in read.checks if c.verdict == "failed"] == []
        assert read.notes == []
        assert read.recorded().changes == ()
