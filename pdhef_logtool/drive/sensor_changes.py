"""Sensors that change in mid-drive: a bias of gyro or accelerometer that jumps, and steering or speed that freezes.

Two relations that every car on wheels obeys are fitted to the drive so far, by least squares over means of
``MEAN_CELLS`` cells (docs/method.md#changes):

* kinematics: a_y = b · [1, v_x r, ṙ, d(v_x r)/dt, v_x d(v_x r)/dt] (bias, roll, lever arm, v̇_y of the rear axle);
* steering: δ = c · [1, r / v_x, v_x r, ṙ] (offset, wheelbase, understeer, yaw inertia).

At each cell, a generalised likelihood ratio test compares the residuals in the windows after it with the window before
it, in units of the same statistic in the drive so far:

* gyro: its samples have a step that the kinematic residual confirms, or the steering residual if that of the kinematics
  is too noisy, and neither contradicts;
* a_y: the residual of the kinematics has a flat step, and the steering residual excludes that the car changed its
  motion; or it does not decide, and of the samples of both sensors only those of a_y have the step. A slide moves the
  steering residual too; a banked road begins slowly.
* frozen: a value repeats for longer than the share of repetitions so far explains by chance (probability
  ``CHANCE``), and either the other sensors show that it changes (the steering relation, or a_x for the speed), or
  the steering repeats ``LONGER`` times as long as any value before.

The decision is made ``DECIDED_CELLS`` after the change, from samples up to then, and corrections begin then, so that
causal estimators stay causal.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals

#: Cells of the grid; means of the relations; a window after a change, of three, behind the low pass, and the window
#: before it.
CELL_S, MEAN_CELLS, PART_CELLS, PARTS = 0.05, 5, 9, 3
#: The largest statistic of this many cells is the time of the change.
PEAK_CELLS = 5
WINDOW_CELLS = MEAN_CELLS + PARTS * PART_CELLS
DECIDED_CELLS = WINDOW_CELLS + PEAK_CELLS + 1
#: Longest time between samples that has its cells; longer gaps take as many.
LONGEST_GAP_S = 1.0
#: Cells of driving before the first decision, and the speed above which the relations apply.
LEAST_CELLS, LEAST_SPEED_M_S = 40, 3.0
#: Alarm level and level of confirmation in standard deviations of a statistic, and the least standard deviations.
ALARM, SURE = 4.0, 3.0
LEAST_AY_STD, LEAST_STEER_STD, LEAST_GYRO_STD = 0.06, 0.0005, 0.003
#: Smallest jumps that are reported. The crossfall of a road changes a_y by 0.5 m/s² from lane to lane.
LEAST_AY_JUMP_M_S2, LEAST_GYRO_JUMP_RAD_S = 0.6, 0.02
#: Samples beside a step of the gyro, s; largest relative difference of steps that agree, and of an absent one.
STEP_S, AGREES, ABSENT = 0.05, 0.5, 0.35
#: A reading repeats by chance with this probability; shortest time that is reported.
CHANCE, LEAST_STUCK_S = 1e-6, 0.3
#: Change that a stuck channel has missed: of the steering relation, with its standard deviations; of the speed by a_x
#: against the mean a_x of the time before.
LEAST_STEER_CHANGE_RAD, MISSED, LEAST_SPEED_CHANGE_M_S, GRADE_S = 0.006, 5.0, 1.5, 5.0
#: Samples of a coarse signal, half of them repetitions, that are assumed before a drive.
FEW_SAMPLES = 10.0
#: Share of the usual step of a value below which an accelerometer or a gyro repeats it.
LEAKED = 0.1
#: A value is stuck without a change that it misses if it repeats this many times as long as any value before, in a
#: drive of at least this time.
LONGER, SEEN_S = 4, 20.0
#: Cells with the information of one independent sample; share of prior information, of the value 0.
INDEPENDENT_CELLS, RIDGE = 10.0, 1e-3
#: Largest number of changes of a drive.
MOST_CHANGES = 8


@dataclass(frozen=True, slots=True)
class SensorChange:
    """One change of one sensor.

    Attributes
    ----------
    sensor, kind : signal; ``jump`` of its bias by ``size`` ± ``std``, or ``stuck`` at ``size``; ``std`` is then of the
        values that replace it.
    start_ns, known_ns, end_ns : of the change, of its correction, and of a stuck value's end.
    """

    sensor: str
    kind: str
    start_ns: int
    known_ns: int
    end_ns: int
    size: float
    std: float


class Cells(NamedTuple):
    """Cell of each stamp [N], and means of the signals in the cells [n]; NaN without a recent sample."""

    stamps_ns: IntArray
    of_stamp: IntArray
    ay: FloatArray
    yaw_rate: FloatArray
    steer: FloatArray
    speed: FloatArray
    ax: FloatArray

    def time_of(self, cell: int) -> int:
        """Return the first stamp in a cell or behind it."""
        row = int(np.searchsorted(self.of_stamp, cell))
        return int(self.stamps_ns[row]) if row < len(self.stamps_ns) else int(self.stamps_ns[-1]) + 1


class _Relation(NamedTuple):
    """A measured column and its regressors [n, 1 + m], with the fit to the drive before each cell.

    Attributes
    ----------
    fit : coefficients [n, m]; NaN before ``LEAST_CELLS``. information : of the regressors [n, m, m].
    """

    table: FloatArray
    fit: FloatArray
    information: FloatArray

    def residual(self, table: FloatArray) -> FloatArray:
        """Return the part of the first column of a table [n, 1 + m] that the others do not explain, [n]."""
        return np.asarray(table[:, 0] - (table[:, 1:] * self.fit).sum(axis=1))

    def leverage(self, change: FloatArray) -> FloatArray:
        """Return the factor on the 1-sigma of a residual that an uncertain fit has for changed regressors [n, m]."""
        change = np.nan_to_num(change)
        share = (change * np.linalg.solve(self.information, change[..., None])[..., 0]).sum(axis=1)
        return np.asarray(np.sqrt(1.0 + INDEPENDENT_CELLS * share))


def find_changes(signals: Signals, ignored: Collection[str] = ()) -> tuple[Signals, tuple[SensorChange, ...]]:
    """Return the signals [N] without the changes of their sensors, and the changes in order of time.

    A jump is subtracted, stuck steering is replaced by the steering relation, other stuck values are missing. Changes
    of ``ignored`` signals are kept.
    """
    if len(signals) < 2:
        return signals, ()
    cells = cells_of(signals)
    sound, changes = _without_stuck(signals, cells, [n for n in ("steer_rad", "speed_m_s") if n not in ignored])
    fitted, after_ns = _without_repeats(sound, cells), 0
    while len(changes) < MOST_CHANGES and (jump := _first_jump(fitted, after_ns, ignored)) is not None:
        changes.append(jump)
        after_ns = jump.start_ns
        fitted = shifted(fitted, jump.sensor, -jump.size, jump.start_ns, jump.end_ns)
        sound = shifted(sound, jump.sensor, -jump.size, jump.known_ns, jump.end_ns)
    return sound, tuple(sorted(changes, key=lambda c: c.start_ns))


def shifted(signals: Signals, name: str, by: float, start_ns: int, end_ns: int) -> Signals:
    """Return signals with a value added to one column in [start, end)."""
    column = getattr(signals, name) + np.where((signals.stamps_ns >= start_ns) & (signals.stamps_ns < end_ns), by, 0.0)
    return replace(signals, **{name: column})


# ------------------------------------------------------------------------------------------------ relations


def cells_of(signals: Signals) -> Cells:
    """Average the samples of each cell; a cell without one repeats the last, for up to a tenth of a second."""
    steps_ns = np.diff(signals.stamps_ns, prepend=signals.stamps_ns[0])
    cell = np.cumsum(np.minimum(steps_ns, round(LONGEST_GAP_S * 1e9))) // round(CELL_S * 1e9)
    count = int(cell[-1]) + 1

    def mean(column: FloatArray, most: int) -> FloatArray:
        finite = np.isfinite(column)
        samples = np.bincount(cell[finite], minlength=count)
        total = np.bincount(cell[finite], weights=column[finite], minlength=count)
        last = np.maximum.accumulate(np.where(samples > 0, np.arange(count), -1))
        fresh = (last >= 0) & (np.arange(count) - last <= most)
        return np.where(fresh, total[last] / np.maximum(samples[last], 1), np.nan)

    s = signals
    columns = (s.ay_m_s2, s.yaw_rate_rad_s, s.steer_rad, s.speed_m_s, s.ax_m_s2)
    return Cells(signals.stamps_ns, cell, *map(mean, columns, (2, 2, 2, 10, 2)))


def _mean(column: FloatArray, start: int, end: int) -> FloatArray:
    """Return the mean over cells k + start to k + end of a column [n] or [n, c]; NaN where a cell is not finite."""
    n = len(column)
    sums = np.concatenate([np.zeros_like(column[:1]), np.cumsum(np.nan_to_num(column), axis=0)])
    gaps = np.concatenate([np.zeros_like(column[:1]), np.cumsum(~np.isfinite(column), axis=0)])
    k = np.arange(n)
    first, last = np.clip(k + start, 0, n), np.clip(k + end, 0, n)
    finite = ((k + start >= 0) & (k + end <= n)).reshape((-1, *[1] * (column.ndim - 1))) & (gaps[first] == gaps[last])
    return np.where(finite, (sums[last] - sums[first]) / (end - start), np.nan)


def _relations(cells: Cells) -> tuple[_Relation, _Relation]:
    """Return the relations of kinematics and steering."""
    ay, r, steer, v, _ = (_mean(column, 1 - MEAN_CELLS, 1) for column in cells[2:])
    v = np.where(v > LEAST_SPEED_M_S, v, np.nan)
    constant, turning = np.ones_like(v), v * r

    def rate(column: FloatArray) -> FloatArray:
        before = np.concatenate([np.full(MEAN_CELLS, np.nan), column[:-MEAN_CELLS]])[: len(column)]
        return np.asarray((column - before) / (MEAN_CELLS * CELL_S))

    kinematics = np.stack([ay, constant, turning, rate(r), rate(turning), v * rate(turning)], axis=1)
    return _fitted(kinematics), _fitted(np.stack([steer, constant, r / v, turning, rate(r)], axis=1))


def _fitted(table: FloatArray) -> _Relation:
    """Regress the first column of a table [n, 1 + m] on the others, over the rows before each."""
    finite = np.asarray(np.isfinite(table).all(axis=1))
    rows = np.where(finite[:, None], table, 0.0)
    products = np.cumsum(rows[:, :, None] * rows[:, None, :], axis=0)
    products = np.concatenate([np.zeros_like(products[:1]), products[:-1]])
    square = products[:, 1:, 1:] * (1.0 + RIDGE * np.eye(table.shape[1] - 1)) + 1e-9 * np.eye(table.shape[1] - 1)
    fit = np.linalg.solve(square, products[:, 1:, :1])[..., 0]
    return _Relation(table, np.where(np.cumsum(finite)[:, None] > LEAST_CELLS, fit, np.nan), square)


# ------------------------------------------------------------------------------------------------ jumps


class _Step(NamedTuple):
    """Step of a residual behind each cell [n]: mean of the windows after it, whether it is sharp, and its 1-sigma."""

    size: FloatArray
    is_sharp: BoolArray
    std: FloatArray

    def confirms(self, other: FloatArray) -> BoolArray:
        """Return where this step equals another one and is significant."""
        return (np.abs(self.size) > SURE * self.std) & (np.abs(self.size - other) < AGREES * np.abs(other))

    def contradicts(self, other: FloatArray) -> BoolArray:
        """Return where another step differs by more than the uncertainty; False where this one is not finite."""
        return np.abs(self.size - other) > AGREES * np.abs(other) + SURE * self.std

    def excludes(self, other: FloatArray, std: FloatArray) -> BoolArray:
        """Return where another step with this 1-sigma is absent, although it would be significant."""
        return (np.abs(other) < ABSENT * np.abs(self.size)) & (np.abs(self.size) > SURE * std)

    def scaled(self, by: FloatArray) -> _Step:
        """Return the step in another unit."""
        return _Step(self.size * by, self.is_sharp, self.std * np.abs(by))


def _step(relation: _Relation, least_std: float) -> _Step:
    """Return the step of a relation's residual behind each cell, with the fit of the drive before it.

    A sharp step has its size within ``2 MEAN_CELLS`` cells, and the residual is flat on both sides.
    """
    table = relation.table
    before = _mean(table, -PART_CELLS, 0)
    starts = [MEAN_CELLS + i * PART_CELLS for i in range(PARTS)]
    changes = [_mean(table, s, s + PART_CELLS) - before for s in starts]
    size, change = np.mean([relation.residual(c) for c in changes], axis=0), np.mean(changes, axis=0)
    short = _mean(table, MEAN_CELLS, MEAN_CELLS + 1) - _mean(table, -1, 0)
    earlier = relation.residual(before - _mean(table, -2 * PART_CELLS, -PART_CELLS))
    is_sharp = np.abs(earlier) < AGREES * np.abs(size)
    for part in (*map(relation.residual, (*changes, short)), short[:, 0] - short[:, 2]):
        is_sharp &= np.abs(part - size) < AGREES * np.abs(size)
    leverage = relation.leverage(change[:, 1:])
    return _Step(size, is_sharp, _std_so_far(size / leverage, least_std) * leverage)


def _std_so_far(column: FloatArray, least: float) -> FloatArray:
    """Return the RMS of a column over the cells that were decided before each; inf before ``LEAST_CELLS``."""
    finite = np.isfinite(column)
    late = WINDOW_CELLS + PEAK_CELLS
    count, total = (
        np.concatenate([np.zeros(late), np.cumsum(x)[:-late]])[: len(column)]
        for x in (finite.astype(float), np.where(finite, column, 0.0) ** 2)
    )
    few = 1.0 + LEAST_CELLS / np.maximum(count, 1.0)
    return np.where(count < 0.5 * LEAST_CELLS, np.inf, np.maximum(few * np.sqrt(total / np.maximum(count, 1.0)), least))


def _sample_steps(column: FloatArray, cells: Cells) -> tuple[FloatArray, IntArray]:
    """Return the largest step between neighbouring samples of a column [N] in each cell, [n], and its stamp.

    A straight line with a step is fitted to the samples up to ``STEP_S`` before and after.
    """
    finite = np.isfinite(column)
    values, stamps, cell = column[finite], cells.stamps_ns[finite], cells.of_stamp[finite]
    count = len(cells.speed)
    largest, stamp_ns = np.zeros(count), np.zeros(count, np.int64)
    half = max(2, round(STEP_S * 1e9 / float(np.median(np.diff(stamps))))) if len(stamps) > 1 else 2
    if len(values) < 2 * half:
        return largest, stamp_ns
    place = np.arange(2 * half) - (half - 0.5)
    weights = np.linalg.pinv(np.stack([np.ones(2 * half), place, 0.5 * np.sign(place)], axis=1))[2]
    steps = np.convolve(values, weights[::-1], "valid")
    middle = slice(half, half + len(steps))
    order = np.argsort(np.abs(steps), kind="stable")  # the largest of a cell is written last
    largest[cell[middle][order]], stamp_ns[cell[middle][order]] = steps[order], stamps[middle][order]
    return largest, stamp_ns


def _largest_near(steps: FloatArray) -> FloatArray:
    """Return the largest of each step and the ``PEAK_CELLS`` behind it, [n]."""
    rows = np.lib.stride_tricks.sliding_window_view(np.append(steps, np.zeros(PEAK_CELLS)), PEAK_CELLS + 1)
    return np.take_along_axis(rows, np.argmax(np.abs(rows), axis=1)[:, None], axis=1)[:, 0]


def _first_jump(signals: Signals, after_ns: int, ignored: Collection[str]) -> SensorChange | None:
    """Return the first jump of gyro or accelerometer behind a time."""
    cells, end_ns = cells_of(signals), int(signals.stamps_ns[-1]) + 1
    kinematics, steering = _relations(cells)
    v = _mean(np.where(cells.speed > LEAST_SPEED_M_S, cells.speed, np.nan), -PART_CELLS, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ay, of_steer = _step(kinematics, LEAST_AY_STD), _step(steering, LEAST_STEER_STD)
        by_ay, by_steer = ay.scaled(-1.0 / v), of_steer.scaled(-1.0 / (steering.fit[:, 1] / v + steering.fit[:, 2] * v))
        step, at_ns = _sample_steps(signals.yaw_rate_rad_s, cells)
        step_std = np.fmax(_std_so_far(step, LEAST_GYRO_STD), np.sqrt(_mean(step**2, 3, WINDOW_CELLS)))  # a burst
        is_gyro = np.abs(step) > np.maximum(ALARM * step_std, LEAST_GYRO_JUMP_RAD_S)
        is_gyro &= by_ay.confirms(step) | (by_steer.confirms(step) & (SURE * by_ay.std > np.abs(step)))
        is_gyro &= ~by_ay.contradicts(step) & ~by_steer.contradicts(step)
        is_ay = (np.abs(ay.size) > np.maximum(ALARM * ay.std, LEAST_AY_JUMP_M_S2)) & ay.is_sharp
        # The steering shows that the car did not change its motion, or the samples of both sensors do.
        sampled, turned = (_largest_near(steps) for steps in (_sample_steps(signals.ay_m_s2, cells)[0], step))
        is_sampled = np.abs(sampled - ay.size) < AGREES * np.abs(ay.size)
        is_sampled &= by_ay.excludes(turned, step_std) & ~by_steer.contradicts(0.0 * step)
        is_ay &= by_ay.excludes(by_steer.size, by_steer.std) | is_sampled
    is_gyro &= "yaw_rate_rad_s" not in ignored
    is_ay &= "ay_m_s2" not in ignored
    first = cells.of_stamp[np.searchsorted(signals.stamps_ns, after_ns)]
    possible = np.arange(len(v)) > first + WINDOW_CELLS
    alarms = np.flatnonzero((is_gyro | is_ay) & possible)
    if not len(alarms):
        return None
    k = int(alarms[0])
    known_ns = cells.time_of(k + DECIDED_CELLS)
    if is_gyro[k]:
        three = (step, step_std), (by_ay.size, by_ay.std), (by_steer.size, by_steer.std)
        return SensorChange("yaw_rate_rad_s", "jump", int(at_ns[k]), known_ns, end_ns, *_weighted(three, k))
    k += int(np.argmax(np.abs(ay.size[k : k + PEAK_CELLS + 1])))
    return SensorChange("ay_m_s2", "jump", cells.time_of(k), known_ns, end_ns, float(ay.size[k]), float(ay.std[k]))


def _weighted(measured: Sequence[tuple[FloatArray, FloatArray]], k: int) -> tuple[float, float]:
    """Return the mean of the finite sizes [n] in cell k, weighted by their 1-sigmas [n], and its 1-sigma."""
    sizes, stds = (np.array([column[k] for column in columns]) for columns in zip(*measured, strict=True))
    finite = np.isfinite(sizes) & np.isfinite(stds)
    size, weight = sizes[finite], stds[finite] ** -2.0
    mean = float(weight @ size / weight.sum())
    scatter = float(weight @ (size - mean) ** 2) / max(len(size) - 1, 1)
    return mean, math.sqrt(max(1.0, scatter) / float(weight.sum()))


# ------------------------------------------------------------------------------------------------ stuck values


def _without_stuck(signals: Signals, cells: Cells, names: Sequence[str]) -> tuple[Signals, list[SensorChange]]:
    """Replace stuck steering by the steering relation, and remove stuck speeds."""
    cell, changes = cells.of_stamp, []
    _, steering = _relations(cells)
    error = _std_so_far(steering.residual(steering.table), 0.0)
    travelled = np.cumsum(np.nan_to_num(cells.ax)) * CELL_S
    columns: dict[str, Any] = {name: getattr(signals, name).copy() for name in names}
    for name, column in columns.items():
        for run in long_runs(column, cells, cells.speed > LEAST_SPEED_M_S):
            start, end = run.start, run.end
            k0, k = cell[start], np.arange(cell[start], cell[end - 1] + 1)
            if name == "steer_rad":
                expected = steering.table[k, 1:] @ steering.fit[k0]
                change, limit, std = expected - expected[0], LEAST_STEER_CHANGE_RAD + MISSED * error[k0], error[k0]
            else:  # the acceleration before is grade, or a bias
                before = max(k0 - round(GRADE_S / CELL_S), 0)
                grade = (travelled[k0] - travelled[before]) / max(k0 - before, 1)
                expected = travelled[k] - travelled[k0] - grade * (k - k0)
                change, limit, std, expected = expected, LEAST_SPEED_CHANGE_M_S, math.nan, np.full(len(k), np.nan)
            is_stuck = np.abs(change) > limit
            if name == "steer_rad":  # a cruising car has one speed
                is_stuck |= k - k0 >= run.unseen_cells
            missed = run.sure_cells + np.flatnonzero(is_stuck[run.sure_cells :])
            if not len(missed):
                continue
            known_ns = cells.time_of(k[missed[0]] + 1)
            rows = np.arange(start, end)[signals.stamps_ns[start:end] >= known_ns]
            column[rows] = expected[np.maximum(cell[rows] - 1 - k0, 0)]
            start_ns, end_ns = (int(signals.stamps_ns[i]) for i in (start, end - 1))
            size = float(getattr(signals, name)[start])
            changes.append(SensorChange(name, "stuck", start_ns, known_ns, end_ns + 1, size, float(std)))
    return (replace(signals, **columns) if changes else signals), changes


def _without_repeats(signals: Signals, cells: Cells) -> Signals:
    """Return signals without stuck values of accelerometer and gyro, whose end would be a jump.

    A stuck axis of a sensor that is mounted askew has a small part of the other axes' noise.
    """
    columns: dict[str, Any] = {name: getattr(signals, name).copy() for name in ("ay_m_s2", "yaw_rate_rad_s")}
    for column in columns.values():
        for run in long_runs(column, cells, cells.speed > LEAST_SPEED_M_S, LEAKED):
            column[run.start : run.end] = np.nan
    return replace(signals, **columns)


class Run(NamedTuple):
    """A repetition of one value beyond chance.

    Attributes
    ----------
    start, end : its rows. sure : the row at which chance is excluded.
    sure_cells, unseen_cells : cells until then, and until it is ``LONGER`` times as long as any before.
    repeats : share of repetitions before.
    """

    start: int
    end: int
    sure: int
    sure_cells: int
    unseen_cells: int
    repeats: float


def long_runs(column: FloatArray, cells: Cells, moving: BoolArray, share: float = 0.0, least: int = 2) -> list[Run]:
    """Return the repetitions of a column [N] beyond chance in the cells [n] in which the car moves.

    A value repeats if its step is at most a share of the RMS of the steps so far; ``least``: number of equal samples.
    """
    rows = np.flatnonzero(np.isfinite(column) & moving[cells.of_stamp])
    cell, step = cells.of_stamp[rows], np.abs(np.diff(column[rows], prepend=math.nan))
    usual = np.sqrt(np.cumsum(np.nan_to_num(step) ** 2) / np.maximum(np.arange(len(rows)), 1))
    same = step <= share * usual
    starts = np.flatnonzero(~same)
    lengths = np.append(starts[1:], len(rows))[: len(starts)] - starts
    repeats = (np.cumsum(same)[starts] + 0.5 * FEW_SAMPLES) / (starts + FEW_SAMPLES)
    chance = np.ceil(1.0 + math.log(CHANCE) / np.log(np.clip(repeats, 1e-3, 0.9999)))
    needed = np.maximum(chance.astype(int), least)
    longer = LONGER * np.maximum.accumulate(np.append(1, lengths))[:-1]

    def until(count: IntArray) -> IntArray:
        passed = cell[np.minimum(starts + count, len(rows) - 1)] - cell[starts]
        return np.where(count < lengths, np.maximum(passed, round(LEAST_STUCK_S / CELL_S)), len(cells.speed))

    driven_s = CELL_S * np.cumsum(np.diff(cell, prepend=-1) > 0)
    unseen = np.where(driven_s[starts] > SEEN_S, until(longer), len(cells.speed))
    sure = rows[np.minimum(starts + needed, len(rows)) - 1]
    columns = (rows[starts], rows[starts + lengths - 1] + 1, sure, until(needed), unseen, repeats)
    is_long = (lengths >= needed) & (starts > 0)
    return [Run(*run) for run in zip(*(c[is_long].tolist() for c in columns), strict=True)]
