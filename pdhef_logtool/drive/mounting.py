"""Mounting of an IMU in the car, from gravity, speed and yaw rate.

The mean specific force minus the accelerations of the car points up; the rate about that axis is the yaw rate. In the
car's axes, the level accelerations are (v̇, v r). A complex regression gives the angle about the vertical that rotates
the sensor's axes to these; its correlation, gain and error decide whether the mounting is accepted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.check_table import result
from pdhef_logtool.drive.columns import derivative, halves, independent_samples, moving_at
from pdhef_logtool.drive.measured import Measured
from pdhef_logtool.drive.relations import compare, gentle_at, law, steering_references, yaw_references
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping, SignalSource
from pdhef_logtool.mapping.checking import has_path
from pdhef_logtool.mapping.mapping_file import entries_of
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import FloatArray

#: Below this mean acceleration, the sensor's software has subtracted gravity.
COMPENSATED_M_S2 = 3.0
#: Least correlation of the level accelerations with speed and yaw rate in the correct axes; the rest is sideslip, roll,
#: grade, crossfall and noise.
MIN_CORRELATION = 0.75
#: Least number of independent samples: 5 s of driving.
MIN_SAMPLES = 10.0
#: Plausible gain of the regression. Outside, a unit is wrong and the angle is unknown.
GAIN_RANGE = (0.5, 2.0)
#: Largest standard error of the angle for a multiple of 90 degrees: three errors are half of 45 degrees.
MAX_ERROR_DEG = 7.5
#: A mounting is a multiple of 90 degrees unless it differs by more than this and by more than three standard errors.
#: Grade, crossfall and bias are 0.5 m/s^2 over 20 s, 3 degrees of tilt; sideslip causes 2 degrees of yaw.
TURNED_DEG = 4.0
ASKEW_SAMPLES = 40.0
#: Least correlation of each part of a drive. If the parts are too short, the drive needs ``ASKEW_CORRELATION``.
PART_CORRELATION = 0.6
#: Largest difference between two parts of a drive, and condition number above which the regressors are not separable.
PARTS_AGREE_DEG, PARTS_AGREE_SHARE, WELL_CONDITIONED = 2.5, 0.2, 60.0
ASKEW_CORRELATION, ASKEW_ERROR_DEG = 0.85, 1.5
#: Least correlation of the yaw rate with another measurement that decides its sign.
SIGN_CORRELATION = 0.5
#: The same for a left-handed sensor: the wheels' difference changes its sign when a car understeers strongly.
HAND_CORRELATION = 0.8
#: Words for the axes of a rate, x first.
_RATE_WORDS = ("roll", "pitch", "yaw")
#: Temporary names of the components; they differ from all signal names.
ACCELERATIONS = tuple(f"triad.acceleration.{axis}" for axis in "xyz")
RATES = tuple(f"triad.rate.{axis}" for axis in "xyz")
#: Rows of a mounting: forward and left from the accelerometer, up from the gyro.
MOUNTED = ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")
#: A mean acceleration in this range is gravity.
IS_GRAVITY_M_S2 = (0.75 * GRAVITY_M_S2, 1.25 * GRAVITY_M_S2)
#: Largest angle between the mean gravity of a drive and the car's vertical.
TILT_DEG = 15.0


# ------------------------------------------------------------------------------------------------ fields of an IMU


@dataclass(frozen=True, slots=True)
class Triad:
    """Three fields of one message, x first, and their common factor to SI."""

    source: SignalSource
    paths: tuple[str, str, str]
    unit: float

    def components(self, names: tuple[str, ...]) -> dict[str, SignalSource]:
        """Return the three fields as separate sources."""
        return {
            n: replace(self.source, name=n, field=p, scale=self.unit, offset=0.0, valid_min=None, valid_max=None)
            for n, p in zip(names, self.paths, strict=True)
        }

    def row(self, source: SignalSource) -> FloatArray:
        """Return the direction [3] of a mapped signal in the triad's axes."""
        scales = source.scale if isinstance(source.scale, tuple) else (source.scale,) * len(source.paths)
        row = np.zeros(3)
        for path, scale in zip(source.paths, scales, strict=True):
            row[self.paths.index(path)] += scale / self.unit
        return row

    def turned(self, source: SignalSource, row: FloatArray) -> SignalSource:
        """Return the source of a signal in a direction [3] of the triad; a single field if the direction is an axis."""
        used = [i for i in range(3) if abs(row[i]) > 1e-9]
        scales = tuple(float(np.round(row[i], 6)) * self.unit for i in used)
        if len(used) == 1:
            return replace(source, field=self.paths[used[0]], scale=scales[0])
        return replace(source, field=tuple(self.paths[i] for i in used), scale=scales)


def find_triads(log: DriveLog, mapping: Mapping) -> tuple[Triad | None, Triad | None]:
    """Return the triads of accelerations and of rates with an axis in the mapping; None for a missing triad."""
    triads = [_triad(log, mapping, names) for names in (("ay_m_s2", "ax_m_s2"), ("yaw_rate_rad_s",))]
    return triads[0], triads[1]


def _triad(log: DriveLog, mapping: Mapping, names: tuple[str, ...]) -> Triad | None:
    sources = [mapping.signals[n] for n in names if n in mapping.signals]
    if not sources or any(s.can_signal is not None for s in sources):
        return None
    first = sources[0]
    fields = log.fields(first.topic)
    for paths in _siblings(first.paths):
        inside = all(s.topic == first.topic and s.stamp == first.stamp and set(s.paths) <= set(paths) for s in sources)
        if inside and all(has_path(fields, p) for p in paths):
            scales = first.scale if isinstance(first.scale, tuple) else (first.scale,)
            unit = float(np.linalg.norm(scales))
            # Rows of a rotation have length 1, so that the length of the scales is the unit.
            return Triad(first, paths, unit)
    return None


def _siblings(paths: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Yield possible triples of paths that contain a path."""
    path = paths[0]
    if index := re.fullmatch(r"(.*)\[(\d+)\]", path):
        start = int(index[2]) - int(index[2]) % 3
        yield f"{index[1]}[{start}]", f"{index[1]}[{start + 1}]", f"{index[1]}[{start + 2}]"
    leaf = path.rfind(".") + 1
    for word in _RATE_WORDS:
        position = path.lower().find(word, leaf)
        if position >= 0:
            written = [w.capitalize() if path[position].isupper() else w for w in _RATE_WORDS]
            a, b, c = (path[:position] + w + path[position + len(word) :] for w in written)
            yield a, b, c
    for position in range(len(path) - 1, leaf - 1, -1):
        if path[position] in "xyzXYZ":
            axes = "XYZ" if path[position].isupper() else "xyz"
            a, b, c = (path[:position] + axis + path[position + 1 :] for axis in axes)
            yield a, b, c


# ------------------------------------------------------------------------------------------------ rotations


def angles_deg(rotation: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a sensor rotation [3, 3], in the order yaw, pitch, roll."""
    m = rotation
    pitch = math.asin(float(np.clip(-m[2, 0], -1.0, 1.0)))
    if abs(m[2, 0]) > 1.0 - 1e-6:  # gimbal lock: roll and yaw are not separable
        return 0.0, math.degrees(pitch), math.degrees(math.atan2(-m[0, 1], m[1, 1]))
    roll, yaw = math.atan2(m[2, 1], m[2, 2]), math.atan2(m[1, 0], m[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)


def rotation_text(rotation: FloatArray) -> str:
    """Return a sensor's rotation as text."""
    roll, pitch, yaw = (round(a) + 0 if abs(a - round(a)) < 0.05 else round(a, 1) for a in angles_deg(rotation))
    return f"the IMU is mounted with roll {roll:g}, pitch {pitch:g}, yaw {yaw:g} deg"


def nearest_step(rotation: FloatArray) -> FloatArray:
    """Return the nearest rotation [3, 3] by multiples of 90 degrees."""
    rows = np.eye(3)[list(permutations(range(3)))]
    steps = np.concatenate([rows * np.array(signs)[:, None] for signs in product((1.0, -1.0), repeat=3)]) + 0.0
    steps = steps[np.linalg.det(steps) > 0.0]
    return np.asarray(steps[np.argmax(np.sum(steps * rotation, axis=(1, 2)))])


def upright_check(named: FloatArray, force: FloatArray) -> Check | None:
    """Report that gravity, the mean acceleration [3], is not upward in the axes that a mapping names.

    ``named``: rows [3, 3] of forward, left and the yaw axis in the sensor's axes. The result is None without forward or
    left, and if the sensor subtracts gravity.
    """
    up, size = np.cross(named[0], named[1]), float(np.linalg.norm(force))
    least = math.cos(math.radians(2.0 * TILT_DEG)) * size
    if not up.any() or not IS_GRAVITY_M_S2[0] < size < IS_GRAVITY_M_S2[1] or up @ force > least:
        return None
    along = int(np.argmax(np.abs(force)))
    axis = f"{'-' if force[along] < 0.0 else '+'}{'xyz'[along]}"
    evidence = f"gravity is along {axis} of the accelerometer, not along its vertical: its axes are not the car's"
    remedy = 'turn them in a mapping file, or --waive "imu.mounting"'
    return Check("imu.mounting", "ay_m_s2", "undecided", evidence, remedy)


def angle_deg(cosine: float) -> float:
    """Return the angle of a cosine, deg; rounding may exceed 1."""
    return math.degrees(math.acos(float(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Rotation [3, 3] from the sensor's axes to forward, left, up, with its evidence.

    ``named``: the rows [3, 3] that the mapping reads now, 0 where it lacks a signal. ``confident``: the rotation may be
    applied. ``hand``: -1 if the sensor's rates are left-handed.
    """

    rotation: FloatArray
    named: FloatArray
    evidence: str
    confident: bool
    hand: float = 1.0

    @property
    def rows(self) -> FloatArray:
        """Rows [3, 3] that a mapping should read: forward and left of the accelerometer, up of the gyro."""
        return np.concatenate([self.rotation[:2], self.hand * self.rotation[2:]])

    @property
    def is_as_named(self) -> bool:
        """Whether the mapping reads the axes that it should."""
        return all(np.allclose(r, n, atol=1e-3) for r, n in zip(self.rows, self.named, strict=True) if n.any())

    @property
    def text(self) -> str:
        """The rotation as text."""
        mirrored = "" if self.hand > 0.0 else ", its angular rates with the opposite sign"
        return f"{rotation_text(self.rotation)}{mirrored}"


def find_mounting(measured: Measured, triads: tuple[Triad | None, Triad | None], mapping: Mapping) -> Mounting | None:
    """Find the rotation of an IMU from its six components; None without them, or if the drive does not show it.

    ``measured`` contains the components of the triads. Ground truth, if any, gives the sign of the yaw rate.
    """
    accelerations, rates = triads
    columns, speed_name = measured.columns, measured.speed_name
    if accelerations is None or rates is None or not all(n in columns for n in (*ACCELERATIONS, *RATES)):
        return None
    f = np.stack([columns[n] for n in ACCELERATIONS], axis=1)
    w = np.stack([columns[n] for n in RATES], axis=1)
    named = named_rows(mapping, accelerations, rates)
    speed = np.full(f.shape[0], np.nan) if speed_name is None else columns[speed_name]
    references = yaw_references(columns, speed_name)
    ups = _ups(f, w, named)
    if len(ups) > 1 and not references:  # gravity does not show which way is up
        references = steering_references(columns, speed_name)
    # A sensor is left-handed only if another measurement of the yaw rate confirms it.
    fitting = [
        (turn, h) for h in (1.0, -1.0) for up in ups
        if (turn := _turned(f, h * w, speed, up, references)) and turn.fits and h * HAND_CORRELATION > -turn.sign
    ]  # fmt: skip
    if not fitting:
        return None
    best, hand = max(fitting, key=lambda x: x[0].correlation + np.sign(x[0].sign))
    parts = [
        _turned(f, hand * w, np.where(part, speed, np.nan), best.rotation[2], references) for part in halves(len(speed))
    ]
    is_shown = _is_shown(best, hand, measured)
    mounting = Mounting(_snapped(best, parts), named, best.evidence, is_shown, hand)
    is_sure = mounting.is_as_named or _parts_agree(best, parts)
    return replace(mounting, confident=is_shown and is_sure)


def _is_shown(turn: _Turn, hand: float, measured: Measured) -> bool:
    """Return whether another measurement of the yaw rate, the speed or the steering confirms a rotation.

    Steering that counts to the left confirms gravity, and is no evidence against it: its sign is no standard.
    """
    if turn.sign != 0.0 or turn.along or hand < 0.0:
        return turn.sign > 0.0 or turn.along
    return _sign_of(turn.rate, steering_references(measured.columns, measured.speed_name))[0] > 0.0


def _parts_agree(whole: _Turn, parts: Sequence[_Turn | None]) -> bool:
    """Return whether the parts of a drive give the same multiple of 90°; a short drive must correlate as a whole."""
    step, fitted = nearest_step(whole.rotation), [p for p in parts if p is not None]
    agree = all(p.correlation >= PART_CORRELATION and np.allclose(nearest_step(p.rotation), step) for p in fitted)
    return agree and (len(fitted) == len(parts) or whole.correlation >= ASKEW_CORRELATION)


def named_rows(mapping: Mapping, accelerations: Triad | None, rates: Triad | None) -> FloatArray:
    """Return the rows [3, 3] of the sensor's axes that a mapping reads, 0 where it lacks one."""
    named = np.zeros((3, 3))
    for i, (name, triad) in enumerate(zip(MOUNTED, (accelerations, accelerations, rates), strict=True)):
        if name in mapping.signals and triad is not None:
            named[i] = triad.row(mapping.signals[name])
    return named


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """A rotation for one choice of the vertical, with its fit to the drive.

    ``sign``: correlation of the yaw rate with another measurement, 0 without one. ``along``: the speed alone shows
    which way is forward. ``rate``: yaw rate.
    """

    rotation: FloatArray
    correlation: float
    error_deg: float
    samples: float
    sign: float
    along: bool
    fits: bool
    evidence: str
    rate: FloatArray


def _ups(f: FloatArray, w: FloatArray, named: FloatArray) -> list[FloatArray]:
    """Return the candidates [3] for up: gravity, or both directions of the main rotation axis if gravity is removed."""
    mean = np.nanmean(f, axis=0) if np.isfinite(f).all(axis=1).any() else np.zeros(3)
    size = float(np.linalg.norm(mean))
    if IS_GRAVITY_M_S2[0] < size < IS_GRAVITY_M_S2[1]:
        return [mean / size]
    if size > COMPENSATED_M_S2:
        return []
    whole = np.isfinite(w).all(axis=1)
    spread = w[whole].std(axis=0) if whole.any() else np.zeros(3)
    axis = int(np.argmax(spread))
    if spread[axis] <= 0.0:
        return []
    sign = 1.0 if named[2, axis] >= 0.0 else -1.0
    up = np.zeros(3)
    up[axis] = sign
    return [up, -up]


def _turned(
    f: FloatArray, w: FloatArray, speed: FloatArray, up: FloatArray, references: list[tuple[str, FloatArray]]
) -> _Turn | None:
    moving = moving_at(speed)
    rotation, correlation, gain, error = np.zeros((3, 3)), 0.0, 0.0, math.inf
    axis, mean = up, up
    for _ in range(3):  # iterates, because the accelerations of the drive tilt the mean slightly
        e1 = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        e1 /= np.linalg.norm(e1)
        e2 = np.cross(axis, e1)
        rate = w @ axis
        driven = derivative(speed) + 1j * speed * rate
        level = f @ e1 + 1j * (f @ e2)
        use = moving & np.isfinite(driven) & np.isfinite(level)
        samples = independent_samples(int(np.count_nonzero(use)))
        if samples < MIN_SAMPLES:
            return None
        # A sensor away from the CG also measures a term in proportion to the yaw acceleration.
        turning = 1j * derivative(rate)
        use &= np.isfinite(turning)
        a = np.stack([driven[use] - driven[use].mean(), turning[use] - turning[use].mean()], axis=1)
        z = level[use] - level[use].mean()
        power = float(np.sum(np.abs(z) ** 2))
        if np.linalg.matrix_rank(a) < 2 or power <= 0.0:
            return None
        factors = np.linalg.lstsq(a, z, rcond=None)[0]
        factor, left_over = complex(factors[0]), z - a @ factors
        spread = float(np.mean(np.abs(left_over) ** 2)) / 2.0
        variance = float(np.linalg.inv((a.conj().T @ a).real / a.shape[0])[0, 0]) * spread / samples
        gain = abs(factor)
        error = math.degrees(math.sqrt(variance) / max(gain, 1e-9))
        correlation = math.sqrt(max(0.0, 1.0 - float(np.sum(np.abs(left_over) ** 2)) / power))
        angle = float(np.angle(factor))
        forward = math.cos(angle) * e1 + math.sin(angle) * e2
        rotation = np.stack([forward, np.cross(axis, forward), axis])
        mean = np.mean(f[use], axis=0) - rotation.T @ np.array([driven[use].real.mean(), driven[use].imag.mean(), 0.0])
        if np.linalg.norm(mean) > COMPENSATED_M_S2:
            axis = mean / np.linalg.norm(mean)
    sign, said = _sign_of(np.where(gentle_at(speed * rate, moving), rate, np.nan), references)
    if sign == 0.0:
        sign, said = _sign_of(rate, references)
    evidence = (
        f"speed and yaw rate explain the level accelerations with correlation {correlation:.2f} and gain {gain:.2f}, "
        f"yaw known to {error:.1f} deg{said}"
    )
    fits = correlation >= MIN_CORRELATION and GAIN_RANGE[0] <= gain <= GAIN_RANGE[1] and error <= MAX_ERROR_DEG
    along = _along(rotation[0] @ f[use].T, driven[use].real)
    return _Turn(rotation, correlation, error, samples, sign, along, fits, evidence, rate)


def _along(measured: FloatArray, driven: FloatArray) -> bool:
    """Return whether accelerating and braking alone show which way is forward."""
    spread = float(measured.std() * driven.std())
    return spread > 0.0 and float(np.mean((measured - measured.mean()) * (driven - driven.mean()))) / spread > 0.5


def _sign_of(rate: FloatArray, references: list[tuple[str, FloatArray]]) -> tuple[float, str]:
    """Return the correlation of the yaw rate with its best other measurement, and a text; 0 and empty without one."""
    best, said = 0.0, ""
    for text, reference in references:
        for relation in compare(law("gnss_path", name=""), reference, rate):
            if relation.samples >= MIN_SAMPLES and abs(relation.correlation) > max(SIGN_CORRELATION, abs(best)):
                best, said = relation.correlation, f", yaw rate against {text} {relation.correlation:.2f}"
    return best, said


def _snapped(whole: _Turn, parts: Sequence[_Turn | None]) -> FloatArray:
    """Return the nearest multiple of 90 degrees, with the remaining tilt and yaw if both parts of the drive agree."""
    step = nearest_step(whole.rotation)
    rests = [p.rotation @ step.T for p in parts if p is not None]
    is_precise = whole.correlation >= ASKEW_CORRELATION and whole.error_deg <= ASKEW_ERROR_DEG
    if not is_precise or whole.samples < ASKEW_SAMPLES or len(rests) < 2:
        return step
    rest = whole.rotation @ step.T
    yaw, *yaws = (math.degrees(math.atan2(r[1, 0] - r[0, 1], r[0, 0] + r[1, 1])) for r in (rest, *rests))
    angles = [math.copysign(y, y * yaw) for y in yaws]
    is_turned = all(a > TURNED_DEG for a in angles) and abs(yaw) > max(TURNED_DEG, 3.0 * whole.error_deg)
    is_turned &= abs(angles[0] - angles[1]) < max(PARTS_AGREE_DEG, PARTS_AGREE_SHARE * abs(yaw))
    # One of the parts may be a hill.
    *tilts, apart = (
        angle_deg(float(x)) for x in (rest[2, 2], rests[0][2, 2], rests[1][2, 2], rests[0][2] @ rests[1][2])
    )
    if min(tilts) > TURNED_DEG and apart < PARTS_AGREE_DEG:
        from scipy.spatial.transform import Rotation

        level_only = Rotation.align_vectors([[0.0, 0.0, 1.0]], [rest[2]])[0].as_matrix()
        return whole.rotation if is_turned else np.asarray(level_only @ step)
    if not is_turned:
        return step
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    return np.asarray(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ step)


# ------------------------------------------------------------------------------------- into the mapping


def turned_signals(
    mapping: Mapping, mounting: Mounting, triads: tuple[Triad | None, Triad | None]
) -> dict[str, SignalSource]:
    """Return the mapping's signals, rotated by the mounting of the sensor."""
    accelerations, rates = triads
    assert accelerations is not None and rates is not None
    signals = dict(mapping.signals)
    for i, name in enumerate(MOUNTED):
        if name in signals:
            signals[name] = (rates if i == 2 else accelerations).turned(signals[name], mounting.rows[i])
    for i, name in enumerate(("roll_rate_rad_s", "pitch_rate_rad_s")):
        if name in signals:
            signals[name] = rates.turned(signals[name], mounting.hand * mounting.rotation[i])
    return signals


def mounting_checks(mapping: Mapping, mounting: Mounting, triads: tuple[Triad | None, Triad | None]) -> list[Check]:
    """Return for each of the IMU's signals whether it is read from the axis that the drive shows."""
    turned = turned_signals(mapping, mounting, triads)
    checks = []
    for i, name in enumerate(MOUNTED):
        if name not in mapping.signals:
            continue
        right = np.allclose(mounting.rows[i], mounting.named[i], atol=1e-3)
        if right:
            if mounting.confident:
                checks.append(result("SIGNAL.mounting", "passed", name, evidence=mounting.evidence))
            continue
        evidence = f"{mounting.text}: {mounting.evidence}"
        entries = entries_of(turned[name], "field", "scale")
        check = result("SIGNAL.mounting", "failed", name, evidence=evidence, entries=entries)
        checks.append(check if mounting.confident else replace(check, verdict="undecided"))
    return checks
