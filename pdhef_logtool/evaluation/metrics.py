"""Figures of an estimate against the truth, as rows of metrics.parquet.

Definitions. e = estimate − truth (angles wrapped), over the stamps of a segment at which the estimate and the truth are
valid and finite; ``n`` is their number. Sideslip counts only where the truth's speed exceeds the low-speed blend.

========================  ==============================================================================================
``rmse``                  √ mean e²
``rmse_relative``         rmse / √ mean truth² over the same stamps
``mae``                   mean abs e
``bias``                  mean e; positive = estimate too large
``p95_abs``, ``max_abs``  95th percentile and maximum of abs e
``coverage95``            share of stamps with abs e ≤ 1.96 σ; σ² is the estimate's variance plus the truth's if known
``availability``          share of the stamps with scorable truth at which the estimate is valid and finite; n = all
``lag_s``                 shift, within ± 0.3 s, at which the estimate correlates best with the truth; positive =
                          estimate late. Segment ``all`` only, its first hour; NaN when the correlation stays below 0.5
                          or has no peak
``nees``                  mean eᵀ (P + P_truth)⁻¹ e over [v_x, v_y, r]; 3 when P is right. Signal ``state``
``nis``, ``nis_dof``      mean normalised innovation squared and the mean of its degrees of freedom, which it should
                          equal. Signal ``state``
``diverged``              share of stamps at which the estimator itself reports divergence. Signal ``state``
``not_independent``       1 where the truth of this signal is one of the estimators' inputs: keep it out of rankings
========================  ==============================================================================================

Signals ``position_m`` and ``lateral_1s_m`` (segment ``all``) exist only when the truth has a pose: without one there is
nothing to measure a position against. ``position_m``: e is the distance between the truth's position and v_x, v_y, r
dead-reckoned from the truth's pose at the first common stamp. ``lateral_1s_m``: dead reckoning starts anew from the
truth's pose every second, and e is the lateral error, in the truth's axes, at the end of each second; a second with an
invalid estimate, a missing pose or a gap does not count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.drive.correlation import CommonGrid, EvenGrid, find_shift, on_common_grid
from pdhef_logtool.evaluation.blocks import ErrorSums, HeldRows, SegmentMasks, SegmentSums, packed, row_blocks
from pdhef_logtool.records.geometry import DeadReckoner, wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

#: Signals compared sample by sample, with their unit.
SCORED_SIGNALS: dict[str, str] = {
    "vx_m_s": "m/s",
    "vy_m_s": "m/s",
    "yaw_rate_rad_s": "rad/s",
    "sideslip_rad": "rad",
    "ay_m_s2": "m/s^2",
}
ALL = "all"
MAX_LAG_S = 0.3
MIN_LAG_CORRELATION = 0.5
LAG_SPAN_NS = 3_600_000_000_000
NORMAL_95 = 1.959963984540054
ANCHOR_S = 1.0
#: Rows of which covariances are in memory at once.
NEES_ROWS = 1 << 16
#: Of a covariance in units of its mean variance: far above what rounding does to it.
LEAST_DETERMINANT = 1e-9
#: Grids on which lags are sought that are in memory at once: of motion, sideslip and acceleration.
GRIDS_HELD = 3
#: No second of dead reckoning may hold a longer step between stamps.
MAX_STEP_S = 0.2


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One figure. The first eight fields and ``algorithm`` are the columns of metrics.parquet.

    ``algorithm`` is the digest of what ran under the estimator's name; empty where nobody knows (recorded estimates).

    ``independent`` is False when the truth of this signal is one of the estimators' inputs; tables and rankings leave
    such rows out. In the file a row with metric ``not_independent`` says so for its estimator and signal.
    """

    log: str
    estimator: str
    signal: str
    segment: str
    metric: str
    value: float
    unit: str
    n: int
    independent: bool = True
    algorithm: str = ""


def score_track(
    estimate: StateTrack,
    truth: StateTrack,
    masks: Mapping[str, BoolArray],
    *,
    log: str,
    low_speed_m_s: float,
    not_independent: Mapping[str, str] | None = None,
) -> list[MetricRow]:
    """Score one estimate against the truth at the same stamps; definitions head this file.

    Parameters
    ----------
    estimate, truth : [N] at the same stamps (:func:`pdhef_logtool.drive.truth.truth_at`).
    masks : bool [N] by segment; ``all`` is added when it is absent.
    low_speed_m_s : sideslip is scored above this truth speed.
    not_independent : by signal, from :func:`pdhef_logtool.drive.truth.dependent_signals`; other keys are ignored.

    Raises
    ------
    ValueError : The tracks or masks are not at the same stamps.
    """
    return Scorer(truth, masks, log=log, low_speed_m_s=low_speed_m_s, not_independent=not_independent).rows(estimate)


class Scorer:
    """Scores the estimates of a drive one by one; what its truth says, or has in common with others, is found once.

    Parameters and errors are those of :func:`score_track`.
    """

    def __init__(
        self,
        truth: StateTrack,
        masks: Mapping[str, BoolArray],
        *,
        log: str,
        low_speed_m_s: float,
        not_independent: Mapping[str, str] | None = None,
    ) -> None:
        if ALL not in masks:
            masks = {ALL: np.ones(len(truth), dtype=np.bool_), **masks}
        self._truth = truth
        self._masks = packed(masks, len(truth))
        self._log = log
        self._dependent = frozenset(not_independent or ())
        self._scorable = _scorable_bits(truth, low_speed_m_s)
        self._asked = self._count_asked()
        blocks = (HeldRows(truth.rows(a, b)) for a, b in row_blocks(len(truth)))
        self._has_pose = any(_pose_known(part).any() for part in blocks)
        self._lags = _Lags(truth)
        self._squares: dict[tuple[str, int], tuple[BoolArray, dict[str, float]]] = {}

    def rows(self, estimate: StateTrack) -> list[MetricRow]:
        """Return the figures of an estimate."""
        _check_stamps(estimate, self._truth)
        sums = _EstimateSums(self._masks, len(self._truth))
        for a, b in row_blocks(len(self._truth)):
            self._add(sums, HeldRows(estimate.rows(a, b)), HeldRows(self._truth.rows(a, b)), a)
        rows: list[MetricRow] = []
        for signal, found in sums.signals.items():
            rows += self._signal_rows(estimate, signal, found)
        rows += _position_rows(sums, estimate.name, self._log)
        rows += [
            MetricRow(self._log, estimate.name, "state", segment, "nees", float(total) / n, "1", n)
            for segment, (n, (total,)) in sums.nees.totals().items()
        ]
        rows += state_rows(estimate, self._masks, log=self._log)
        return self._marked(rows, estimate.name)

    def _add(self, sums: _EstimateSums, estimate: StateTrack, truth: StateTrack, a: int) -> None:
        """Take the block from row ``a`` on."""
        inside = dict(self._masks.rows(a, a + len(truth)))
        for signal, found in sums.signals.items():
            self._add_signal(found, estimate, truth, inside, signal, a)
        if estimate.covariance.shape[0]:
            sums.nees.add(inside, _nees_of(estimate, truth))
        if self._has_pose:
            distance = sums.path.add(estimate, truth)
            sums.distances.add(distance[np.isfinite(distance)])
            sums.seconds.add(estimate, truth)

    def _marked(self, rows: list[MetricRow], name: str) -> list[MetricRow]:
        dependent = self._dependent & frozenset(r.signal for r in rows)
        marked = [replace(r, independent=False) if r.signal in dependent else r for r in rows]
        marks = [
            MetricRow(
                self._log, name, s, ALL, "not_independent", 1.0, "1", max(r.n for r in rows if r.signal == s), False
            )
            for s in sorted(dependent)
        ]
        return marked + marks

    def _count_asked(self) -> dict[str, dict[str, int]]:
        """Return by signal how many stamps of each segment the truth can score; segments without one are left out."""
        found: dict[str, dict[str, int]] = {signal: dict.fromkeys(self._masks, 0) for signal in SCORED_SIGNALS}
        for a, b in row_blocks(len(self._truth)):
            for segment, mask in self._masks.rows(a, b).items():
                for signal, counts in found.items():
                    counts[segment] += int(np.count_nonzero(mask & self._scorable.rows(a, b)[signal]))
        return {signal: {s: n for s, n in counts.items() if n} for signal, counts in found.items()}

    def _add_signal(  # positional: what a block has at hand
        self,
        sums: _SignalSums,
        estimate: StateTrack,
        truth: StateTrack,
        inside: Mapping[str, BoolArray],
        signal: str,
        a: int,
    ) -> None:
        error = _raw_error(estimate, truth, signal)
        known = estimate.valid & self._scorable.rows(a, a + len(error))[signal] & np.isfinite(error)
        sums.known.append(known & inside[ALL])
        squares = self._squares_of_truth(truth, inside, signal, known, a)
        sigma = _total_std(estimate, truth, signal)
        for segment, mask in inside.items():
            errors = _selected(error, mask & known)
            sums.errors[segment].add(errors)
            if errors.size:
                sums.squares.setdefault(segment, []).append([errors.size, squares[segment]])
        if sigma is not None:
            banded = known & np.isfinite(sigma)
            covered = banded & (np.abs(error) <= NORMAL_95 * sigma)
            for segment, mask in inside.items():
                sums.banded[segment] += np.count_nonzero(mask & banded), np.count_nonzero(mask & covered)

    def _squares_of_truth(
        self, truth: StateTrack, inside: Mapping[str, BoolArray], signal: str, known: BoolArray, a: int
    ) -> dict[str, float]:
        """Return the sum of the truth's squares by segment of a block; most estimates are known at the same stamps."""
        found = self._squares.get((signal, a))
        if found is None or not np.array_equal(found[0], known):
            values = getattr(truth, signal)
            sums = {s: float(np.sum(_selected(values, mask & known) ** 2)) for s, mask in inside.items()}
            self._squares[signal, a] = found = known, sums
        return found[1]

    def _signal_rows(self, estimate: StateTrack, signal: str, sums: _SignalSums) -> list[MetricRow]:
        rows: list[MetricRow] = []

        def add(segment: str, metric: str, value: float, unit: str, n: int) -> None:
            rows.append(MetricRow(self._log, estimate.name, signal, segment, metric, value, unit, n))

        for segment, expected in self._asked[signal].items():
            n = sums.errors[segment].n
            add(segment, "availability", n / expected, "1", expected)
            if n == 0:
                continue
            figures = sums.errors[segment].figures()
            for metric, value in figures.items():
                add(segment, metric, value, SCORED_SIGNALS[signal], n)
            size = float(np.sqrt(np.sum(sums.squares[segment], axis=0)[1] / n))
            add(segment, "rmse_relative", figures["rmse"] / size if size > 0 else float("nan"), "1", n)
            within, covered = sums.banded[segment].tolist()
            if within:
                add(segment, "coverage95", covered / within, "1", within)
            if segment == ALL:
                add(segment, "lag_s", self._lags.of(estimate, signal, np.concatenate(sums.known)), "s", n)
        return rows


class _SignalSums:
    """What the figures of one signal of one estimate are made of; ``known`` [N]: where it is scored, by block."""

    def __init__(self, masks: Mapping[str, BoolArray]) -> None:
        self.errors = {segment: ErrorSums(int(np.count_nonzero(mask))) for segment, mask in masks.items()}
        self.squares: dict[str, list[list[float]]] = {}
        self.banded = {segment: np.zeros(2, dtype=np.int64) for segment in masks}
        self.known: list[BoolArray] = []


class _EstimateSums:
    """What the figures of one estimate of n stamps are made of."""

    def __init__(self, masks: Mapping[str, BoolArray], n: int) -> None:
        self.signals = {signal: _SignalSums(masks) for signal in SCORED_SIGNALS}
        self.nees = SegmentSums()
        self.path, self.distances = _Path(), ErrorSums(n)
        self.seconds, self.laterals = _Seconds(), ErrorSums(n)


class _Lags:
    """Lags behind the truth [N] of its first hour; estimates that are known at the same stamps share the grid."""

    def __init__(self, truth: StateTrack) -> None:
        self._truth = truth
        self._end = _end_of_first_hour(truth)
        self._grids: list[tuple[BoolArray, EvenGrid, dict[str, FloatArray]]] = []

    def of(self, estimate: StateTrack, signal: str, known: BoolArray) -> float:
        """Return the lag of a signal that is scored where it is ``known`` [N]; NaN when there is no clear peak."""
        known = known[: self._end]
        if np.count_nonzero(known) < 2:
            return float("nan")
        grid, of_truth = self._grid(known)
        if signal not in of_truth:
            of_truth[signal] = grid.of_a(_selected(getattr(self._truth.rows(0, self._end), signal), known))
        of_estimate = grid.of_b(_selected(getattr(estimate.rows(0, self._end), signal), known))
        return _clear_lag_s(CommonGrid(grid.step_s, of_truth[signal], of_estimate))

    def _grid(self, known: BoolArray) -> tuple[EvenGrid, dict[str, FloatArray]]:
        found = next((g for g in self._grids if np.array_equal(g[0], known)), None)
        if found is None:
            stamps = _selected(self._truth.rows(0, self._end).stamps_ns, known)
            found = known, EvenGrid(stamps, stamps), {}
        latest = [g for g in self._grids if g is not found][1 - GRIDS_HELD :]
        self._grids = [*latest, found]
        return found[1:]


def _end_of_first_hour(truth: StateTrack) -> int:
    if not len(truth):
        return 0
    end_ns, end = truth.rows(0, 1).stamps_ns[0] + LAG_SPAN_NS, 0
    for a, b in row_blocks(len(truth)):
        end = a + int(np.searchsorted(truth.rows(a, b).stamps_ns, end_ns))
        if end < b:
            break
    return end


def _selected(values: NDArray[Any], mask: BoolArray) -> NDArray[Any]:
    """Return the values [N] of a mask [N]; without copying them where it has all."""
    return values if mask.all() else values[mask]


def state_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis``, ``nis_dof`` and ``diverged`` of a track, which need no truth; no NIS rows for a track without."""
    masks = packed(masks, len(track))
    innovation, diverged = SegmentSums(), SegmentSums()
    for a, b in row_blocks(len(track)):
        part, inside = track.rows(a, b), masks.rows(a, b)
        dof = part.nis_dof
        innovation.add(inside, np.where(dof > 0, part.nis, np.nan), dof)
        diverged.add(inside, part.diverged)
    found = [
        (segment, metric, float(total[i]) / n, n)
        for sums, metrics in ((innovation, ("nis", "nis_dof")), (diverged, ("diverged",)))
        for segment, (n, total) in sums.totals().items()
        for i, metric in enumerate(metrics)
    ]
    place = list(masks).index
    return [
        MetricRow(log, track.name, "state", *figure[:3], "1", figure[3])
        for figure in sorted(found, key=lambda f: place(f[0]))
    ]


def truth_speed(truth: StateTrack) -> FloatArray:
    """Return the truth's speed [N] in m/s, abs v_x where v_y is not known; NaN where v_x is not."""
    return np.where(np.isfinite(truth.vy_m_s), np.hypot(truth.vx_m_s, truth.vy_m_s), np.abs(truth.vx_m_s))


def signal_error(estimate: StateTrack, truth: StateTrack, signal: str, low_speed_m_s: float) -> FloatArray:
    """Return estimate − truth [N] of a signal; NaN where it is not scored."""
    error = _raw_error(estimate, truth, signal)
    scored = estimate.valid & _scorable(truth, signal, low_speed_m_s)
    return np.where(scored & np.isfinite(error), error, np.nan)


def _raw_error(estimate: StateTrack, truth: StateTrack, signal: str) -> FloatArray:
    """Return estimate − truth [N], also where it is not scored."""
    error: FloatArray = getattr(estimate, signal) - getattr(truth, signal)
    return wrap_angle(error) if signal == "sideslip_rad" else error


def summarise_errors(error: FloatArray) -> dict[str, float]:
    """Return rmse, mae, bias, p95_abs and max_abs of finite errors [N], N ≥ 1."""
    sums = ErrorSums(len(error))
    sums.add(error)
    return sums.figures()


def lag_s(stamps_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    """Return by how many seconds the estimate [N] follows the truth [N]; NaN when there is no clear peak."""
    known = np.isfinite(estimate) & np.isfinite(truth)
    if np.count_nonzero(known) < 2:
        return float("nan")
    stamps = stamps_ns[known]
    return _clear_lag_s(on_common_grid(stamps, truth[known], stamps, estimate[known]))


def _clear_lag_s(grid: CommonGrid) -> float:
    shift = find_shift(grid, MAX_LAG_S)
    clear = shift.inside and shift.correlation >= MIN_LAG_CORRELATION
    return shift.shift_s if clear else float("nan")


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return eᵀ P⁻¹ e, [N], of errors [N, k] and covariances [N, k, k]; NaN where P is not positive definite."""
    out = np.full(error.shape[0], np.nan)
    finite = np.isfinite(error).all(axis=1) & np.isfinite(covariance.reshape(len(covariance), -1)).all(axis=1)
    good = finite & _surely_positive_definite(covariance)
    unsure = np.flatnonzero(finite & ~good)
    good[unsure] = np.linalg.eigvalsh(covariance[unsure])[:, 0] > 0
    e = _selected(error, good)
    out[good] = (e * np.linalg.solve(_selected(covariance, good), e[:, :, None])[:, :, 0]).sum(axis=1)
    return out


def _surely_positive_definite(covariance: FloatArray) -> BoolArray:
    """Return which matrices [N, k, k] are so by far more than rounding, [N]: their eigenvalues need not be asked.

    All pivots are positive, and their product, the determinant, bounds the smallest eigenvalue.
    """
    k = covariance.shape[1]
    left = {(i, j): covariance[:, i, j].copy() for i in range(k) for j in range(i + 1)}
    scale = sum(left[i, i] for i in range(k)) / k
    sure = np.ones(len(covariance), dtype=np.bool_)
    determinant = np.ones(len(covariance))
    with np.errstate(all="ignore"):
        for j in range(k):
            sure &= left[j, j] > 0.0
            determinant *= left[j, j] / scale
            for i in range(j + 1, k):
                share = left[i, j] / left[j, j]
                for m in range(j + 1, i + 1):
                    left[i, m] -= share * left[m, j]
    return sure & (determinant > LEAST_DETERMINANT)


def position_error(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the distance [N] in m between truth and dead reckoning; NaN before the start and without a truth pose."""
    path = _Path()
    return np.concatenate([path.add(estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth))])


class _Path:
    """An estimate dead-reckoned from the truth's pose at the first common stamp, block by block."""

    def __init__(self) -> None:
        self._reckoner: DeadReckoner | None = None

    def add(self, estimate: StateTrack, truth: StateTrack) -> FloatArray:
        """Return the errors [M] of the next block as :func:`position_error` has them."""
        pose = _pose_known(truth)
        error = np.full(len(truth), np.nan)
        first = 0
        if self._reckoner is None:
            ready = np.flatnonzero(pose & _motion_known(estimate)) if pose.any() else np.empty(0, dtype=np.int64)
            if not ready.size:
                return error
            first = int(ready[0])
            self._reckoner = DeadReckoner(
                (float(truth.x_m[first]), float(truth.y_m[first]), float(truth.yaw_rad[first]))
            )
        x, y, _ = _dead_reckon(estimate, self._reckoner, first)
        distance = np.hypot(x - truth.x_m[first:], y - truth.y_m[first:])
        error[first:] = np.where(pose[first:], distance, np.nan)
        return error


def lateral_errors_after_one_second(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the lateral error [K] in m at the end of each second that can be scored; positive = estimate left."""
    seconds = _Seconds()
    for a, b in row_blocks(len(truth)):
        seconds.add(estimate.rows(a, b), truth.rows(a, b))
    return seconds.lateral_errors()


class _Seconds:
    """An estimate and the truth at the first stamp of each second from the first common stamp on, block by block."""

    def __init__(self) -> None:
        self._reckoner = DeadReckoner((0.0, 0.0, 0.0))
        self._anchors: list[FloatArray] = []
        self._mark: int | None = None
        self._rows = self._lost = self._gaps = 0
        self._last: IntArray = np.empty(0, dtype=np.int64)

    def add(self, estimate: StateTrack, truth: StateTrack) -> None:
        """Take the next block.

        Of it [11, K] is kept: place, whether the true pose is known, stamps before it and up to it without motion,
        gaps before it, dead reckoning x, y, yaw and true x, y, yaw.
        """
        pose, motion, stamps = _pose_known(truth), _motion_known(estimate), truth.stamps_ns
        gap = np.diff(stamps, prepend=self._last if self._rows else stamps[:1]) > round(MAX_STEP_S * 1e9)
        if self._mark is None and (pose & motion).any():
            self._mark = int(stamps[np.argmax(pose & motion)])
        second = round(ANCHOR_S * 1e9)
        marks = (
            np.empty(0, dtype=np.int64) if self._mark is None else np.arange(self._mark, int(stamps[-1]) + 1, second)
        )
        at = np.searchsorted(stamps, marks)
        up_to = self._lost + np.cumsum(~motion)
        columns = (self._rows + np.arange(len(stamps)), pose, up_to - ~motion, up_to, self._gaps + np.cumsum(gap))
        poses = (*_dead_reckon(estimate, self._reckoner), truth.x_m, truth.y_m, truth.yaw_rad)
        self._anchors.append(np.stack([np.asarray(c[at], dtype=np.float64) for c in (*columns, *poses)]))
        self._mark = None if self._mark is None else self._mark + second * len(marks)
        self._lost += int(np.count_nonzero(~motion))
        self._gaps += int(np.count_nonzero(gap))
        self._rows, self._last = self._rows + len(stamps), stamps[-1:]

    def lateral_errors(self) -> FloatArray:
        """Return the lateral errors of all blocks."""
        anchors = np.concatenate([np.empty((11, 0)), *self._anchors], axis=1)
        begin, end = anchors[:, :-1], anchors[:, 1:]
        at, pose, lost, _, gaps = range(5)
        whole = (end[3] == begin[lost]) & (end[gaps] == begin[gaps]) & (begin[pose] * end[pose] > 0)
        whole &= end[at] > begin[at]
        x, y, yaw, true_x, true_y, true_yaw = begin[5:, whole]
        x_end, y_end, _, true_x_end, true_y_end, true_yaw_end = end[5:, whole]
        # One dead reckoning serves all seconds: a new start pose only turns and moves it.
        turn = true_yaw - yaw
        dx = np.cos(turn) * (x_end - x) - np.sin(turn) * (y_end - y) - (true_x_end - true_x)
        dy = np.sin(turn) * (x_end - x) + np.cos(turn) * (y_end - y) - (true_y_end - true_y)
        return np.asarray(-np.sin(true_yaw_end) * dx + np.cos(true_yaw_end) * dy, dtype=np.float64)


def _check_stamps(estimate: StateTrack, truth: StateTrack) -> None:
    blocks = ((estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth)))
    if len(estimate) != len(truth) or not all(np.array_equal(e.stamps_ns, t.stamps_ns) for e, t in blocks):
        raise ValueError(f"estimate {estimate.name} and truth must be at the same stamps")


def _scorable(truth: StateTrack, signal: str, low_speed_m_s: float) -> BoolArray:
    scorable: BoolArray = truth.valid & np.isfinite(getattr(truth, signal))
    if signal == "sideslip_rad":
        scorable = scorable & (truth_speed(truth) > low_speed_m_s)
    return scorable


def _scorable_bits(truth: StateTrack, low_speed_m_s: float) -> SegmentMasks:
    """Return where the truth can score each signal, [N]."""
    blocks = []
    for a, b in row_blocks(len(truth)):
        part = HeldRows(truth.rows(a, b))
        blocks.append(packed({s: _scorable(part, s, low_speed_m_s) for s in SCORED_SIGNALS}, b - a).bits)
    return SegmentMasks([*SCORED_SIGNALS], np.concatenate(blocks))


def _total_std(estimate: StateTrack, truth: StateTrack, signal: str) -> FloatArray | None:
    """Return the 1-sigma of the error [N]; None where the estimate never has one."""
    name = {
        "vx_m_s": "vx_std_m_s",
        "vy_m_s": "vy_std_m_s",
        "yaw_rate_rad_s": "yaw_rate_std_rad_s",
        "sideslip_rad": "sideslip_std_rad",
    }.get(signal)
    if name is None or (name != "sideslip_std_rad" and not estimate.covariance.shape[0]):
        return None
    own: FloatArray = getattr(estimate, name)
    of_truth = getattr(truth, name)
    if not np.isfinite(of_truth).any():
        return own
    return np.asarray(np.hypot(own, np.nan_to_num(of_truth, nan=0.0)), dtype=np.float64)


def _position_rows(sums: _EstimateSums, estimate: str, log: str) -> list[MetricRow]:
    """Return the figures of positions; none without a pose."""
    errors = sums.seconds.lateral_errors()
    sums.laterals.add(errors[np.isfinite(errors)])
    rows = []
    for signal, of_signal in (("position_m", sums.distances), ("lateral_1s_m", sums.laterals)):
        if of_signal.n:
            figures = of_signal.figures()
            if signal == "position_m":
                del figures["bias"]  # a distance has no sign
            rows += [
                MetricRow(log, estimate, signal, ALL, metric, value, "m", of_signal.n)
                for metric, value in figures.items()
            ]
    return rows


def _nees_of(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    error = np.stack([getattr(estimate, s) - getattr(truth, s) for s in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")], axis=1)
    error[~(estimate.valid & truth.valid)] = np.nan
    covariance = estimate.covariance
    if truth.covariance.shape[0]:
        covariance = covariance + truth.covariance
    parts = range(0, len(error), NEES_ROWS)
    return np.concatenate(
        [np.empty(0), *(nees(error[i : i + NEES_ROWS], covariance[i : i + NEES_ROWS]) for i in parts)]
    )


def _pose_known(truth: StateTrack) -> BoolArray:
    known: BoolArray = truth.valid & np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad)
    return known


def _motion_known(track: StateTrack) -> BoolArray:
    known: BoolArray = track.valid & np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s)
    return known & np.isfinite(track.yaw_rate_rad_s)


def _dead_reckon(
    track: StateTrack, reckoner: DeadReckoner, first: int = 0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    vx = np.where(track.valid, track.vx_m_s, np.nan)
    return reckoner.add(track.stamps_ns[first:], vx[first:], track.vy_m_s[first:], track.yaw_rate_rad_s[first:])
