"""Signals of an IMU in any mounting are rotated to x forward, z up; a doubtful rotation is reported, not applied."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.measured import measure
from pdhef_logtool.drive.mounting import ACCELERATIONS, RATES, angles_deg, find_mounting, find_triads
from pdhef_logtool.drive.plan import DrivePlan, plan_drive, with_gyro_delay
from pdhef_logtool.drive.recorded import read_recorded
from pdhef_logtool.drive.survey import Survey, mapping_proposals, survey_log
from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, auto_map, fit_clocks, load_mapping, read_signals, resolve_mapping
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.runs.inspection.report import inspect_drive_log, write_mapping

TOPIC = "/imu/data"
TRIADS = tuple(tuple(f"{part}.{axis}" for axis in "xyz") for part in ("linear_acceleration", "angular_velocity"))


class ChangedLog:
    """Wraps a log; each of ``changes`` returns new columns of a topic that is read, of the IMU from all its columns."""

    def __init__(self, log: Any, *changes: Callable[[str, Columns], dict[str, FloatArray]]) -> None:
        self._log, self._changes = log, changes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def read(self, requests: dict[str, list[str]], start_ns: int, end_ns: int, **options: bool) -> dict[str, Any]:
        whole = {t: [*dict.fromkeys([*p, *TRIADS[0], *TRIADS[1]])] for t, p in requests.items() if t == TOPIC}
        found = self._log.read({**requests, **whole}, start_ns, end_ns, **options)
        for change in self._changes:
            found = {t: replace(c, fields={**c.fields, **change(t, c)}) for t, c in found.items()}
        return found


def turning(car_from_sensor: FloatArray) -> Callable[[str, Columns], dict[str, FloatArray]]:
    """Return the change of an IMU; ``car_from_sensor`` [3, 3] rotates its new readings into the original ones."""

    def change(topic: str, columns: Columns) -> dict[str, FloatArray]:
        triads = TRIADS if topic == TOPIC else ()
        turned = {paths: np.stack([columns.fields[p] for p in paths], axis=1) @ car_from_sensor for paths in triads}
        return {p: vectors[:, i] for paths, vectors in turned.items() for i, p in enumerate(paths)}

    return change


def turned_log(log: Any, *angles: float) -> ChangedLog:
    return ChangedLog(log, turning(rotation(*angles)))


def rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the rotation [3, 3] of a sensor that is turned by yaw, then pitch, then roll (deg) into the car's axes."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians([roll, pitch, yaw])) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


ANGLES = [(r, p, y) for r, p, y in product((0, 90, 180, 270), (0, 90, 270), (0, 90, 180, 270)) if p == 0 or r == 0]
assert len({np.rint(rotation(*a)).tobytes() for a in ANGLES}) == 24
IMU = ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")


@pytest.fixture(scope="module")
def log(sample_logs_dir):
    opened = open_log(sample_logs_dir / "faults.mcap")
    yield opened
    opened.close()


def planned(log, mapping=None) -> DrivePlan:
    mapping = auto_map(log).mapping if mapping is None else mapping
    return plan_drive(log, mapping, default_vehicle(), log.start_ns, log.end_ns)


def signals_of(log, plan: DrivePlan) -> Signals:
    return read_recorded(log, plan).signals


def difference(a: Signals, b: Signals) -> float:
    return max(float(np.nanmax(np.abs(getattr(a, n) - getattr(b, n)))) for n in IMU)


@pytest.fixture(scope="module")
def components(log):
    """Return the channels of a log with the six IMU components, the triads and the mapping."""
    mapping = resolve_mapping(log, auto_map(log).mapping)
    triads = find_triads(log, mapping)
    extra = {**triads[0].components(ACCELERATIONS), **triads[1].components(RATES)}
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    sources = replace(mapping, signals={**mapping.signals, **extra})
    return read_signals(log, sources, clocks, log.start_ns, log.end_ns), triads, mapping


@pytest.mark.slow
@pytest.mark.parametrize("angles", ANGLES)
def test_every_mounting_in_steps_of_90_degrees_is_found(components, angles):
    channels, triads, mapping = components
    turn = rotation(*angles)
    signals = dict(channels.signals)
    for names in (ACCELERATIONS, RATES):
        turned = np.stack([signals[n].values for n in names], axis=1) @ turn
        signals |= {n: replace(signals[n], values=turned[:, i]) for i, n in enumerate(names)}
    found = find_mounting(measure(signals), triads, mapping)
    assert found.confident
    assert np.allclose(found.rotation, turn, atol=1e-9)
    assert found.is_as_named == (angles == (0, 0, 0))


@pytest.mark.parametrize("bends", [0.02, 0.2])
def test_a_hill_in_a_banked_bend_turns_no_imu(components, bends):
    """Only in quick bends, crossfall and grade cannot resemble an IMU that is turned."""
    channels, triads, mapping = components
    like = channels.signals[RATES[2]].take(np.arange(800))
    seconds = 1e-9 * (like.stamps_ns - like.stamps_ns[0])
    rate = bends * np.sin(1.2 * seconds)
    speed = 28.0 + 0.2 * np.sin(0.5 * seconds)
    values = dict(zip(RATES, (0.0 * rate, 0.0 * rate, rate), strict=True))
    values |= dict(zip(ACCELERATIONS, (speed * rate, 0.01 * np.cos(9.0 * seconds), 9.81 + 0.0 * rate), strict=True))
    values |= {"speed_m_s": speed, "steer_rad": 2.8 * rate / speed}
    found = find_mounting(measure({n: replace(like, name=n, values=v) for n, v in values.items()}), triads, mapping)
    assert not found.is_as_named
    assert found.confident == (bends > 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("angles", [(0, 0, 0), (0, 90, 0), (180, 0, 270)])
def test_a_recognised_imu_is_read_as_it_is_mounted(log, angles):
    turned = turned_log(log, *angles)
    plan = planned(turned)
    upright = angles == (0, 0, 0)
    assert (plan.mapping == auto_map(turned).mapping) == upright
    failed = {c.name for c in plan.checks if c.verdict == "failed"}
    assert bool(failed) != upright, "what is turned has a failed check: the run ends with exit code 3"
    assert failed <= {f"{n}.corrected" for n in (*IMU, "roll_rate_rad_s", "pitch_rate_rad_s")} and not plan.refused
    assert difference(signals_of(turned, plan), signals_of(log, planned(log))) < 1e-9
    if not upright:
        assert "the IMU is mounted with" in plan.mapping.notes[-1]
        assert all(isinstance(plan.mapping.signals[n].field, str) for n in IMU), "one field is enough"


@pytest.mark.slow
@pytest.mark.parametrize("angles", [(7, 0, 0), (180, 0, 30)])
def test_a_mounting_askew_is_found_to_two_degrees(log, angles):
    turned = turned_log(log, *angles)
    plan = planned(turned)
    rest = difference(signals_of(turned, plan), signals_of(log, planned(log)))
    assert rest < 0.5, "2 deg of gravity are 0.34 m/s^2"
    assert all(c.name.endswith(".corrected") for c in plan.checks if c.verdict == "failed")


@pytest.mark.slow
def test_a_written_mapping_turns_once_and_never_again(log, tmp_path):
    turned = turned_log(log, 0, 90, 25)
    found = inspect_drive_log(turned)
    write_mapping(found, tmp_path / "mapping.toml")
    mapping = load_mapping(tmp_path / "mapping.toml")
    plan = planned(turned, mapping)
    assert plan.mapping is mapping
    assert {c.verdict for c in plan.checks if c.name.endswith(".mounting")} == {"passed"}
    assert difference(signals_of(turned, plan), signals_of(turned, planned(turned))) < 1e-5
    again = inspect_drive_log(turned, mapping)
    assert {n: again.mapping.signals[n].scale for n in IMU} == {n: mapping.signals[n].scale for n in IMU}


def test_a_mapping_file_is_checked_and_left_alone(log):
    turned = turned_log(log, 0, 0, 90)
    mapping = replace(auto_map(turned).mapping, origin="file")
    plan = planned(turned, mapping)
    assert plan.mapping is mapping
    failed = {c.name: c for c in plan.checks if c.verdict == "failed"}
    assert {"ax_m_s2.mounting", "ay_m_s2.mounting"} <= set(failed)
    assert failed["ay_m_s2.mounting"].remedy == 'in the mapping: field = "linear_acceleration.x", scale = 1.0'
    assert "yaw 90 deg" in failed["ay_m_s2.mounting"].evidence


@pytest.mark.slow
def test_a_sensor_that_takes_gravity_off_is_turned_by_its_rates(log):
    for angles in ((90, 0, 0), (180, 0, 90)):
        gravity = dict(zip(TRIADS[0], 9.81 * rotation(*angles)[2], strict=True))

        def compensated(topic: str, columns: Columns, of: dict[str, float] = gravity) -> dict[str, FloatArray]:
            return {p: columns.fields[p] - g for p, g in of.items()} if topic == TOPIC else {}

        turned = ChangedLog(log, turning(rotation(*angles)), compensated)
        assert difference(signals_of(turned, planned(turned)), signals_of(log, planned(log))) < 1e-9


@pytest.mark.parametrize("angles", [(0, 90, 30), (0, -90, -120), (170, 20, -30)])
def test_angles_give_the_rotation_back(angles):
    assert np.allclose(rotation(*angles_deg(rotation(*angles))), rotation(*angles), atol=1e-6)


DELAY_S, LEVER_M, GAIN = 0.040, -1.45, 1.06
AY_DELAY_S = 0.024
CAR = default_vehicle().model_copy(update={"name": "other"})


ON_ITS_SIDE = rotation(90, 0, 0)


def wrong(topic: str, columns: Columns) -> dict[str, FloatArray]:
    """Change an IMU on its side: off the CG, late, its gyro with a gain; and the sign of the steering."""
    fields = dict(columns.fields)
    if topic != TOPIC:
        return {p: -v for p, v in fields.items() if p == "steering_tire_angle"}
    time_s = (columns.log_time_ns - columns.log_time_ns[0]) * 1e-9
    forces, rates = TRIADS
    smooth = np.convolve(np.stack([fields[p] for p in rates], axis=1) @ ON_ITS_SIDE[2], np.ones(11) / 11.0, mode="same")
    late = {p: GAIN * np.interp(time_s - DELAY_S, time_s, fields[p]) for p in rates}
    for i, path in enumerate(forces):  # the lever acts along the car's left
        felt = fields[path] + LEVER_M * np.gradient(smooth, time_s) * ON_ITS_SIDE[1, i]
        late[path] = np.interp(time_s - AY_DELAY_S, time_s, felt)
    return late


@pytest.fixture(scope="module")
def wrong_log(sample_logs_dir):
    opened = open_log(sample_logs_dir / "sweep.mcap")
    yield ChangedLog(opened, turning(ON_ITS_SIDE), wrong)
    opened.close()


def surveyed(wrong_log, mapping: Mapping, vehicle: VehicleParameters) -> Survey:
    mapping = with_gyro_delay(mapping, vehicle)
    clocks = fit_clocks(wrong_log, mapping, wrong_log.start_ns, wrong_log.end_ns)
    return survey_log(wrong_log, mapping, clocks, (wrong_log.start_ns, wrong_log.end_ns))


@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_each_error_is_taken_off_once_however_often(wrong_log, tmp_path, times):
    mapping = auto_map(wrong_log).mapping
    for number in range(times):
        write_mapping(inspect_drive_log(wrong_log, mapping if number else None), tmp_path / f"{number}.toml")
        mapping = load_mapping(tmp_path / f"{number}.toml")
    plan = plan_drive(wrong_log, mapping, CAR, wrong_log.start_ns, wrong_log.end_ns)
    assert plan.mapping.signals["steer_rad"].scale == -1.0
    assert plan.mapping.signals["ay_m_s2"].field == "linear_acceleration.z"
    assert plan.mapping.signals["yaw_rate_rad_s"].field == "angular_velocity.y"
    assert plan.mapping.signals["yaw_rate_rad_s"].latency_s == pytest.approx(DELAY_S, abs=0.003)
    assert plan.mapping.signals["ay_m_s2"].latency_s == pytest.approx(AY_DELAY_S, abs=0.008)
    # Place of the accelerometer and gain of the gyro belong to the vehicle file: a check names the values.
    assert {c.name for c in plan.checks if c.verdict == "failed"} == {"ay_m_s2.place", "yaw_rate_rad_s.gain"}
    assert abs(plan.truth_latency_s) < 0.003
    assert mapping_proposals(surveyed(wrong_log, mapping, CAR)) == ()


def test_proposals_say_where_they_belong_and_why(wrong_log):
    found = inspect_drive_log(wrong_log)
    assert {p.subject for p in found.proposals} == {"yaw_rate_rad_s", "ay_m_s2"}, (
        "a sign is corrected in a recognised mapping itself"
    )
    file = inspect_drive_log(wrong_log, replace(auto_map(wrong_log).mapping, origin="file"))
    assert {p.subject for p in file.proposals} >= {"ay_m_s2", "yaw_rate_rad_s"}
    assert all(p.evidence for p in found.proposals)
    assert [p["subject"] for p in found.to_dict()["proposals"]] == [p.subject for p in found.proposals]


def turned_truth(_topic: str, columns: Columns) -> dict[str, FloatArray]:
    """Rotate the body velocity of the ground truth by 0.4 degrees."""
    paths = [f"twist.twist.linear.{axis}" for axis in "xy"]
    vx, vy = (columns.fields.get(p) for p in paths)
    c, s = np.cos(np.radians(0.4)), np.sin(np.radians(0.4))
    return {} if vx is None or vy is None else dict(zip(paths, (c * vx - s * vy, s * vx + c * vy), strict=True))


@pytest.mark.slow
def test_a_turned_truth_is_turned_back_once(sample_logs_dir, tmp_path):
    opened = open_log(sample_logs_dir / "road.mcap")
    wrong_log = ChangedLog(opened, turned_truth)
    found = inspect_drive_log(wrong_log)
    assert {p.subject for p in found.proposals} == {"truth.vx_m_s", "truth.vy_m_s"}
    write_mapping(found, tmp_path / "mapping.toml")
    mapping = load_mapping(tmp_path / "mapping.toml")
    again = inspect_drive_log(wrong_log, mapping)
    opened.close()
    assert again.proposals == ()
    assert not [c for c in again.checks if c.verdict == "failed"]
    assert mapping.truth["vy_m_s"].scale[0] == pytest.approx(-np.radians(0.4), abs=np.radians(0.06))
