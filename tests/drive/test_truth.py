"""Truth: every derivation against one analytic drive, latency and dependence found again."""

from itertools import islice

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings, strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from pdhef_logtool.drive import truth as derivation
from pdhef_logtool.drive.delays import estimate_truth_latency
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.truth import dependent_signals, derive_truth, truth_at, valid_as_a_whole
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.geometry import geodetic_from_ecef
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, Channel
from pdhef_logtool.records.tracks import make_track

T0 = 1_700_000_000_000_000_000
LAT, LON = np.deg2rad(57.7), np.deg2rad(11.9)
# East, north, up as rows of Earth-fixed axes, from the textbook's definition of the unit vectors.
EAST = np.array([-np.sin(LON), np.cos(LON), 0.0])
UP = np.array([np.cos(LAT) * np.cos(LON), np.cos(LAT) * np.sin(LON), np.sin(LAT)])
ENU_FROM_ECEF = np.array([EAST, np.cross(UP, EAST), UP])
E2 = 6.69437999014e-3
N_RADIUS = 6378137.0 / np.sqrt(1 - E2 * np.sin(LAT) ** 2)
ORIGIN = np.array([N_RADIUS * UP[0], N_RADIUS * UP[1], N_RADIUS * (1 - E2) * UP[2]])


def channel(name, stamps_ns, values, units=TRUTH_UNITS, source="/ins", delay_ns=5_000_000):
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    return Channel(
        name, units[name], f"{source}.{name}", stamps_ns, stamps_ns + delay_ns, np.asarray(values, dtype=float)
    )


def channels_of(stamps_ns, values) -> dict[str, Channel]:
    """Return channels of ground truth at the same stamps."""
    return {name: channel(name, stamps_ns, v) for name, v in values.items()}


def body(d) -> dict[str, np.ndarray]:
    """Return the velocity and the yaw rate of a drive."""
    return {"vx_m_s": d.vx, "vy_m_s": d.vy, "yaw_rate_rad_s": d.r}


class Drive:
    """A smooth drive with all quantities in closed form at any time, at the center of gravity (CG)."""

    def __init__(self, t):
        self.t = t
        self.x, self.y = 20 * t + 2 * np.sin(0.5 * t), 3 * np.sin(0.8 * t)
        vx, vy = 20 + np.cos(0.5 * t), 2.4 * np.cos(0.8 * t)
        ax, ay = -0.5 * np.sin(0.5 * t), -1.92 * np.sin(0.8 * t)
        self.velocity = np.stack([vx, vy, np.zeros_like(t)], axis=1)
        self.course = np.arctan2(vy, vx)
        speed = np.hypot(vx, vy)
        course_rate = (vx * ay - vy * ax) / speed**2
        self.beta = 0.05 * np.sin(1.1 * t)
        self.yaw = self.course - self.beta
        self.r = course_rate - 0.055 * np.cos(1.1 * t)
        self.vx, self.vy = speed * np.cos(self.beta), speed * np.sin(self.beta)
        self.ay = -np.sin(self.yaw) * ax + np.cos(self.yaw) * ay


def drive(end_s=20.0, rate=100.0, jitter=0.0, seed=0):
    t = np.arange(0.0, end_s, 1.0 / rate)
    stamps = T0 + np.round((t + np.random.default_rng(seed).uniform(-jitter, jitter, t.size) / rate) * 1e9).astype(
        np.int64
    )
    return stamps, Drive((stamps - T0) * 1e-9)


def quat(rotation: Rotation) -> np.ndarray:
    q = rotation.as_quat()[:, [3, 0, 1, 2]]
    q[::7] *= -1.0  # the same attitude
    return q


def body_to_enu(d: Drive) -> Rotation:
    return Rotation.from_rotvec(d.yaw[:, None] * [0.0, 0.0, 1.0])


FRD = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
ECEF = Rotation.from_matrix(ENU_FROM_ECEF.T)


def sources(stamps, d: Drive) -> dict[str, dict]:
    enu = np.stack([d.x, d.y, np.zeros_like(d.x)], axis=1)
    ecef = ORIGIN + enu @ ENU_FROM_ECEF
    lat, lon, alt = geodetic_from_ecef(ecef).T
    lat, lon = np.rad2deg(lat), np.rad2deg(lon)
    v_ecef = d.velocity @ ENU_FROM_ECEF
    turn = body_to_enu(d)
    wrapped = np.angle(np.exp(1j * d.yaw))
    return {
        "body": body(d),
        "vx, sideslip": {"vx_m_s": d.vx, "sideslip_rad": d.beta, "yaw_rate_rad_s": d.r},
        "vx, course, yaw": {"vx_m_s": d.vx, "course_rad": d.course, "yaw_rad": wrapped},
        "enu velocity, yaw": {"enu_velocity_m_s": d.velocity, "yaw_rad": wrapped},
        "enu velocity, quat": {"enu_velocity_m_s": d.velocity, "quat_wxyz": quat(turn)},
        "enu velocity, quat ned": {"enu_velocity_m_s": d.velocity, "quat_wxyz": quat(NED * turn * FRD)},
        "ecef velocity, quat ecef frd": {
            "ecef_position_m": ecef,
            "ecef_velocity_m_s": v_ecef,
            "quat_wxyz": quat(ECEF * turn * FRD),
        },
        "ecef velocity, lat, yaw": {
            "lat_deg": lat, "lon_deg": lon, "alt_m": alt, "ecef_velocity_m_s": v_ecef, "yaw_rad": wrapped,
        },
        "position, yaw": {"x_m": d.x, "y_m": d.y, "yaw_rad": wrapped},
        "lat lon, yaw": {"lat_deg": lat, "lon_deg": lon, "alt_m": alt, "yaw_rad": wrapped},
        "ecef position, quat": {"ecef_position_m": ecef, "quat_wxyz": quat(turn)},
    }  # fmt: skip


KINDS = tuple(sources(*drive(1.0)))


@pytest.mark.parametrize("kind", KINDS)
def test_every_source_gives_the_same_body_velocity(kind):
    stamps, d = drive(jitter=0.2)
    channels = channels_of(stamps, sources(stamps, d)[kind])
    truth = derive_truth(channels)
    track = truth.track
    good = np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s)
    assert good.mean() > 0.97
    np.testing.assert_allclose(track.vx_m_s[good], d.vx[good], atol=2e-4)
    np.testing.assert_allclose(track.vy_m_s[good], d.vy[good], atol=2e-4)
    np.testing.assert_allclose(track.sideslip_rad[good], d.beta[good], atol=1e-5)
    assert np.isnan(track.ay_m_s2).all()  # a heading has no roll: the specific force is unknown
    inner = np.isfinite(track.yaw_rate_rad_s)
    assert inner.mean() > 0.95 and truth.derivation["ay_m_s2"].startswith("not scored")
    np.testing.assert_allclose(track.yaw_rate_rad_s[inner], d.r[inner], atol=2e-5)
    assert {"vx_m_s", "vy_m_s", "sideslip_rad"} <= set(truth.derivation)
    if "position_m" in truth.derivation:
        known = np.isfinite(track.x_m)
        offset = np.array([track.x_m[known][0] - d.x[known][0], track.y_m[known][0] - d.y[known][0]])
        assert np.abs(offset).max() < 0.2
        np.testing.assert_allclose(track.x_m[known] - offset[0], d.x[known], atol=0.02)
        np.testing.assert_allclose(track.y_m[known] - offset[1], d.y[known], atol=0.02)


def test_a_quaternion_on_its_own_clock_is_interpolated_whatever_its_sign():
    stamps, d = drive()
    other, e = stamps + 4_000_000, Drive(d.t + 0.004)
    channels = {
        "enu_velocity_m_s": channel("enu_velocity_m_s", stamps, d.velocity),
        "quat_wxyz": channel("quat_wxyz", other, quat(body_to_enu(e)), source="/attitude"),
    }
    track = derive_truth(channels).track
    assert np.isfinite(track.vy_m_s[1:]).all()
    np.testing.assert_allclose(track.vy_m_s[1:], d.vy[1:], atol=2e-4)


@pytest.mark.parametrize("kind", ["body", "enu velocity, yaw", "position, yaw"])
def test_lever_arm_is_taken_back_to_the_cg(kind):
    stamps, d = drive()
    p = np.array([-0.7, 0.4])
    at_sensor = Drive(d.t)
    c, s = np.cos(d.yaw), np.sin(d.yaw)
    at_sensor.x, at_sensor.y = d.x + c * p[0] - s * p[1], d.y + s * p[0] + c * p[1]
    at_sensor.vx, at_sensor.vy = d.vx - d.r * p[1], d.vy + d.r * p[0]
    at_sensor.velocity = np.stack(
        [d.velocity[:, 0] + d.r * (-s * p[0] - c * p[1]), d.velocity[:, 1] + d.r * (c * p[0] - s * p[1]), 0 * s], axis=1
    )
    channels = channels_of(stamps, sources(stamps, at_sensor)[kind])
    truth = derive_truth(channels, truth_position_m=(-0.7, 0.4, 0.3))
    good = np.isfinite(truth.track.vy_m_s)
    np.testing.assert_allclose(truth.track.vx_m_s[good], d.vx[good], atol=3e-4)
    np.testing.assert_allclose(truth.track.vy_m_s[good], d.vy[good], atol=3e-4)
    assert "moved to the CG" in truth.derivation["cg"]
    if kind == "position, yaw":
        np.testing.assert_allclose(truth.track.x_m, d.x, atol=1e-9)
        np.testing.assert_allclose(truth.track.y_m, d.y, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(0.002, 0.02), st.sampled_from(("quat", "ned frd")))
def test_specific_force_on_a_bank(bank, gradient, axes):
    """The oracle: roll of the body = bank + gradient x force, force = v̇_y + v_x r + g sin(bank)."""
    stamps, d = drive(4.0)
    force = d.ay + 9.80665 * np.sin(bank * np.sin(d.t))
    turn = body_to_enu(d) * Rotation.from_rotvec((bank * np.sin(d.t) + gradient * force)[:, None] * [1.0, 0.0, 0.0])
    attitude = quat(turn if axes == "quat" else NED * turn * FRD)
    channels = channels_of(stamps, body(d) | {"enu_velocity_m_s": d.velocity, "quat_wxyz": attitude})
    plan = derive_truth(channels, roll_gradient_rad_per_m_s2=gradient).plan
    track = derive_truth(channels, plan=plan).track
    inner = np.isfinite(track.ay_m_s2)
    assert inner.mean() > 0.85
    np.testing.assert_allclose(track.ay_m_s2[inner], force[inner], atol=0.02)
    unknown = derive_truth(channels)
    assert np.isnan(unknown.track.ay_m_s2).all() and "roll gradient" in unknown.derivation["ay_m_s2"]


def test_specific_force_of_the_simulated_road(sample_logs_dir):
    """The simulator's own acceleration in the plane of its road, plus gravity along its bank."""
    times, force = [], []
    with (sample_logs_dir / "road.mcap").open("rb") as file:
        log = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, message, state in islice(log.iter_decoded_messages(topics=["/truth/perfect/state"]), 3000):
            times.append(message.publish_time)
            force.append(state.ay_m_s2 + 9.80665 * np.sin(state.bank_rad))
    with read_drive(str(sample_logs_dir / "road.mcap"), str(sample_logs_dir / "vehicle.toml")) as drive:
        track = derive_truth(drive.plan.survey_truth, plan=drive.plan.truth).track
    known = np.isfinite(track.ay_m_s2) & (track.stamps_ns < times[-1])
    error = track.ay_m_s2[known] - np.interp(track.stamps_ns[known], times, force)
    assert known.sum() > 2500 and np.sqrt(np.mean(error**2)) < 0.02 < 0.2 < np.std(force)


def test_ground_speed_alone_claims_no_sideslip():
    stamps, d = drive(3.0)
    truth = derive_truth(channels_of(stamps, {"enu_velocity_m_s": d.velocity}))
    np.testing.assert_allclose(truth.track.vx_m_s, np.hypot(d.vx, d.vy))
    assert np.isnan(truth.track.sideslip_rad).all()
    assert "sideslip_rad" not in truth.derivation
    assert "no heading" in truth.derivation["vx_m_s"]


def test_no_truth_is_an_empty_track():
    assert derive_truth({}).plan is None
    assert len(derive_truth({"vx_m_s": channel("vx_m_s", [], [])}).track) == 0
    at = truth_at(derive_truth({}), np.arange(5, dtype=np.int64))
    assert not at.valid.any()


# ---- derivatives ----


def test_derivative_agrees_with_scipy_on_even_stamps():
    from scipy.signal import savgol_filter  # a second to import

    rng = np.random.default_rng(3)
    stamps = T0 + np.arange(400) * 10_000_000
    y = rng.normal(size=400).cumsum()
    ours = derivation.differentiate(stamps, y, 10, 30_000_000)
    theirs = savgol_filter(y, 21, 3, deriv=1, delta=0.01)
    np.testing.assert_allclose(ours[10:-10], theirs[10:-10], atol=1e-8)
    assert np.isnan(ours[:10]).all()
    assert np.isnan(ours[-10:]).all()


def test_no_derivative_across_a_gap_or_a_missing_value():
    stamps = T0 + np.arange(300) * 10_000_000
    stamps[150:] += 1_000_000_000
    y = np.where(np.arange(300) < 150, 0.0, 100.0)
    y[50] = np.nan
    slope = derivation.differentiate(stamps, y, 5, 30_000_000)
    np.testing.assert_allclose(slope[np.isfinite(slope)], 0.0, atol=1e-9)
    expected = np.isnan(slope)
    assert expected[45:56].all()
    assert expected[145:155].all()
    assert np.count_nonzero(expected) == 5 + 11 + 10 + 5


# ---- at the scored stamps ----


def test_truth_at_other_stamps_with_latency_and_gaps():
    stamps, d = drive(10.0, rate=50)
    keep = (d.t < 4.0) | (d.t > 5.0)
    truth = derive_truth(channels_of(stamps[keep], {name: values[keep] for name, values in body(d).items()}))
    latency = 0.03
    at = T0 + np.arange(-50, 1050, dtype=np.int64) * 10_000_000
    out = truth_at(truth, at, latency)
    moment_ns = at + 30_000_000
    exact = Drive((moment_ns - T0) * 1e-9)
    before, after = stamps[d.t < 4.0], stamps[d.t > 5.0]
    inside = (moment_ns >= before[0]) & (moment_ns <= before[-1]) | (moment_ns >= after[0]) & (moment_ns <= after[-1])
    np.testing.assert_array_equal(out.valid, inside)
    np.testing.assert_allclose(out.vy_m_s[inside], exact.vy[inside], atol=2e-4)
    np.testing.assert_allclose(out.sideslip_rad[inside], exact.beta[inside], atol=2e-5)
    assert np.isnan(out.vx_m_s[~inside]).all()
    np.testing.assert_array_equal(out.stamps_ns, at)


def test_headings_are_interpolated_the_shorter_way():
    stamps = T0 + np.arange(10) * 10_000_000
    yaw = np.angle(np.exp(1j * (3.0 + 0.1 * np.arange(10))))
    pose = {"x_m": np.arange(10.0), "y_m": np.zeros(10), "yaw_rad": yaw}
    out = truth_at(derive_truth(channels_of(stamps, pose)), stamps[:-1] + 5_000_000)
    np.testing.assert_allclose(np.exp(1j * out.yaw_rad), np.exp(1j * (3.05 + 0.1 * np.arange(9))), atol=1e-12)


# ---- latency ----


def yaw_rates(latency_s, *, end_s=60.0, noise=0.004, bias=0.01, rate=100.0, truth_rate=100.0, seed=0, scale=0.3):
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 12)
    frequencies = rng.uniform(0.1, 1.5, 12)

    def motion(t):
        return scale / 12**0.5 * np.sin(2 * np.pi * frequencies * t[:, None] + phases).sum(axis=1)

    t = np.arange(0, end_s, 1 / rate)
    u = np.arange(0, end_s, 1 / truth_rate) + 0.0033
    gyro = channel(
        "yaw_rate_rad_s", T0 + np.round(t * 1e9), motion(t) + bias + rng.normal(0, noise, t.size), SIGNAL_UNITS, "/imu"
    )
    truth = channel("yaw_rate_rad_s", T0 + np.round(u * 1e9), motion(u - latency_s) + rng.normal(0, 0.001, u.size))
    return gyro, truth


@settings(derandomize=True, max_examples=25, deadline=None)
@given(latency=st.floats(-0.4, 0.4), seed=st.integers(0, 1000), truth_rate=st.sampled_from([20.0, 50.0, 100.0, 200.0]))
def test_a_known_latency_is_found_to_a_millisecond(latency, seed, truth_rate):
    estimate = estimate_truth_latency(*yaw_rates(latency, seed=seed, truth_rate=truth_rate))
    assert estimate.reliable, estimate.reason
    assert not estimate.identical
    assert abs(estimate.latency_s - latency) < 1e-3


def test_without_yaw_motion_no_latency_is_claimed():
    gyro, truth = yaw_rates(0.1, scale=0.002)
    estimate = estimate_truth_latency(gyro, truth)
    assert not estimate.reliable
    assert estimate.latency_s == 0.0
    gyro, truth = yaw_rates(0.1, scale=0.0, noise=0.0)
    assert estimate_truth_latency(gyro, truth).latency_s == 0.0


def test_a_latency_beyond_the_range_is_refused_and_so_are_strangers():
    gyro, truth = yaw_rates(0.9)
    assert not estimate_truth_latency(gyro, truth).reliable
    _, other = yaw_rates(0.0, seed=99)
    assert not estimate_truth_latency(gyro, other).reliable
    short, short_truth = yaw_rates(0.0, end_s=1.0)
    assert not estimate_truth_latency(short, short_truth).reliable


def test_the_gyros_own_channel_as_truth_is_flagged():
    gyro, _ = yaw_rates(0.0)
    truth = channel("yaw_rate_rad_s", gyro.stamps_ns, gyro.values.astype(np.float32))
    estimate = estimate_truth_latency(gyro, truth)
    assert estimate.identical
    assert estimate.latency_s == 0.0


def test_latency_of_a_truth_whose_yaw_rate_is_derived():
    stamps, d = drive(60.0, rate=20)
    track = derive_truth(channels_of(stamps, sources(stamps, d)["position, yaw"]))
    derived = derivation.channel_of(track, "yaw_rate_rad_s")
    assert np.isfinite(derived.values).all()
    t = np.arange(0, 60, 0.01)
    gyro = channel("yaw_rate_rad_s", T0 + np.round((t - 0.05) * 1e9), Drive(t).r, SIGNAL_UNITS, "/imu")
    estimate = estimate_truth_latency(gyro, derived)
    assert estimate.reliable, estimate.reason
    assert abs(estimate.latency_s - 0.05) < 1e-3


# ---- dependence ----


def test_a_truth_channel_that_is_an_input_is_found():
    stamps, d = drive(10.0)
    rng, truth = np.random.default_rng(0), channels_of(stamps, body(d))
    signals = {
        "speed_m_s": channel("speed_m_s", stamps[5:], d.vx[5:].astype(np.float32), SIGNAL_UNITS, "/can"),
        "yaw_rate_rad_s": channel("yaw_rate_rad_s", stamps, d.r + rng.normal(0, 1e-3, d.r.size), SIGNAL_UNITS, "/imu"),
    }
    found = dependent_signals(signals, truth)
    assert list(found) == ["vx_m_s"]
    assert "speed_m_s" in found["vx_m_s"]
    assert "/can" in found["vx_m_s"]


def test_a_few_equal_samples_or_a_constant_do_not_make_a_copy():
    stamps, d = drive(10.0)
    mixed = np.where(np.arange(stamps.size) % 20 == 0, d.vx + 0.1, d.vx)  # 95 % equal
    for speed, vx in ((mixed, d.vx), (0.0 * d.vx, 0.0 * d.vx)):
        signals = {"speed_m_s": channel("speed_m_s", stamps, speed, SIGNAL_UNITS)}
        assert dependent_signals(signals, channels_of(stamps, {"vx_m_s": vx})) == {}


def test_valid_means_that_everything_claimed_is_known():
    stamps, d = drive(10.0, rate=50)
    keep = (d.t < 4.0) | (d.t > 5.0)
    channels = channels_of(stamps, body(d)) | channels_of(stamps[keep], {"vy_m_s": d.vy[keep]})
    truth = derive_truth(channels)
    at_stamps = truth_at(truth, stamps[5:-5])
    out = valid_as_a_whole(at_stamps, truth.derivation, 0.3)
    hole = (d.t[5:-5] > 4.1) & (d.t[5:-5] < 4.9)
    assert np.isfinite(out.yaw_rate_rad_s[hole]).all()  # known where the whole is not, and scored there
    assert at_stamps.valid[hole].all()
    assert not out.valid[hole].any()
    for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad"):
        assert np.isfinite(getattr(out, column)[out.valid]).all(), column
    assert out.valid.sum() > 350
    truth = derive_truth({"yaw_rate_rad_s": channels["yaw_rate_rad_s"]})
    assert valid_as_a_whole(truth_at(truth, stamps[5:-5]), truth.derivation, 0.3).valid.all()


def test_there_is_no_sideslip_at_standstill():
    stamps, d = drive(10.0, rate=50)
    noise = np.random.default_rng(0).normal(0.0, 0.01, (2, len(stamps)))
    standing = d.t > 5.0
    d.vx, d.vy = np.where(standing, noise[0], d.vx), np.where(standing, noise[1], d.vy)
    truth, at = derive_truth(channels_of(stamps, body(d))), stamps[20:-20]
    out, before = truth_at(truth, at, standstill_m_s=0.3), truth_at(truth, at)
    still = standing[20:-20]
    assert np.ptp(before.sideslip_rad[still]) > 6.0
    assert np.isnan(out.sideslip_rad[still]).all()
    assert valid_as_a_whole(out, truth.derivation, 0.3).valid[still].mean() > 0.9
    assert np.isfinite(out.vx_m_s).all()
    np.testing.assert_array_equal(out.sideslip_rad[~still], before.sideslip_rad[~still])


SLOW_M_S, RATE_HZ = 1.0, 50


def test_sideslip_alone_is_scored_above_the_measured_low_speed_limit(tmp_path):
    """At 10 s the car stops, at 14 s the sensors fail for 2 s beside the ground truth."""
    log, mapping = tmp_path / "correvit.csv", tmp_path / "correvit.toml"
    t = np.arange(20 * RATE_HZ) / RATE_HZ
    speed = np.where((t > 10.0) & (t < 12.0), 0.0, 20.0)
    rate = np.where(speed > 0.0, 0.2 * np.sin(2.0 * t), 0.0)
    sensors = np.where((t < 14.0) | (t >= 16.0), [speed, rate, speed * rate, 0.0 * t], np.nan)
    titles = ["time [s]", "Speed [m/s]", "YawRate [rad/s]", "AccY [m/s2]", "AccX [m/s2]", "Sideslip [rad]"]
    pl.DataFrame([t, *sensors, -0.1 * rate], schema=titles).fill_nan(None).write_csv(log)
    entry = '[{}]\ntopic = "csv"\nfield = "{}"\n'
    fields = {"speed_m_s": "Speed", "yaw_rate_rad_s": "YawRate", "ay_m_s2": "AccY", "ax_m_s2": "AccX"}
    signals = [entry.format(f"signals.{name}", field) for name, field in fields.items()]
    mapping.write_text("".join([*signals, entry.format("truth.sideslip_rad", "Sideslip")]))
    with read_drive(log, "saloon", mapping) as drive:
        whole = drive.whole()
    truth, seconds = whole.truth, (whole.signals.stamps_ns - whole.log_start_ns) * 1e-9
    assert truth is not None and not np.isfinite(truth.vx_m_s).any()
    estimate = make_track("zero", truth.stamps_ns, sideslip_rad=np.zeros(len(truth)))
    scored = np.isfinite(signal_error(estimate, truth, "sideslip_rad", SLOW_M_S))
    standing = (seconds > 10.05) & (seconds < 11.95)
    driving = (seconds > 0.1) & (seconds < 9.9) | (seconds > 12.1) & (seconds < 19.9)
    assert scored[driving].all()
    assert not scored[standing].any()
    assert not ((seconds > 14.01) & (seconds < 15.99)).any()
    np.testing.assert_allclose(whole.truth.measured_speed_m_s[driving], 20.0, atol=0.01)


def test_measured_lateral_acceleration_is_moved_too():
    stamps, _ = drive(rate=100)
    t = (stamps - T0) * 1e-9
    r = 0.4 * np.sin(t)
    x, y = 1.5, -0.5
    motion = {"vx_m_s": 10 + 0 * t, "vy_m_s": 0 * t, "yaw_rate_rad_s": r}
    channels = channels_of(stamps, motion | {"ay_m_s2": 10 * r + 0.4 * np.cos(t) * x - r**2 * y})
    track = derive_truth(channels, truth_position_m=(x, y, 0.0)).track
    good = np.isfinite(track.ay_m_s2)
    np.testing.assert_allclose(track.ay_m_s2[good], 10 * r[good], atol=1e-5)


def test_without_a_yaw_rate_velocities_stay_and_the_report_says_so():
    stamps, d = drive(2.0)
    truth = derive_truth(channels_of(stamps, {"vx_m_s": d.vx, "vy_m_s": d.vy}), truth_position_m=(1.0, 0.0, 0.0))
    np.testing.assert_array_equal(truth.track.vy_m_s, d.vy)
    assert "no yaw rate" in truth.derivation["cg"]
    assert np.isnan(truth.track.ay_m_s2).all()
