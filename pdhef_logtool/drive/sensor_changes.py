"""Sensors that change in mid-drive: bias or gain of gyro and accelerometer, steering offset, speed gain, stuck values.

Three relations that every car on wheels obeys are fitted to the drive so far, by least squares over means of
``MEAN_CELLS`` cells (docs/method.md#changes):

* kinematics: a_y = b · [1, v_x r, ṙ, d(v_x r)/dt, v_x d(v_x r)/dt] (bias, roll, lever arm, v̇_y of the rear axle);
* steering: δ = c · [1, r / v_x, v_x r, ṙ] (offset, wheelbase, understeer, yaw inertia);
* speed: v_x = ∫ a_x dt.

At each cell, a generalised likelihood ratio test (Willsky and Jones 1976) explains the steps of the three residuals,
and those between neighbouring samples of each sensor, by a change of one sensor. The second moment of each step in the
drive so far is its covariance. A sensor is named if its change is likely against none, against that of any other
sensor, and against a change of the car's motion, which the relations cannot exclude but in which no single sensor
steps; and if it leaves little unexplained.

Frozen: a value repeats for longer than the share of repetitions so far explains by chance (probability ``CHANCE``), and
either the other sensors show that it changes (the steering relation, or a_x for the speed), or the steering repeats
``LONGER`` times as long as any value before.

The decision is made ``DECIDED_CELLS`` after the change, from samples up to then, and corrections begin then, so that
causal estimators stay causal.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.records.signals import LEAST_DIVISOR, NS_PER_S, BoolArray, FloatArray, IntArray, Signals

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
#: Signals and their columns of cells; steps that are tried, of bias and gain, by this much.
FIELDS = {"ay_m_s2": "ay", "yaw_rate_rad_s": "yaw_rate", "steer_rad": "steer", "speed_m_s": "speed"}
HYPOTHESES = (*((name, kind) for name in ("ay_m_s2", "yaw_rate_rad_s") for kind in ("jump", "gain")),
              ("steer_rad", "jump"), ("speed_m_s", "gain"))  # fmt: skip
TRIED = 1e-4
#: Least standard deviations of the steps of relations and samples.
LEAST_STDS = (0.06, 0.0005, 0.05)
LEAST_STEPS = {"ay_m_s2": 0.06, "yaw_rate_rad_s": 0.003, "steer_rad": 0.001, "speed_m_s": 0.05}
#: Twice the log-likelihood ratios: of a change to none; of the relations and of the samples alone (its root); to
#: that of another sensor (1000 : 1); and to a change of the car's motion.
ALARM, SURE, MARGIN, SHARP = 50.0, 3.0, 14.0, 6.0
#: Chi-square of what the change does not explain, its degrees of freedom and largest value (99.9 %), and share of the
#: change, as its effects are known to 10 %.
MISFIT_FREEDOM, MISFIT, MISFIT_SHARE = 9.0, 28.0, 0.01
#: Samples beside a step, s.
STEP_S = 0.1
#: A reading repeats by chance with this probability; shortest time that is reported.
CHANCE, LEAST_STUCK_S = 1e-6, 0.3
#: Change that a stuck channel has missed: of the steering relation, with its standard deviations; of the speed by a_x
#: against the mean a_x of the time before.
LEAST_STEER_CHANGE_RAD, MISSED, LEAST_SPEED_CHANGE_M_S, GRADE_S = 0.006, 5.0, 1.5, 5.0
#: Samples of a coarse signal, half of them repetitions, that are assumed before a drive.
FEW_SAMPLES = 10.0
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
    sensor, kind : signal; ``jump`` of its bias by ``size`` ± ``std``, ``gain`` that grows by this share, or ``stuck``
        at ``size``; ``std`` is then of the values that replace it.
    start_ns, known_ns, end_ns : of the change, of its correction, and of a stuck value's end.
    """

    sensor: str
    kind: str
    start_ns: int
    known_ns: int
    end_ns: int
    size: float
    std: float

    def removed(self, signals: Signals, start_ns: int, by: float) -> Signals:
        """Return signals [N] without a jump or gain by ``by`` from a time to the end of this one."""
        column = getattr(signals, self.sensor)
        other = column / (1.0 + by) if self.kind == "gain" else column - by
        late = (signals.stamps_ns >= start_ns) & (signals.stamps_ns < self.end_ns)
        return replace(signals, **{self.sensor: np.where(late, other, column)})


class Cells(NamedTuple):
    """Cell of each stamp [N], and means of the signals in the cells [n]; NaN without a recent sample."""

    stamps_ns: IntArray
    of_stamp: IntArray
    ay: FloatArray
    yaw_rate: FloatArray
    steer: FloatArray
    speed: FloatArray
    ax: FloatArray

    def changed(self, column: str, kind: str, by: float) -> "Cells":
        """Return the cells with a change of the bias or gain of one column."""
        values = getattr(self, column)
        return self._replace(**{column: values + by if kind == "jump" else values * (1.0 + by)})

    def time_of(self, cell: int) -> int:
        """Return the first stamp in a cell or after it."""
        row = int(np.searchsorted(self.of_stamp, cell))
        return int(self.stamps_ns[row]) if row < len(self.stamps_ns) else int(self.stamps_ns[-1]) + 1


def find_changes(signals: Signals, ignored: Collection[str] = ()) -> tuple[Signals, tuple[SensorChange, ...]]:
    """Return the signals [N] without the changes of their sensors, and the changes in order of time.

    A jump or gain is removed, stuck steering is replaced by the steering relation, other stuck values are missing.
    Changes of ``ignored`` signals are kept.
    """
    if len(signals) < 2:
        return signals, ()
    cells = cells_of(signals)
    sound, changes = _without_stuck(signals, cells, [n for n in ("steer_rad", "speed_m_s") if n not in ignored])
    fitted, after_ns, cells = sound, 0, cells if sound is signals else cells_of(sound)
    while len(changes) < MOST_CHANGES and (step := _first_step(fitted, cells, after_ns, ignored)) is not None:
        changes.append(step)
        after_ns = step.start_ns
        fitted = step.removed(fitted, step.start_ns, step.size)
        cells = cells_of(fitted)
        sound = step.removed(sound, step.known_ns, step.size)
    return sound, tuple(sorted(changes, key=lambda c: c.start_ns))


# ------------------------------------------------------------------------------------------------ relations


def cells_of(signals: Signals) -> Cells:
    """Average the samples of each cell; a cell without one repeats the last, for up to a tenth of a second."""
    steps_ns = np.diff(signals.stamps_ns, prepend=signals.stamps_ns[0])
    cell = np.cumsum(np.minimum(steps_ns, round(LONGEST_GAP_S * NS_PER_S))) // round(CELL_S * NS_PER_S)
    count = int(cell[-1]) + 1

    def mean(column: FloatArray, most: int) -> FloatArray:
        means, cells = part_means(column, cell, count), np.arange(count)
        last = np.maximum.accumulate(np.where(np.isfinite(means), cells, -1))
        return np.where((last >= 0) & (cells - last <= most), means[last], np.nan)

    s = signals
    columns = (s.ay_m_s2, s.yaw_rate_rad_s, s.steer_rad, s.speed_m_s, s.ax_m_s2)
    return Cells(signals.stamps_ns, cell, *map(mean, columns, (2, 2, 2, 10, 2)))


def part_means(column: FloatArray, part: IntArray, count: int, share: float = 0.0) -> FloatArray:
    """Return the means of a column [N] over parts [count] of a drive; NaN unless more than a share is finite."""
    finite = np.isfinite(column)
    samples = np.bincount(part[finite], minlength=count)
    total = np.bincount(part[finite], weights=column[finite], minlength=count)
    least = share * np.bincount(part, minlength=count) if share else 0.0
    return np.where(samples > least, total / np.maximum(samples, 1), np.nan)


def _mean(column: FloatArray, start: int, end: int) -> FloatArray:
    """Return the mean over cells k + start to k + end of a column [n] or [n, c]; NaN where a cell is not finite."""
    count, finite = end - start, np.isfinite(column)
    parts = (np.cumsum(part, axis=0) for part in (np.where(finite, column, 0.0), ~finite))
    sums, gaps = (np.concatenate([np.zeros_like(column[:1]), part]) for part in parts)
    means = np.where(gaps[count:] == gaps[:-count], (sums[count:] - sums[:-count]) / count, np.nan)
    return _later(means, start, len(column))


def _later(column: FloatArray, count: int, n: int) -> FloatArray:
    """Return rows k + count of a column in row k of n; NaN outside."""
    moved = np.full((n, *column.shape[1:]), np.nan)
    first, end = max(0, -count), max(0, -count, min(n, len(column) - count))
    moved[first:end] = column[first + count : end + count]
    return moved


def _tables(cells: Cells) -> tuple[FloatArray, ...]:
    """Return the tables of kinematics, steering and speed."""
    ay, r, steer, v, gained = (_mean(c, 1 - MEAN_CELLS, 1) for c in (*cells[2:6], np.cumsum(cells.ax) * CELL_S))
    v = np.where(v > LEAST_SPEED_M_S, v, np.nan)
    constant, turning = np.ones_like(v), v * r

    def rate(column: FloatArray) -> FloatArray:
        return np.asarray((column - _later(column, -MEAN_CELLS, len(column))) / (MEAN_CELLS * CELL_S))

    kinematics = np.stack([ay, constant, turning, rate(r), rate(turning), v * rate(turning)], axis=1)
    steering = np.stack([steer, constant, r / v, turning, rate(r)], axis=1)
    return kinematics, steering, np.stack([v - gained, constant], axis=1)


def _fitted(table: FloatArray, changes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regress the first column of a table [n, 1 + m] on the others, over the rows before each.

    Returns
    -------
    coefficients [n, m], NaN before ``LEAST_CELLS``; factors [n, p] on the 1-sigma of residuals for ``changes`` of the
    regressors [n, m, p], because the fit is uncertain.
    """
    finite = np.asarray(np.isfinite(table).all(axis=1))
    rows = np.where(finite[:, None], table, 0.0)
    products = np.cumsum(rows[:, :, None] * rows[:, None, :], axis=0)
    products = np.concatenate([np.zeros_like(products[:1]), products[:-1]])
    square = products[:, 1:, 1:] * (1.0 + RIDGE * np.eye(table.shape[1] - 1)) + 1e-9 * np.eye(table.shape[1] - 1)
    changes = np.nan_to_num(changes)
    solved = np.linalg.solve(square, np.concatenate([products[:, 1:, :1], changes], axis=2))
    fit = np.where(np.cumsum(finite)[:, None] > LEAST_CELLS, solved[..., 0], np.nan)
    return fit, np.asarray(np.sqrt(1.0 + INDEPENDENT_CELLS * (changes * solved[..., 1:]).sum(axis=1)))


def _residual(table: FloatArray, fit: FloatArray) -> FloatArray:
    """Return the part of the first column of a table [n, 1 + m] that the others do not explain, [n]."""
    return np.asarray(table[:, 0] - (table[:, 1:] * fit).sum(axis=1))


# ------------------------------------------------------------------------------------------------ steps


class _Block(NamedTuple):
    """A part of the evidence: statistics of a step after each cell, and their change by a unit of each hypothesis.

    Attributes
    ----------
    step : [n, p]. effects : [n, h, p]. least : smallest standard deviation of the statistics, [n].
    """

    step: FloatArray
    effects: FloatArray
    least: FloatArray

    def information(self) -> FloatArray:
        """Return the inverse of the second moment in the drive so far, [n, p, p]; 0 if unknown."""
        p = self.step.shape[1]
        finite = np.asarray(np.isfinite(self.step).all(axis=1) & np.isfinite(self.effects).all(axis=(1, 2)))
        rows = np.where(finite[:, None], self.step, 0.0)
        count, total = _decided_sum(finite), _decided_sum(rows[:, :, None] * rows[:, None, :])
        few = (1.0 + LEAST_CELLS / np.maximum(count, 1.0)) ** 2 / np.maximum(count, 1.0)
        moment, least = total * few[:, None, None], self.least**2
        raised = np.maximum(least - np.einsum("npp->n", moment) / p, 0.01 * least)
        moment = moment + raised[:, None, None] * np.eye(p)
        information = 1.0 / moment if p == 1 else np.linalg.inv(moment)
        information[~finite | (count < LEAST_CELLS)] = 0.0
        return np.asarray(information)


def _relation_block(index: int, tables: Sequence[FloatArray]) -> _Block:
    """Return the step of a relation's residual in the windows after each cell, with the fit of the drive before it.

    ``tables`` : of the drive, and with each hypothesis tried.
    """
    units = [(other - tables[0]) / TRIED for other in tables[1:]]
    after, *moved = (_mean(table, 0, PART_CELLS) for table in (tables[0], *units))
    n, starts = len(after), range(MEAN_CELLS, WINDOW_CELLS, PART_CELLS)
    before = _later(after, -PART_CELLS, n)
    changes = [_later(after, start, n) - before for start in starts]
    fit, leverages = _fitted(tables[0], np.stack(changes, axis=2)[:, 1:])
    steps = np.stack([_residual(change, fit) for change in changes], axis=1) / leverages
    effects = [[_residual(_later(unit, start, n), fit) for unit in moved] for start in starts]
    return _Block(steps, np.transpose(effects, (2, 1, 0)) / leverages[:, None], np.full(n, LEAST_STDS[index]))


def _sample_block(name: str, signals: Signals, cells: Cells, tried: Sequence[Cells]) -> _Block:
    """Return the step between neighbouring samples of a sensor; bursts of noise or motion have neighbours."""
    step, column = sample_steps(getattr(signals, name), cells), getattr(cells, FIELDS[name])
    units = [_mean((getattr(other, FIELDS[name]) - column) / TRIED, -1, 0) for other in tried]
    square = np.nan_to_num(step) ** 2
    beside = np.sqrt(np.fmax(_mean(square, 3, WINDOW_CELLS), _mean(square, -2 - PART_CELLS, -2)))
    return _Block(step[:, None], np.stack(units, axis=1)[..., None], np.fmax(beside, LEAST_STEPS[name]))


def sample_steps(column: FloatArray, cells: Cells) -> FloatArray:
    """Return the largest step between neighbouring samples of a column [N] in each cell, [n]; NaN without samples.

    A straight line with a step is fitted to the samples up to ``STEP_S`` before and after.
    """
    finite = np.isfinite(column)
    values, stamps, cell = column[finite], cells.stamps_ns[finite], cells.of_stamp[finite]
    largest = np.full(len(cells.speed), np.nan)
    half = max(2, round(STEP_S * NS_PER_S / float(np.median(np.diff(stamps))))) if len(stamps) > 1 else 2
    if len(values) < 2 * half:
        return largest
    place = np.arange(2 * half) - (half - 0.5)
    weights = np.linalg.pinv(np.stack([np.ones(2 * half), place, 0.5 * np.sign(place)], axis=1))[2]
    steps = np.convolve(values, weights[::-1], "valid")
    cells_of_steps = cell[half : half + len(steps)]
    first = np.flatnonzero(np.diff(cells_of_steps, prepend=-1))
    low, high = (of.reduceat(steps, first) for of in (np.minimum, np.maximum))
    largest[cells_of_steps[first]] = np.where(high > -low, high, low)
    return largest


def _decided_sum(column: Any) -> FloatArray:
    """Return the sum of a column [n, ...] over the cells that were decided before each, [n, ...]."""
    return np.nan_to_num(_later(np.cumsum(column, axis=0), -WINDOW_CELLS - PEAK_CELLS, len(column)))


def _std_so_far(column: FloatArray) -> FloatArray:
    """Return the RMS of a column over the cells that were decided before each; inf before ``LEAST_CELLS``."""
    finite = np.isfinite(column)
    count, total = _decided_sum(finite), _decided_sum(np.where(finite, column, 0.0) ** 2)
    few = 1.0 + LEAST_CELLS / np.maximum(count, 1.0)
    return np.where(count < 0.5 * LEAST_CELLS, np.inf, few * np.sqrt(total / np.maximum(count, 1.0)))


def _likeliest(signals: Signals, cells: Cells) -> tuple[BoolArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Return whether the likeliest change after each cell is named, its hypothesis, evidence, size and 1-sigma."""
    tried = [cells.changed(FIELDS[name], kind, TRIED) for name, kind in HYPOTHESES]
    blocks = [_relation_block(i, t) for i, t in enumerate(zip(*map(_tables, (cells, *tried)), strict=True))]
    blocks += [_sample_block(name, signals, cells, tried) for name in FIELDS]
    k, h = np.arange(len(cells.speed)), len(HYPOTHESES)
    match, power, total = np.zeros((2, len(k), h)), np.zeros((2, len(k), h)), np.zeros((2, len(k)))
    for i, block in enumerate(blocks):
        part = int(i >= len(LEAST_STDS))  # relations, samples
        step, effects, information = np.nan_to_num(block.step), np.nan_to_num(block.effects), block.information()
        weighted = effects @ information
        match[part] += (weighted @ step[..., None])[..., 0]
        power[part] += (weighted * effects).sum(axis=2)
        total[part] += np.einsum("np,npq,nq->n", step, information, step)
    parts = match / np.sqrt(np.maximum(power, LEAST_DIVISOR))
    match, power = match.sum(axis=0), np.maximum(power.sum(axis=0), LEAST_DIVISOR)
    explained, sensor = match**2 / power, np.array([name for name, _ in HYPOTHESES])
    best = np.argmax(explained, axis=1)
    second = np.where(sensor == sensor[best][:, None], 0.0, explained).max(axis=1)
    evidence, parts = explained[k, best], parts[:, k, best]
    misfit = total.sum(axis=0) - evidence
    is_named = (evidence > ALARM) & (evidence - second > MARGIN) & (evidence - total[0] > SHARP)
    is_named &= (np.abs(parts).min(axis=0) > SURE) & (parts.prod(axis=0) > 0.0)
    is_named &= misfit < MISFIT + MISFIT_SHARE * evidence
    std = np.sqrt(np.maximum(1.0, misfit / MISFIT_FREEDOM) / power[k, best])
    return is_named, best, evidence, match[k, best] / power[k, best], std


def _first_step(signals: Signals, cells: Cells, after_ns: int, ignored: Collection[str]) -> SensorChange | None:
    """Return the first change of the bias or gain of a sensor after a time; None without one."""
    is_named, best, evidence, size, std = _likeliest(signals, cells)
    is_named &= np.array([name not in ignored for name, _ in HYPOTHESES])[best]
    is_named[: cells.of_stamp[np.searchsorted(signals.stamps_ns, after_ns)] + WINDOW_CELLS + 1] = False
    if not is_named.any():
        return None
    first = int(np.argmax(is_named))
    k = first + int(np.argmax(np.where(is_named, evidence, 0.0)[first : first + PEAK_CELLS + 1]))
    known_ns, end_ns = cells.time_of(first + DECIDED_CELLS), int(signals.stamps_ns[-1]) + 1
    name, kind = HYPOTHESES[best[k]]
    return SensorChange(name, kind, cells.time_of(k), known_ns, end_ns, float(size[k]), float(std[k]))


# ------------------------------------------------------------------------------------------------ stuck values


def _without_stuck(signals: Signals, cells: Cells, names: Sequence[str]) -> tuple[Signals, list[SensorChange]]:
    """Replace stuck steering by the steering relation, and remove stuck speeds."""
    cell, changes = cells.of_stamp, []
    runs = {name: long_runs(getattr(signals, name), cells, cells.speed > LEAST_SPEED_M_S) for name in names}
    if not any(runs.values()):
        return signals, []
    steering = _tables(cells)[1]
    fit = _fitted(steering, np.empty((*steering[:, 1:].shape, 0)))[0]
    error = _std_so_far(_residual(steering, fit))
    travelled = np.cumsum(np.nan_to_num(cells.ax)) * CELL_S
    columns: dict[str, Any] = {name: getattr(signals, name).copy() for name in names}
    for name, column in columns.items():
        for run in runs[name]:
            start, end = run.start, run.end
            k0, k = cell[start], np.arange(cell[start], cell[end - 1] + 1)
            if name == "steer_rad":
                expected = steering[k, 1:] @ fit[k0]
                change, limit, std = expected - expected[0], LEAST_STEER_CHANGE_RAD + MISSED * error[k0], error[k0]
            else:  # what a_x measured before beyond the change of the speed is grade, or a bias
                before = max(k0 - round(GRADE_S / CELL_S), 0)
                beyond = travelled[[before, k0]] - cells.speed[[before, k0]]
                grade = np.nan_to_num(beyond[1] - beyond[0]) / max(k0 - before, 1)
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


def long_runs(column: FloatArray, cells: Cells, moving: BoolArray, least: int = 0) -> list[Run]:
    """Return the repetitions of a column [N] beyond chance in the cells [n] in which the car moves.

    With ``least``, a repetition has as many samples, and twice as many as any before.
    """
    rows = np.flatnonzero(np.isfinite(column) & moving[cells.of_stamp])
    cell, same = cells.of_stamp[rows], np.diff(column[rows], prepend=math.nan) == 0.0
    starts = np.flatnonzero(~same)
    lengths = np.append(starts[1:], len(rows))[: len(starts)] - starts
    repeats = (np.cumsum(same)[starts] + 0.5 * FEW_SAMPLES) / (starts + FEW_SAMPLES)
    chance = np.ceil(1.0 + math.log(CHANCE) / np.log(np.clip(repeats, 1e-3, 0.9999)))
    longest = np.maximum.accumulate(np.append(1, lengths))[:-1]
    needed = np.maximum(chance.astype(int), np.maximum(least, 2 * longest) if least else 2)

    def until(count: IntArray) -> IntArray:
        passed = cell[np.minimum(starts + count, len(rows) - 1)] - cell[starts]
        return np.where(count < lengths, np.maximum(passed, round(LEAST_STUCK_S / CELL_S)), len(cells.speed))

    driven_s = CELL_S * np.cumsum(np.diff(cell, prepend=-1) > 0)
    unseen = np.where(driven_s[starts] > SEEN_S, until(LONGER * longest), len(cells.speed))
    sure = rows[np.minimum(starts + needed, len(rows)) - 1]
    columns = (rows[starts], rows[starts + lengths - 1] + 1, sure, until(needed), unseen, repeats)
    is_long = (lengths >= needed) & (starts > 0)
    return [Run(*run) for run in zip(*(c[is_long].tolist() for c in columns), strict=True)]
