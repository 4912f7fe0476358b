"""Mounting of an IMU in the car, from gravity, speed and yaw rate.

The mean specific force minus the accelerations of the car points up; the rate about that axis is the yaw rate. In the
car's axes, the level accelerations are (v̇, v r). A complex regression gives the angle about the vertical that rotates
the sensor's axes to these; its correlation, gain and error decide whether the mounting is accepted.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.check_table import result
from pdhef_logtool.drive.columns import derivative, fit, independent_samples, moving_at
from pdhef_logtool.drive.measured import Measured
from pdhef_logtool.drive.relations import DRIVEN, compare, gentle_at, law, steering_references, yaw_references
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping, SignalSource
from pdhef_logtool.mapping.checking import has_path
from pdhef_logtool.mapping.mapping_file import entries_of
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import LEAST_DIVISOR, FloatArray

#: Below this mean acceleration, the sensor's software has subtracted gravity.
COMPENSATED_M_S2 = 3.0
#: Least correlation of the level accelerations with speed and yaw rate in the correct axes; the rest is sideslip, roll,
#: grade, crossfall and noise.
MIN_CORRELATION = 0.75
#: Plausible gain of the regression. Outside, a unit is wrong and the angle is unknown.
GAIN_RANGE = (0.5, 2.0)
#: Largest standard error of the angle for a multiple of 90 degrees: three errors are half of 45 degrees.
MAX_ERROR_DEG = 7.5
#: A mounting is a multiple of 90 degrees unless it differs by more than this and by ``SURE_STD`` standard errors.
#: Grade, crossfall and bias are 0.5 m/s^2 over 20 s, 3 degrees of tilt; sideslip causes 2 degrees of yaw.
TURNED_DEG = 4.0
ASKEW_SAMPLES, SURE_STD = 40.0, 3.0
ASKEW_CORRELATION, ASKEW_ERROR_DEG = 0.85, 1.5
#: Least correlation of the yaw rate with another measurement that decides its sign, and its independent samples (5 s).
SIGN_CORRELATION, MIN_SAMPLES = 0.5, 10.0
#: Words for the axes of a rate, x first.
_RATE_WORDS = ("roll", "pitch", "yaw")
#: Temporary names of the components; they differ from all signal names.
ACCELERATIONS = tuple(f"triad.acceleration.{axis}" for axis in "xyz")
RATES = tuple(f"triad.rate.{axis}" for axis in "xyz")
#: Rows of a mounting: forward and left from the accelerometer, up from the gyro.
MOUNTED = ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")
#: A mean acceleration in this range is gravity.
IS_GRAVITY_M_S2 = (0.75 * GRAVITY_M_S2, 1.25 * GRAVITY_M_S2)

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


def find_triads(log: DriveLog, mapping: Mapping) -> tuple[Triad, Triad] | None:
    """Return the triads of accelerations and of rates with an axis in the mapping; None without one of them."""
    accelerations, rates = (_triad(log, mapping, names) for names in (("ay_m_s2", "ax_m_s2"), ("yaw_rate_rad_s",)))
    return None if accelerations is None or rates is None else (accelerations, rates)


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
    if index := re.fullmatch(r"(.*[\[_])(\d+)(\]?)", path):
        start = int(index[2]) - int(index[2]) % 3
        a, b, c = (f"{index[1]}{start + i}{index[3]}" for i in range(3))
        yield a, b, c
    leaf = path.rfind(".") + 1
    for words in (_RATE_WORDS, ("x", "y", "z")):
        for match in reversed([*re.finditer("|".join(words), path[leaf:], re.IGNORECASE)]):
            start, end = (leaf + place for place in match.span())
            written = (w.capitalize() if path[start].isupper() else w for w in words)
            a, b, c = (path[:start] + w + path[end:] for w in written)
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


def nearest_step(rotation: FloatArray) -> FloatArray:
    """Return the nearest rotation [3, 3] by multiples of 90 degrees."""
    rows = np.eye(3)[list(permutations(range(3)))]
    steps = np.concatenate([rows * np.array(signs)[:, None] for signs in product((1.0, -1.0), repeat=3)]) + 0.0
    steps = steps[np.linalg.det(steps) > 0.0]
    return np.asarray(steps[np.argmax(np.sum(steps * rotation, axis=(1, 2)))])


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Rotation [3, 3] from the sensor's axes to forward, left, up, with its evidence.

    ``named``: the rows [3, 3] that the mapping reads now, 0 where it lacks a signal. ``confident``: the rotation may be
    applied. The sign of a left-handed sensor's rate is that of the signal (:mod:`~.hypotheses`).
    """

    triads: tuple[Triad, Triad]
    rotation: FloatArray
    named: FloatArray
    evidence: str
    confident: bool

    @property
    def is_as_named(self) -> bool:
        """Whether the mapping reads the axes that it should."""
        return all(np.allclose(r, n, atol=1e-3) for r, n in zip(self.rotation, self.named, strict=True) if n.any())

    @property
    def text(self) -> str:
        """The rotation as text."""
        roll, pitch, yaw = (
            round(a) + 0 if abs(a - round(a)) < 0.05 else round(a, 1) for a in angles_deg(self.rotation)
        )
        return f"the IMU is mounted with roll {roll:g}, pitch {pitch:g}, yaw {yaw:g} deg"

    def turned(self, mapping: Mapping) -> dict[str, SignalSource]:
        """Return the signals of a mapping, rotated by the mounting of the sensor."""
        signals, (accelerations, rates) = mapping.signals, self.triads
        triads = dict(zip(MOUNTED, zip((accelerations, accelerations, rates), self.rotation, strict=True), strict=True))
        triads |= {"roll_rate_rad_s": (rates, self.rotation[0]), "pitch_rate_rad_s": (rates, self.rotation[1])}
        turned = {n: triad.turned(signals[n], row) for n, (triad, row) in triads.items() if n in signals}
        return signals | turned

    def checks(self, mapping: Mapping) -> tuple[Check, ...]:
        """Return for each of the IMU's signals whether it is read from the axis that the drive shows."""
        turned, checks = self.turned(mapping), []
        for name, rotation, named in zip(MOUNTED, self.rotation, self.named, strict=True):
            if name not in mapping.signals:
                continue
            if np.allclose(rotation, named, atol=1e-3):
                if self.confident:
                    checks.append(result("SIGNAL.mounting", "passed", name, evidence=self.evidence))
                continue
            evidence = f"{self.text}: {self.evidence}"
            entries = entries_of(turned[name], "field", "scale")
            check = result("SIGNAL.mounting", "failed", name, evidence=evidence, entries=entries)
            checks.append(check if self.confident else replace(check, verdict="undecided"))
        return tuple(checks)


def find_mounting(measured: Measured, triads: tuple[Triad, Triad] | None, mapping: Mapping) -> Mounting | None:
    """Find the rotation of an IMU from its six components; None without them, or if the drive does not show it.

    ``measured`` contains the components of the triads. Ground truth, if any, gives the sign of the yaw rate.
    """
    columns, speed_name = measured.columns, measured.speed_name
    if triads is None or not all(n in columns for n in (*ACCELERATIONS, *RATES)):
        return None
    f, w = (np.stack([columns[n] for n in names], axis=1) for names in (ACCELERATIONS, RATES))
    named = named_rows(mapping, triads)
    speed = np.full(f.shape[0], np.nan) if speed_name is None else columns[speed_name]
    references = yaw_references(columns, speed_name)
    ups = _ups(f, w, named)
    if len(ups) > 1 and not references:  # gravity does not show which way is up
        references = steering_references(columns, speed_name)
    turns = [turn for up in ups if (turn := _turned(f, w, speed, up, references)) is not None]
    if not turns:
        return None
    best = max(turns, key=lambda x: x.correlation + np.sign(x.sign))
    mounting = Mounting(triads, _snapped(best), named, best.evidence, _is_shown(best, measured))
    # Grade and crossfall alone move an accelerometer by less: in gentler driving, blocks of the drive must agree.
    is_driven = best.driven_m_s2 > DRIVEN["ay_m_s2"] and best.correlation >= ASKEW_CORRELATION
    is_sure = is_driven or best.errors_deg[0] <= MAX_ERROR_DEG or mounting.is_as_named
    return replace(mounting, confident=mounting.confident and is_sure)


def _is_shown(turn: "_Turn", measured: Measured) -> bool:
    """Return whether another measurement of the yaw rate, the speed or the steering confirms a rotation.

    Steering that counts to the left confirms gravity, and is no evidence against it: its sign is no standard.
    """
    if turn.sign != 0.0 or turn.along:
        return turn.sign > 0.0 or turn.along
    return _sign_of(turn.rate, steering_references(measured.columns, measured.speed_name))[0] > 0.0


def named_rows(mapping: Mapping, triads: tuple[Triad, Triad]) -> FloatArray:
    """Return the rows [3, 3] of the sensor's axes that a mapping reads, 0 where it lacks one."""
    named, (accelerations, rates) = np.zeros((3, 3)), triads
    for row, name, triad in zip(named, MOUNTED, (accelerations, accelerations, rates), strict=True):
        if name in mapping.signals:
            row[:] = triad.row(mapping.signals[name])
    return named


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """A rotation for one choice of the vertical, with its fit to the drive.

    ``error_deg``: standard error of yaw by the residual. ``errors_deg``: of yaw and of the tilt by blocks of the drive,
    infinite on a short one.
    ``sign``: correlation of the yaw rate with another measurement, 0 without one. ``along``: the speed alone shows
    which way is forward. ``rate``: yaw rate. ``driven_m_s2``: 1-sigma of the level acceleration by speed and yaw rate.
    """

    rotation: FloatArray
    correlation: float
    error_deg: float
    errors_deg: tuple[float, float]
    sign: float
    along: bool
    evidence: str
    rate: FloatArray
    driven_m_s2: float


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
    """Return the rotation about a vertical [3]; None if it does not fit the drive."""
    moving, axis, mean = moving_at(speed), up, up
    for _ in range(3):  # iterates, because the accelerations of the drive tilt the mean slightly
        e1 = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        e1 /= np.linalg.norm(e1)
        e2 = np.cross(axis, e1)
        rate, level = w @ axis, f @ e1 + 1j * (f @ e2)
        # A sensor away from the CG also measures a term in proportion to the yaw acceleration.
        driven = [derivative(speed) + 1j * speed * rate, 1j * derivative(rate)]
        used = moving & np.isfinite(level + driven[0] + driven[1])
        sides = [_sides(k * c) for c in (*driven, np.ones(len(rate), np.complex128)) for k in (1.0 + 0j, 1j)]
        solved = fit(_sides(level), sides, np.repeat(used, 2), 2.5)
        if solved is None:
            return None
        (real, imaginary, *_, left1, left2), errors, spread = solved
        factor, cosine_error, sine_error = complex(real, imaginary), *errors[:2]
        forward = (factor.real * e1 + factor.imag * e2) / abs(factor)
        rotation = np.stack([forward, np.cross(axis, forward), axis])
        upward = float(np.mean(f[used] @ axis))
        mean = upward * axis + left1 * e1 + left2 * e2
        if np.linalg.norm(mean) > COMPENSATED_M_S2:
            axis = mean / np.linalg.norm(mean)
    gain, samples = abs(factor), independent_samples(used)
    power = float(np.var(level[used])) / 2.0
    unexplained = spread**2 * (1.0 - len(errors) / (2.0 * samples)) / power if power > 0.0 else 1.0
    correlation = math.sqrt(max(0.0, 1.0 - unexplained))
    error = math.degrees(math.sqrt(unexplained / (2.0 * samples)) / max(correlation, LEAST_DIVISOR))
    turn_error = math.degrees(math.hypot(imaginary * cosine_error, real * sine_error) / max(gain, LEAST_DIVISOR) ** 2)
    tilt_error = math.degrees(math.hypot(*errors[-2:]) / GRAVITY_M_S2)
    by_blocks = (turn_error, tilt_error) if samples >= ASKEW_SAMPLES else (math.inf, math.inf)
    sign, said = _sign_of(np.where(gentle_at(speed * rate, moving), rate, np.nan), references)
    if sign == 0.0:
        sign, said = _sign_of(rate, references)
    evidence = (
        f"speed and yaw rate explain the level accelerations with correlation {correlation:.2f} and gain {gain:.2f}, "
        f"yaw known to {error:.1f} deg{said}"
    )
    if not (correlation >= MIN_CORRELATION and GAIN_RANGE[0] <= gain <= GAIN_RANGE[1] and error <= MAX_ERROR_DEG):
        return None
    ahead = compare(law("longitudinal", of="", pace=""), driven[0].real, f @ rotation[0], used)
    along = any(r.correlation > SIGN_CORRELATION for r in ahead)
    return _Turn(rotation, correlation, error, by_blocks, sign, along, evidence, rate, float(np.std(driven[0][used])))


def _sides(column: NDArray[Any]) -> FloatArray:
    """Return the real and imaginary parts of a column [N] in turn, [2 N]."""
    return np.stack([column.real, column.imag], axis=1).ravel()


def _sign_of(rate: FloatArray, references: list[tuple[str, FloatArray]]) -> tuple[float, str]:
    """Return the correlation of the yaw rate with its best other measurement, and a text; 0 and empty without one."""
    best, said = 0.0, ""
    for text, reference in references:
        for relation in compare(law("gnss_path", name=""), reference, rate):
            if relation.samples >= MIN_SAMPLES and abs(relation.correlation) > max(SIGN_CORRELATION, abs(best)):
                best, said = relation.correlation, f", yaw rate against {text} {relation.correlation:.2f}"
    return best, said


def _snapped(turn: _Turn) -> FloatArray:
    """Return the nearest multiple of 90 degrees, or the rotation itself if the drive shows that it differs."""
    step = nearest_step(turn.rotation)
    cosine = float(np.clip(0.5 * (np.trace(turn.rotation @ step.T) - 1.0), -1.0, 1.0))
    is_certain = turn.correlation >= ASKEW_CORRELATION and turn.error_deg <= ASKEW_ERROR_DEG
    is_askew = math.degrees(math.acos(cosine)) > max(TURNED_DEG, SURE_STD * math.hypot(*turn.errors_deg))
    return turn.rotation if is_certain and is_askew else step
