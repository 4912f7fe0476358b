"""Detection of standard manoeuvres in a recorded drive, by rules on steering, yaw rate, speed and acceleration.

The rules use sensors only, never ground truth. The steering angle is converted to a *demand*: the lateral acceleration
of a linear car in steady state, ``δ v² / (L (1 + v²/v_ch²))``. One threshold then suits all speeds and sizes of cars,
and does not depend on friction. A *swing* is the time in which the demand stays to one side; its duration is measured
at half its peak. All rules are mirror symmetric. The thresholds are in ``manoeuvres.toml``, the rules in
docs/metrics.md too.
"""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.smoothing import runs, smooth
from pdhef_logtool.records.signals import KM_H, S_PER_NS, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import last_known

#: Step of the grid, and rows of half a second.
_STEP_NS, _STEP_S, _HALF_S_ROWS = 20_000_000, 0.02, 25
#: The zero of the steering is computed from one row in this many.
_ZERO_EVERY = 10


#: Thresholds of the rules: ``manoeuvres.toml``.
RULES = SimpleNamespace(**tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")))
MANOEUVRES: tuple[str, ...] = tuple(RULES.names)


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in [start_ns, end_ns): a segment, a manoeuvre, a divergence."""

    name: str
    start_ns: int
    end_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Manoeuvre(Event):
    """A recognised manoeuvre: its first side (``left``, ``right``), the speed at its start, and its peaks."""

    side: str
    speed_m_s: float
    peak_ay_m_s2: float
    peak_yaw_rate_rad_s: float
    peak_steer_rad: float
    lowest_ax_m_s2: float


def find_manoeuvres(signals: Signals, vehicle: VehicleParameters) -> list[Manoeuvre]:
    """Return the manoeuvres of a drive in order of time, without overlaps."""
    wheelbase_m = vehicle.cg_to_front_axle_m + vehicle.cg_to_rear_axle_m
    zeros = _zeros(signals, wheelbase_m)
    manoeuvres = [m for run in _runs_of(signals, wheelbase_m, zeros) for m in _manoeuvres_of(run)]
    return sorted(manoeuvres, key=lambda m: m.start_ns)


def manoeuvre_masks(stamps_ns: IntArray, manoeuvres: Sequence[Manoeuvre]) -> dict[str, BoolArray]:
    """Return the mask [N] of each manoeuvre by name."""
    masks = {name: np.zeros(len(stamps_ns), dtype=np.bool_) for name in MANOEUVRES}
    for m in manoeuvres:
        masks[m.name][np.searchsorted(stamps_ns, m.start_ns) : np.searchsorted(stamps_ns, m.end_ns)] = True
    return masks


# ---- a run of samples without a gap, on a grid of 20 ms ----


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Columns [N] every 20 ms from ``start_ns``, in SI units.

    ``steer``: corrected by its zero; ``gain``: demand over steering; ``turn``: v r; ``curvature``: r / v, smoothed to
    1 Hz.
    """

    start_ns: int
    speed: FloatArray
    steer: FloatArray
    yaw_rate: FloatArray
    ax: FloatArray
    ay: FloatArray
    gain: FloatArray
    turn: FloatArray
    curvature: FloatArray

    def __len__(self) -> int:
        return len(self.speed)

    def rows(self, a: int, b: int) -> slice:
        return slice(max(a, 0), min(b, len(self)))


@dataclass(frozen=True, slots=True)
class _Swing:
    """Rows [start, end) with the demand to one side; its peak (m/s²) and duration at half the peak (s)."""

    start: int
    end: int
    row: int
    sign: int
    peak: float
    half_s: float


def _gain(speed_m_s: FloatArray, wheelbase_m: float) -> FloatArray:
    squared = speed_m_s**2
    return np.asarray(squared / (wheelbase_m * (1.0 + squared / RULES.characteristic_speed_m_s**2)))


def _zeros(signals: Signals, wheelbase_m: float) -> tuple[float, float]:
    """Return the readings of steering (rad) and gyro (rad/s) straight ahead.

    Steering: the median after subtraction of the steady-state angle; gyro: the median with straight wheels.
    """
    speed, rate = np.abs(last_known(signals.stamps_ns, signals.speed_m_s)), signals.yaw_rate_rad_s
    straight = (np.abs(rate * speed) < RULES.straight_m_s2) & (speed > RULES.least_speed_m_s)
    rows = np.flatnonzero(straight[::_ZERO_EVERY]) * _ZERO_EVERY
    steer, rates = signals.steer_rad[rows], rate[rows]
    left = steer - rates * speed[rows] / _gain(speed[rows], wheelbase_m)
    finite = left[np.isfinite(left)]
    zero = float(np.median(finite)) if finite.size else 0.0
    ahead = rates[np.abs(steer - zero) < RULES.wheels_straight_rad]
    return zero, float(np.median(ahead)) if ahead.size else 0.0


def _runs_of(signals: Signals, wheelbase_m: float, zeros: tuple[float, float]) -> Iterator[_Run]:
    """Yield the runs without gaps in which speed, yaw rate and steering are known."""
    stamps = signals.stamps_ns
    speed, yaw_rate = np.abs(last_known(stamps, signals.speed_m_s)), signals.yaw_rate_rad_s - zeros[1]
    steer = signals.steer_rad - zeros[0]
    if not np.isfinite(steer).any():  # curvature of the path instead
        with np.errstate(divide="ignore", invalid="ignore"):
            steer = yaw_rate * speed / _gain(speed, wheelbase_m)
    finite = np.isfinite(speed) & np.isfinite(yaw_rate) & np.isfinite(steer) & (speed > RULES.least_speed_m_s)
    usable = np.flatnonzero(finite)
    for a, b in runs(stamps[usable], finite[usable]):
        rows = usable[a:b]
        first, last = -(-int(stamps[rows[0]]) // _STEP_NS), int(stamps[rows[-1]]) // _STEP_NS
        grid_ns = np.arange(first, last + 1, dtype=np.int64) * _STEP_NS
        if len(grid_ns) * _STEP_S < 1.0:
            continue
        smoothed = partial(_on_grid, stamps[rows], grid_ns)
        v, r = smoothed(speed[rows], 2.0), smoothed(yaw_rate[rows], 3.0)
        yield _Run(
            start_ns=int(grid_ns[0]),
            speed=v,
            steer=smoothed(steer[rows], 5.0),
            yaw_rate=r,
            ax=smoothed(signals.ax_m_s2[rows], 2.0),
            ay=smoothed(signals.ay_m_s2[rows], 3.0),
            gain=_gain(v, wheelbase_m),
            turn=v * r,
            curvature=smoothed(yaw_rate[rows], 1.0) / v,
        )


def _on_grid(stamps_ns: IntArray, grid_ns: IntArray, values: FloatArray, cutoff_hz: float) -> FloatArray:
    """Return values [N] at stamps as a smoothed column of a grid [K]; 0 if all are unknown."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(len(grid_ns))
    times_s, to_s = ((t - stamps_ns[0]) * S_PER_NS for t in (stamps_ns[finite], grid_ns))
    return smooth(grid_ns, np.interp(to_s, times_s, values[finite]), cutoff_hz, _STEP_NS)


def _manoeuvres_of(run: _Run) -> list[Manoeuvre]:
    """Return the manoeuvres of a run; of two that overlap, the earlier rule of this list applies."""
    swings = _swings(run)
    spans: list[tuple[str, int, int]] = []
    taken = np.zeros(len(run), dtype=np.bool_)
    for rule in (_lane_changes, _repeated, _two_swings, _slowing, _steps, _ramps, _circles):
        for name, start, end in rule(run, swings):
            a, b = max(start, 0), min(end, len(run))
            if b - a > 1 and not taken[a:b].any():
                taken[a:b] = True
                spans.append((name, a, b))
    return [_measured(run, *span) for span in sorted(spans, key=lambda f: f[1])]


def _measured(run: _Run, name: str, a: int, b: int) -> Manoeuvre:
    steer, speed, lowest = run.steer[a:b], float(run.speed[a]), float(run.ax[a:b].min())
    ay, rate, angle = (float(np.abs(column[a:b]).max()) for column in (run.ay, run.yaw_rate, run.steer))
    side = "left" if steer[int(np.argmax(np.abs(steer) >= 0.5 * angle))] >= 0.0 else "right"
    text = (
        f"{side}, from {speed * KM_H:.0f} km/h, |a_y| to {ay:.1f} m/s², yaw rate to {np.degrees(rate):.0f}°/s, "
        f"road-wheel angle to {np.degrees(angle):.1f}°"
    )
    start_ns, end_ns = (run.start_ns + row * _STEP_NS for row in (a, b))
    return Manoeuvre(name, start_ns, end_ns, text, side, speed, ay, rate, angle, lowest)


def _spans(mask: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield the rows [a, b) of each part of a run in which a mask is true."""
    yield from runs(np.arange(len(mask), dtype=np.int64) * _STEP_NS, mask)


# ---- swings ----


def _swings(run: _Run) -> list[_Swing]:
    """Return the swings with a sufficient peak, in order."""
    demand = run.steer * run.gain
    swings = []
    for sign in (1, -1):
        side = sign * demand
        for a, b in _spans(side > RULES.swing_m_s2):
            row = a + int(np.argmax(side[a:b]))
            if side[row] >= RULES.least_peak_m_s2:
                half = side[a:b] >= 0.5 * side[row]
                first, last = int(np.argmax(half)), len(half) - int(np.argmax(half[::-1]))
                swings.append(_Swing(a, b, row, sign, float(side[row]), (last - first) * _STEP_S))
    return sorted(swings, key=lambda s: s.start)


def _repeated(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:  # noqa: ARG001
    """Yield slalom, continuous sine, sine sweep: swings of alternating sign with regular spacing."""
    for part in _regular_parts(swings):
        yield _name_of_repeated(part), part[0].start, part[-1].end


def _regular_parts(swings: Sequence[_Swing]) -> list[list[_Swing]]:
    """Return the chains of short swings to alternating sides, with regular spacing and enough swings."""
    short = [s for s in swings if s.half_s <= RULES.swing_s]
    part = short[:1]
    parts = [part]
    for before, swing in pairwise(short):
        follows = swing.sign != before.sign and (swing.start - before.end) * _STEP_S <= RULES.swing_gap_s
        spacing = np.diff([_middle(s) for s in (*part[-2:], swing)])
        if not follows or np.ptp(spacing) > RULES.regular * spacing.max():
            part = [before] if follows else []
            parts.append(part)
        part.append(swing)
    high = 0.8 * RULES.peak_m_s2
    return [p for p in parts if len(p) >= RULES.repeated and np.mean([s.peak for s in p]) >= high]


def _middle(swing: _Swing) -> float:
    return 0.5 * (swing.start + swing.end)


def _name_of_repeated(part: Sequence[_Swing]) -> str:
    spacing_s = np.diff([_middle(s) for s in part]) * _STEP_S
    frequency = 0.5 / spacing_s
    if len(part) >= RULES.sweep_repeated and frequency[-1] >= RULES.sweep_ratio * frequency[0]:
        return "sine-sweep"
    is_slow = len(part) < RULES.sweep_repeated or frequency.mean() < RULES.slalom_hz
    return "slalom" if is_slow else "continuous-sine"


def _lane_changes(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:
    """Yield double lane changes: out, back, and straight at the end, within the length of a course."""
    for i in range(len(swings)):
        for last in range(i + 3, min(i + 7, len(swings)) + 1):
            side_m = _side_lane_m(run, swings[i:last])
            if RULES.side_m[0] <= side_m <= RULES.side_m[1]:
                start, end = swings[i].start, swings[last - 1].end
                is_severe = side_m < RULES.severe_m and run.speed[start] < RULES.severe_m_s
                yield "dlc-3888-2" if is_severe else "dlc", start, end
                break


def _side_lane_m(run: _Run, swings: Sequence[_Swing]) -> float:
    """Return the distance over which the path is beyond half its offset; 0 if it is not a double lane change.

    In a double lane change, the path leaves to one side and returns once. Heading and offset return on average over the
    exit lane, in which the driver may steer.
    """
    sides = [s.sign for s in swings]
    changes = sum(a != b for a, b in pairwise(sides))
    if changes < 2 or sides[0] != sides[-1] or max(s.peak for s in swings) < RULES.strong_m_s2:
        return 0.0
    exit_rows = max(round(RULES.exit_m / float(run.speed[swings[-1].end - 1]) / _STEP_S), 1)
    here = run.rows(swings[0].start - 10, swings[-1].end + exit_rows)
    speed = run.speed[here]
    heading = np.cumsum(run.yaw_rate[here]) * _STEP_S
    offset = swings[0].sign * np.cumsum(speed * np.sin(heading)) * _STEP_S
    after = slice(min(swings[-1].end - here.start, len(offset) - 1), None)
    way, left = offset[: after.start + 1], float(offset[after].mean())
    peak = float(way.max())
    is_one = (
        RULES.offset_m[0] <= peak <= RULES.offset_m[1]
        and max(abs(left), way[-1]) <= RULES.returned * peak
        and np.abs(np.diff(way)).sum() <= (1.2 + RULES.sideways * (len(swings) - 3)) * (2.0 * peak - way[-1])
        and abs(heading[after].mean()) <= RULES.heading_left * np.abs(heading).max()
    )
    return float(speed[: len(way)][way > 0.5 * peak].sum()) * _STEP_S if is_one else 0.0


def _straight_before(run: _Run, row: int) -> bool:
    """Return whether the car drove straight before a row; True at the start of the run."""
    before = run.turn[max(row - round(RULES.straight_s / _STEP_S), 0) : max(row, 1)]
    return bool(np.mean(np.abs(before)) < RULES.straight_m_s2)


def _two_swings(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:
    """Yield sine steer, sine with dwell, fishhook: from straight ahead, two equally high swings to opposite sides."""
    for first, second in pairwise(swings):
        close = (second.start - first.end) * _STEP_S <= 0.5 * RULES.swing_gap_s
        low, high = sorted((first.peak, second.peak))
        if not close or first.sign == second.sign or low < RULES.equal_peaks * high or high < RULES.strong_m_s2:
            continue
        if not _straight_before(run, first.start):
            continue
        longer_s, period_s = second.half_s - first.half_s, 3.0 * first.half_s
        if first.half_s <= RULES.fishhook_first_s and second.half_s >= max(RULES.fishhook_s, 2.0 * first.half_s):
            yield "fishhook", first.start, second.end
        elif not RULES.sine_hz[0] <= 1.0 / period_s <= RULES.sine_hz[1]:
            continue
        elif RULES.dwell_s[0] <= longer_s <= RULES.dwell_s[1]:
            yield "sine-with-dwell", first.start, second.end
        elif min(first.half_s, second.half_s) >= RULES.sine_equal * max(first.half_s, second.half_s):
            yield "sine-steer", first.start, second.end


# ---- steps, ramps, circles, slowing in a turn ----


def _steps(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:
    """Yield steps (ISO 7401): from straight ahead to an angle within a short time, then held."""
    held_rows = round(RULES.held_s / _STEP_S)
    for swing in swings:
        if swing.end - swing.start < held_rows or swing.peak < RULES.peak_m_s2:
            continue
        if not _straight_before(run, swing.start):
            continue
        side = swing.sign * run.steer
        settle = swing.start + round(RULES.step_rise_s / _STEP_S)
        held = side[settle : settle + held_rows]
        if len(held) < held_rows:
            continue
        level = float(np.median(held))
        before = side[max(swing.start - _HALF_S_ROWS, 0) : settle]
        rise = np.flatnonzero(before >= 0.9 * level), np.flatnonzero(before <= 0.1 * level)
        tolerance = _tolerance(level, float(run.gain[settle]))
        if not rise[0].size or not rise[1].size or np.abs(held - level).max() > tolerance:
            continue
        if (rise[0][0] - rise[1][rise[1] < rise[0][0]].max(initial=0)) * _STEP_S <= RULES.step_rise_s:
            rest = np.abs(side[settle : swing.end] - level) > tolerance
            end = settle + int(np.argmax(rest)) if rest.any() else swing.end
            yield "step-steer", swing.start, end


def _ramps(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:
    """Yield ramps: the angle grows along a line for seconds, from straight ahead, at one speed."""
    for swing in swings:
        row = swing.start + int(np.argmax(np.abs(run.steer[swing.start : swing.end]))) + 1
        speed = run.speed[swing.start : row]
        n = int(np.argmin(np.append(np.abs(speed / speed[0] - 1.0) <= RULES.ramp_speed, False)))
        row = swing.start + n
        if n * _STEP_S < RULES.ramp_s or not _straight_before(run, swing.start):
            continue
        side = swing.sign * run.steer[swing.start : row]
        t = np.linspace(-1.0, 1.0, n)
        slope = float((t * side).mean() / (t * t).mean())
        misfit = np.sqrt(np.mean((side - side.mean() - slope * t) ** 2))
        rises = slope > 0.0 and side[-1] * run.gain[row - 1] >= RULES.ramp_m_s2
        if rises and misfit <= RULES.ramp_misfit * 2.0 * slope + 0.5 * RULES.slack_m_s2 / run.gain[row - 1]:
            yield "ramp-steer", swing.start, row


def _circles(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:  # noqa: ARG001
    """Yield circles (ISO 4138): half a circle or more with a curvature within a share of its median."""
    for sign in (1, -1):
        for a, b in _spans(sign * run.turn > RULES.circle_m_s2):
            start = a
            while start < b:
                level = float(np.median(run.curvature[start : min(start + 150, b)]))
                off = np.abs(run.curvature[start:b] / level - 1.0) > RULES.circle_share
                end = start + int(np.argmax(off)) if off.any() else b
                turned_rad = abs(float(run.yaw_rate[start:end].sum())) * _STEP_S
                if turned_rad >= RULES.circle_rad and (end - start) * _STEP_S >= RULES.circle_s:
                    yield "steady-circle", start, end
                start = max(end, start + _HALF_S_ROWS)


def _slowing(run: _Run, swings: Sequence[_Swing]) -> Iterator[tuple[str, int, int]]:  # noqa: ARG001
    """Yield braking (ISO 7975) and power-off (ISO 9816): the car slows in a steady turn while the steering is held."""
    pre, ahead, lag = round(RULES.turn_s / _STEP_S), round(RULES.slowing_s / _STEP_S), 15
    n = len(run)
    if n < pre + ahead + lag:
        return
    total = np.concatenate([[0.0], np.cumsum(run.ax)])
    rows = np.arange(pre, n - ahead - lag)
    before = (total[rows] - total[rows - pre]) / pre
    change = (total[rows + lag + ahead] - total[rows + lag]) / ahead - before
    for a, b in _spans(change < -RULES.power_off_m_s2):
        row = a + int(np.argmin(change[a:b]))
        first = int(rows[row])
        fallen = run.ax[first : first + 40] < before[row] + 0.25 * change[row]  # by a quarter of its change
        onset = max(first + int(np.argmax(fallen)), pre)
        fall, turn = -float(change[row]), float(np.mean(np.abs(run.turn[onset - pre : onset])))
        if turn < RULES.turn_m_s2 or not _steady_before(run, onset, pre, ahead):
            continue
        over = run.ax[onset : onset + round(RULES.longest_slowing_s / _STEP_S)] > before[row] - 0.5 * fall
        over[:_HALF_S_ROWS] = False
        end = onset + (int(np.argmax(over)) if over.any() else len(over))
        if (end - onset) * _STEP_S >= RULES.slowing_s:
            braked = fall >= min(RULES.brake_m_s2, max(RULES.gentle_brake_m_s2, RULES.brake_share * turn))
            yield "brake-in-turn" if braked else "power-off-in-turn", onset - pre, end


def _steady_before(run: _Run, onset: int, pre: int, ahead: int) -> bool:
    """Return whether speed and steering were held before, and the steering after."""
    speed = run.speed[onset - pre : onset]
    level = float(np.mean(run.steer[onset - pre : onset]))
    steer = run.steer[onset - pre : onset + ahead]
    tolerance = _tolerance(level, float(run.gain[onset]))
    return bool(np.ptp(speed) <= RULES.turn_speed * speed.mean() and np.abs(steer - level).max() <= tolerance)


def _tolerance(level_rad: float, gain: float) -> float:
    """Return the tolerance of a held steering angle in rad."""
    return float(RULES.held * abs(level_rad) + RULES.slack_m_s2 / gain)
