"""Do the mapped signals obey rigid-body kinematics? Wrong signs and units show as a wrong gain between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import WHEELS, BoolArray, Channel, FloatArray

GRID_S = 0.05
#: −3 dB at 1 Hz: noise and vibration go, manoeuvres stay.
LOW_PASS_HZ = 1.0
#: Samples are interpolated onto the grid over gaps of at most this length.
MAX_GAP_S = 0.5
#: 21 hours about the middle of the drive; it keeps one wrong stamp from making a grid of decades.
MAX_CELLS = 1_500_000
#: Moving: faster than this share of the drive's fast speeds, and than a speed at which little can be told.
MOVING_SHARE = 0.25
MIN_MOVING_M_S = 0.5
#: Nothing is said from less driving than this.
MIN_MOVING_S = 10.0
#: Below this correlation a gain says nothing; above the lower one a sign is no chance either.
MIN_CORRELATION = 0.75
#: Gains between these are tyres, roll, bank, grade and noise; beyond them they are units.
GAIN_RANGE = (0.55, 1.8)
#: Both sides move by this much and yet have nothing to do with one another: another field was mapped.
UNRELATED_M_S2 = 1.0
UNRELATED_CORRELATION = 0.25
WHEEL_RANGE = (0.7, 1.4)
#: Angular over rim speed: wheels of 4 cm to 80 cm radius.
WHEEL_PER_RADIAN_RANGE = (1.25, 25.0)
#: Effective wheelbase L (1 + K v²) from road-wheel and from steering-wheel angles; m.
ROAD_WHEEL_LENGTH_M = (0.15, 12.0)
STEERING_WHEEL_LENGTH_M = (12.0, 240.0)

DEGREE = float(np.pi / 180.0)
G = 9.80665
#: Steering ratio for recognising that the two steering angles were exchanged.
TYPICAL_STEERING_RATIO = 16.0


@dataclass(frozen=True, slots=True)
class PlausibilityWarning:
    """Two mapped signals that contradict each other.

    Attributes
    ----------
    check : the relation that fails, in words.
    signals : names of the signals in it.
    suspects : those that explain this and all other checks when corrected; empty when no single one does.
    kind : ``sign``, ``unit`` or ``unrelated``.
    correlation, gain : of the relation after a 1 Hz low pass, where the car moves; the gain is signed.
    expected : the range of a plausible gain.
    message : one sentence for a person.
    """

    check: str
    signals: tuple[str, ...]
    suspects: tuple[str, ...]
    kind: str
    correlation: float
    gain: float
    expected: tuple[float, float]
    message: str

    def __str__(self) -> str:
        """Return the message."""
        return self.message


@dataclass(frozen=True, slots=True)
class _Check:
    """One relation with its measured gain; ``powers`` say how the gain grows with each signal's own scale.

    ``sides`` are the spreads of both sides; ``accelerations`` tells that they are in m/s² and so can be compared.
    """

    text: str
    powers: dict[str, int]
    correlation: float
    gain: float
    expected: tuple[float, float]
    sides: tuple[float, float]
    accelerations: bool = True

    @property
    def tells(self) -> bool:
        """Return whether the drive excites the relation enough for a verdict."""
        return abs(self.correlation) >= MIN_CORRELATION

    def accepts(self, factor: float = 1.0) -> bool:
        """Return whether the gain is plausible after multiplying it with ``factor``."""
        gain = self.gain * factor
        return self.expected[0] <= gain <= self.expected[1]

    @property
    def unrelated(self) -> bool:
        """Return whether both accelerations move, and not with one another."""
        low, high = sorted(self.sides)
        both_move = self.accelerations and low > UNRELATED_M_S2 and high < 5.0 * low
        return both_move and abs(self.correlation) < UNRELATED_CORRELATION

    def warning(self, kind: str, message: str, suspects: tuple[str, ...] = ()) -> PlausibilityWarning:
        """Return a warning of this relation."""
        signals = tuple(self.powers)
        text = f"{self.text}: {message}"
        return PlausibilityWarning(self.text, signals, suspects, kind, self.correlation, self.gain, self.expected, text)


@dataclass(frozen=True, slots=True)
class _Remedy:
    """A correction of one signal: multiply it by ``factor``."""

    signal: str
    factor: float
    words: str

    def acts_on(self, check: _Check) -> float:
        """Return what the correction multiplies the check's gain with."""
        return float(self.factor ** check.powers.get(self.signal, 0))


def plausibility_warnings(channels: Mapping[str, Channel]) -> tuple[PlausibilityWarning, ...]:
    """Return the contradictions between mapped signals; nothing is said where the drive does not excite a relation.

    Checked are yaw rate × speed against a_y, steering against yaw rate / speed, the derivative of the speed against
    a_x, and wheel speeds against the speed.

    Parameters
    ----------
    channels : mapped signals by name, SI. Truth is of no use here: it has a mapping of its own to be wrong.
    """
    grid = _common_grid(channels)
    if grid is None:
        return ()
    columns = {name: _on_grid(channel, *grid) for name, channel in channels.items() if channel.values.ndim == 1}
    speed_name = _speed_name(columns)
    warnings: list[PlausibilityWarning] = []
    checks: list[_Check] = []
    if speed_name is not None:
        speed = columns[speed_name]
        moving = _moving(speed)
        if np.count_nonzero(moving) * GRID_S >= MIN_MOVING_S:
            backwards = float(np.mean(speed[moving] < 0.0))
            if backwards > 0.5:
                warnings.append(_backwards_warning(speed_name, backwards))
                columns[speed_name] = speed = -speed
            checks += _motion_checks(columns, speed_name, speed, moving)
            checks += _wheel_checks(columns, speed_name, speed, moving)
    failed = [c for c in checks if c.tells and not c.accepts()]
    healing = [r for r in _remedies(columns, speed_name) if _heals(r, failed, checks)]
    warnings += [_gain_warning(c, _best(c, healing, failed)) for c in failed]
    warnings += [_unrelated_warning(c) for c in checks if c.unrelated]
    return tuple(warnings)


# ---------------------------------------------------------------------------------------------- columns


def _common_grid(channels: Mapping[str, Channel]) -> tuple[int, int] | None:
    """Return the first stamp (ns) and the number of cells of a uniform grid over the channels."""
    used = [c.stamps_ns for c in channels.values() if len(c) > 1]
    if not used:
        return None
    start, end = min(int(s[0]) for s in used), max(int(s[-1]) for s in used)
    reach = int(MAX_CELLS * GRID_S * 0.5e9)
    middle = int(np.median([int(s[s.shape[0] // 2]) for s in used]))
    start, end = max(start, middle - reach), min(end, middle + reach)
    return start, int((end - start) * 1e-9 / GRID_S) + 1


def _on_grid(channel: Channel, start_ns: int, cells: int) -> FloatArray:
    """Average a channel into the grid's cells and low-pass it; NaN in gaps."""
    nothing = np.full(cells, np.nan)
    if len(channel) < 2 or cells < 2:
        return nothing
    at = np.rint((channel.stamps_ns - start_ns) * (1e-9 / GRID_S)).astype(np.int64)
    inside = (at >= 0) & (at < cells)
    count = np.bincount(at[inside], minlength=cells).astype(np.float64)
    total = np.bincount(at[inside], weights=channel.values[inside], minlength=cells)
    known = np.flatnonzero(count > 0.0)
    if known.shape[0] < 2:
        return nothing
    cell = np.arange(cells)
    filled = np.interp(cell, known, total[known] / count[known])
    before = known[np.maximum(np.searchsorted(known, cell, side="right") - 1, 0)]
    after = known[np.minimum(np.searchsorted(known, cell), known.shape[0] - 1)]
    good = (after - before) * GRID_S <= MAX_GAP_S
    good &= (cell >= known[0]) & (cell <= known[-1])
    return _low_pass(filled, good)


def _low_pass(values: FloatArray, good: BoolArray) -> FloatArray:
    """Gaussian low pass of zero phase over the good cells; NaN where much of the kernel has none."""
    sigma = np.sqrt(np.log(2.0)) / (2.0 * np.pi * LOW_PASS_HZ) / GRID_S
    reach = int(np.ceil(4.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    weight = np.convolve(good.astype(np.float64), kernel, mode="same")[: values.shape[0]]
    total = np.convolve(np.where(good, values, 0.0), kernel, mode="same")[: values.shape[0]]
    out = np.full(values.shape[0], np.nan)
    enough = weight > 0.8
    out[enough] = total[enough] / weight[enough]
    return out


def _speed_name(columns: Mapping[str, FloatArray]) -> str | None:
    for name in ("speed_m_s", *(f"wheel_speed_{w}_m_s" for w in ("rl", "rr", "fl", "fr"))):
        if name in columns and np.isfinite(columns[name]).any():
            return name
    return None


def _moving(speed: FloatArray) -> BoolArray:
    finite = np.abs(speed[np.isfinite(speed)])
    if finite.shape[0] == 0:
        return np.zeros(speed.shape[0], np.bool_)
    limit = max(MIN_MOVING_M_S, MOVING_SHARE * float(np.quantile(finite, 0.9)))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(speed) > limit, dtype=np.bool_)


# ----------------------------------------------------------------------------------------------- checks


def _motion_checks(
    columns: Mapping[str, FloatArray], speed_name: str, speed: FloatArray, moving: BoolArray
) -> list[_Check]:
    checks: list[_Check] = []
    yaw, left, forward = (columns.get(n) for n in ("yaw_rate_rad_s", "ay_m_s2", "ax_m_s2"))
    if yaw is not None and left is not None:
        powers = {"ay_m_s2": 1, "yaw_rate_rad_s": -1, speed_name: -1}
        checks += _compare("yaw rate x speed against a_y", powers, yaw * speed, left, moving, GAIN_RANGE)
    for name, lengths in (("steer_rad", ROAD_WHEEL_LENGTH_M), ("steering_wheel_rad", STEERING_WHEEL_LENGTH_M)):
        steer = columns.get(name)
        if yaw is not None and steer is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                curvature = yaw / speed
            powers = {name: 1, "yaw_rate_rad_s": -1, speed_name: 1}
            checks += _compare(
                "steering against yaw rate / speed", powers, curvature, steer, moving, lengths, accelerations=False
            )
    if forward is not None:
        derivative = np.full(speed.shape[0], np.nan)
        derivative[1:-1] = (speed[2:] - speed[:-2]) / (2.0 * GRID_S)
        powers = {"ax_m_s2": 1, speed_name: -1}
        checks += _compare("speed derivative against a_x", powers, derivative, forward, moving, GAIN_RANGE)
    return checks


def _compare(
    text: str,
    powers: dict[str, int],
    reference: FloatArray,
    measured: FloatArray,
    moving: BoolArray,
    expected: tuple[float, float],
    *,
    accelerations: bool = True,
) -> list[_Check]:
    use = moving & np.isfinite(reference) & np.isfinite(measured)
    if np.count_nonzero(use) * GRID_S < MIN_MOVING_S:
        return []
    a, b = reference[use] - reference[use].mean(), measured[use] - measured[use].mean()
    spread_a, spread_b = float(a.std()), float(b.std())
    if spread_a <= 1e-12 or spread_b <= 1e-12:
        return []
    correlation = float(np.mean(a * b) / (spread_a * spread_b))
    # The ratio of the spreads lies between the two regressions, neither of which knows where the noise is.
    gain = float(np.copysign(spread_b / spread_a, correlation))
    return [_Check(text, powers, correlation, gain, expected, (spread_a, spread_b), accelerations)]


def _wheel_checks(
    columns: Mapping[str, FloatArray], speed_name: str, speed: FloatArray, moving: BoolArray
) -> list[_Check]:
    checks: list[_Check] = []
    for wheel in WHEELS:
        for name, expected in (
            (f"wheel_speed_{wheel}_m_s", WHEEL_RANGE),
            (f"wheel_speed_{wheel}_rad_s", WHEEL_PER_RADIAN_RANGE),
        ):
            column = columns.get(name)
            if column is None or name == speed_name:
                continue
            use = moving & np.isfinite(column)
            if np.count_nonzero(use) * GRID_S < MIN_MOVING_S:
                continue
            ratio = float(np.median(column[use] / speed[use]))
            # The same quantity twice: the ratio tells at any excitation.
            powers = {name: 1, speed_name: -1}
            checks.append(_Check(f"{name} over the speed", powers, 1.0, ratio, expected, (0.0, 0.0), False))
    return checks


# --------------------------------------------------------------------------------------------- verdicts


def _remedies(columns: Mapping[str, FloatArray], speed_name: str | None) -> list[_Remedy]:
    """List the mistakes that mappings are known to make, the simplest first; the speed's sign was looked at before."""
    units: dict[str, list[tuple[float, str]]] = {
        "yaw_rate_rad_s": [(DEGREE, "is in deg/s"), (1.0 / DEGREE, "was converted to rad/s twice")],
        "steer_rad": [
            (DEGREE, "is in degrees"),
            (1.0 / DEGREE, "was converted to rad twice"),
            (1.0 / TYPICAL_STEERING_RATIO, "is the steering-wheel angle"),
        ],
        "steering_wheel_rad": [
            (DEGREE, "is in degrees"),
            (1.0 / DEGREE, "was converted to rad twice"),
            (TYPICAL_STEERING_RATIO, "is the road-wheel angle"),
        ],
        "ax_m_s2": [(G, "is in g"), (1.0 / G, "was converted from g twice")],
        "ay_m_s2": [(G, "is in g"), (1.0 / G, "was converted from g twice")],
        "speed_m_s": [(1.0 / 3.6, "is in km/h"), (3.6, "was converted from km/h twice"), (0.44704, "is in mph")],
    }
    for wheel in WHEELS:
        units[f"wheel_speed_{wheel}_m_s"] = [
            (1.0 / 3.6, "is in km/h"),
            (3.6, "was converted from km/h twice"),
            (0.3, "is in rad/s"),
        ]
        units[f"wheel_speed_{wheel}_rad_s"] = [(2.0 * np.pi / 60.0, "is in rpm"), (1.0 / 0.3, "is in m/s")]
    out: list[_Remedy] = []
    for name in columns:
        factors = units.get(name, [])
        out += [_Remedy(name, factor, words) for factor, words in factors]
        if name != speed_name:
            out.append(_Remedy(name, -1.0, "has the wrong sign"))
            out += [_Remedy(name, -factor, f"{words} and has the wrong sign") for factor, words in factors]
    return out


def _heals(remedy: _Remedy, failed: list[_Check], checks: list[_Check]) -> bool:
    """Return whether a correction heals every failed check that it touches, at least one, and spoils none."""
    if not any(remedy.signal in c.powers for c in failed):
        return False
    return all(c.accepts(remedy.acts_on(c)) for c in checks if c.tells and remedy.signal in c.powers)


def _best(check: _Check, healing: list[_Remedy], failed: list[_Check]) -> list[_Remedy]:
    """Return the corrections of a check that heal most failed checks at once, for each signal the simplest kind."""
    here = [r for r in healing if r.signal in check.powers]
    reach = {r.signal: sum(r.signal in c.powers for c in failed) for r in here}
    kept: list[_Remedy] = []
    for remedy in here:
        if reach[remedy.signal] < max(reach.values()):
            continue
        simpler = [k for k in kept if k.signal == remedy.signal]
        # A sign explains without a unit, and either of them without the other.
        if not any(k.factor == -1.0 for k in simpler) and (remedy.factor > 0.0 or not simpler or remedy.factor == -1.0):
            kept.append(remedy)
    return kept


def _gain_warning(check: _Check, remedies: list[_Remedy]) -> PlausibilityWarning:
    suspects = tuple(dict.fromkeys(r.signal for r in remedies))
    kind = "sign" if check.accepts(-1.0) else "unit"
    reasons = " or ".join(f"{r.signal} {r.words}" for r in remedies)
    guess = reasons or f"no single mistake explains it, look at {', '.join(check.powers)}"
    low, high = check.expected
    message = (
        f"correlation {check.correlation:.2f}, gain {check.gain:.3g} where {low:g} to {high:g} is plausible; "
        f"perhaps {guess}"
    )
    return check.warning(kind, message, suspects)


def _unrelated_warning(check: _Check) -> PlausibilityWarning:
    message = (
        f"both move ({check.sides[0]:.2g} and {check.sides[1]:.2g} m/s^2) and yet their correlation is "
        f"{check.correlation:.2f}; perhaps another field or axis was mapped"
    )
    return check.warning("unrelated", message)


def _backwards_warning(speed_name: str, share: float) -> PlausibilityWarning:
    return PlausibilityWarning(
        check="direction of travel",
        signals=(speed_name,),
        suspects=(speed_name,),
        kind="sign",
        correlation=float("nan"),
        gain=-1.0,
        expected=(0.0, float("inf")),
        message=f"{speed_name} is negative in {share:.0%} of the moving time; perhaps {speed_name} has the wrong sign",
    )
