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

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.drive.correlation import find_shift, on_common_grid
from pdhef_logtool.evaluation.blocks import ErrorSums, SegmentMasks, SegmentSums, known_by_segment, packed, row_blocks
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
    _check_stamps(estimate, truth)
    if ALL not in masks:
        masks = {ALL: np.ones(len(truth), dtype=np.bool_), **masks}
    masks = packed(masks, len(truth))
    rows: list[MetricRow] = []
    for signal in SCORED_SIGNALS:
        rows += _score_signal(estimate, truth, masks, signal, log, low_speed_m_s)
    rows += _score_position(estimate, truth, log)
    rows += _nees_rows(estimate, truth, masks, log)
    rows += state_rows(estimate, masks, log=log)
    dependent = frozenset(not_independent or ()) & frozenset(r.signal for r in rows)
    marked = [replace(r, independent=False) if r.signal in dependent else r for r in rows]
    marks = [
        MetricRow(
            log, estimate.name, s, ALL, "not_independent", 1.0, "1", max(r.n for r in rows if r.signal == s), False
        )
        for s in sorted(dependent)
    ]
    return marked + marks


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
    error = getattr(estimate, signal) - getattr(truth, signal)
    if signal == "sideslip_rad":
        error = wrap_angle(error)
    scored = estimate.valid & _scorable(truth, signal, low_speed_m_s)
    return np.where(scored & np.isfinite(error), error, np.nan)


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
    shift = find_shift(on_common_grid(stamps, truth[known], stamps, estimate[known]), MAX_LAG_S)
    clear = shift.inside and shift.correlation >= MIN_LAG_CORRELATION
    return shift.shift_s if clear else float("nan")


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return eᵀ P⁻¹ e, [N], of errors [N, k] and covariances [N, k, k]; NaN where P is not positive definite."""
    out = np.full(error.shape[0], np.nan)
    good = np.flatnonzero(np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    good = good[np.linalg.eigvalsh(covariance[good])[:, 0] > 0]
    e = error[good]
    out[good] = (e * np.linalg.solve(covariance[good], e[:, :, None])[:, :, 0]).sum(axis=1)
    return out


def position_error(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the distance [N] in m between truth and dead reckoning; NaN before the start and without a truth pose."""
    return np.concatenate([*_position_errors(estimate, truth)])


def _position_errors(estimate: StateTrack, truth: StateTrack) -> Iterator[FloatArray]:
    reckoner = None
    for a, b in row_blocks(len(truth)):
        of_truth, of_estimate = truth.rows(a, b), estimate.rows(a, b)
        pose = _pose_known(of_truth)
        error = np.full(b - a, np.nan)
        first = 0
        if reckoner is None:
            ready = np.flatnonzero(pose & _motion_known(of_estimate))
            if ready.size:
                first = int(ready[0])
                start = of_truth.rows(first, first + 1)
                reckoner = DeadReckoner((float(start.x_m[0]), float(start.y_m[0]), float(start.yaw_rad[0])))
        if reckoner is not None:
            x, y, _ = _dead_reckon(of_estimate.rows(first, b - a), reckoner)
            distance = np.hypot(x - of_truth.x_m[first:], y - of_truth.y_m[first:])
            error[first:] = np.where(pose[first:], distance, np.nan)
        yield error


def lateral_errors_after_one_second(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the lateral error [K] in m at the end of each second that can be scored; positive = estimate left."""
    anchors = np.concatenate([*_anchors(estimate, truth)], axis=1)
    begin, end = anchors[:, :-1], anchors[:, 1:]
    at, pose, lost, _, gaps = range(5)
    whole = (end[3] == begin[lost]) & (end[gaps] == begin[gaps]) & (begin[pose] * end[pose] > 0) & (end[at] > begin[at])
    x, y, yaw, true_x, true_y, true_yaw = begin[5:, whole]
    x_end, y_end, _, true_x_end, true_y_end, true_yaw_end = end[5:, whole]
    # One dead reckoning serves all seconds: a new start pose only turns and moves it.
    turn = true_yaw - yaw
    dx = np.cos(turn) * (x_end - x) - np.sin(turn) * (y_end - y) - (true_x_end - true_x)
    dy = np.sin(turn) * (x_end - x) + np.cos(turn) * (y_end - y) - (true_y_end - true_y)
    return np.asarray(-np.sin(true_yaw_end) * dx + np.cos(true_yaw_end) * dy, dtype=np.float64)


def _anchors(estimate: StateTrack, truth: StateTrack) -> Iterator[FloatArray]:
    """Yield, by block, [11, K] at the first stamp of each second from the first common stamp on.

    Rows: place, whether the true pose is known, stamps before it and up to it without motion, gaps before it, dead
    reckoning x, y, yaw and true x, y, yaw.
    """
    reckoner = DeadReckoner((0.0, 0.0, 0.0))
    second = round(ANCHOR_S * 1e9)
    mark: int | None = None
    lost = gaps = 0
    stamps: IntArray = np.empty(0, dtype=np.int64)
    for a, b in row_blocks(len(truth)):
        of_truth, of_estimate = truth.rows(a, b), estimate.rows(a, b)
        pose, motion = _pose_known(of_truth), _motion_known(of_estimate)
        before, stamps = stamps[-1:], of_truth.stamps_ns
        gap = np.diff(stamps, prepend=before if a else stamps[:1]) > round(MAX_STEP_S * 1e9)
        if mark is None and (pose & motion).any():
            mark = int(stamps[np.argmax(pose & motion)])
        marks = np.empty(0, dtype=np.int64) if mark is None else np.arange(mark, int(stamps[-1]) + 1, second)
        at = np.searchsorted(stamps, marks)
        up_to = lost + np.cumsum(~motion)
        columns = (a + np.arange(b - a), pose, up_to - ~motion, up_to, gaps + np.cumsum(gap))
        poses = (*_dead_reckon(of_estimate, reckoner), of_truth.x_m, of_truth.y_m, of_truth.yaw_rad)
        yield np.stack([np.asarray(c[at], dtype=np.float64) for c in (*columns, *poses)])
        mark = None if mark is None else mark + second * len(marks)
        lost, gaps = lost + int(np.count_nonzero(~motion)), gaps + int(np.count_nonzero(gap))


def _check_stamps(estimate: StateTrack, truth: StateTrack) -> None:
    blocks = ((estimate.rows(a, b), truth.rows(a, b)) for a, b in row_blocks(len(truth)))
    if len(estimate) != len(truth) or not all(np.array_equal(e.stamps_ns, t.stamps_ns) for e, t in blocks):
        raise ValueError(f"estimate {estimate.name} and truth must be at the same stamps")


def _scorable(truth: StateTrack, signal: str, low_speed_m_s: float) -> BoolArray:
    scorable: BoolArray = truth.valid & np.isfinite(getattr(truth, signal))
    if signal == "sideslip_rad":
        scorable = scorable & (truth_speed(truth) > low_speed_m_s)
    return scorable


def _score_signal(
    estimate: StateTrack, truth: StateTrack, masks: SegmentMasks, signal: str, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    sums = {segment: ErrorSums(int(np.count_nonzero(mask))) for segment, mask in masks.items()}
    asked, squares, banded = SegmentSums(), SegmentSums(), SegmentSums()
    for a, b in row_blocks(len(truth)):
        of_estimate, of_truth, inside = estimate.rows(a, b), truth.rows(a, b), masks.rows(a, b)
        error = signal_error(of_estimate, of_truth, signal, low_speed_m_s)
        for segment, errors in known_by_segment(error, inside):
            sums[segment].add(errors)
        known = np.isfinite(error)
        asked.add(inside, np.where(_scorable(of_truth, signal, low_speed_m_s), 1.0, np.nan))
        squares.add(inside, error, np.where(known, getattr(of_truth, signal), np.nan) ** 2)
        sigma = _total_std(of_estimate, of_truth, signal)
        covered = np.abs(error) <= NORMAL_95 * sigma
        banded.add(inside, np.where(known & np.isfinite(sigma), covered, np.nan))
    references, bands = squares.totals(), banded.totals()
    rows: list[MetricRow] = []

    def add(segment: str, metric: str, value: float, unit: str, n: int) -> None:
        rows.append(MetricRow(log, estimate.name, signal, segment, metric, value, unit, n))

    for segment, (expected, _) in asked.totals().items():
        n = sums[segment].n
        add(segment, "availability", n / expected, "1", expected)
        if n == 0:
            continue
        figures = sums[segment].figures()
        for metric, value in figures.items():
            add(segment, metric, value, SCORED_SIGNALS[signal], n)
        size = float(np.sqrt(references[segment][1][1] / n))
        add(segment, "rmse_relative", figures["rmse"] / size if size > 0 else float("nan"), "1", n)
        if segment in bands:
            within, (covered,) = bands[segment]
            add(segment, "coverage95", float(covered) / within, "1", within)
        if segment == ALL:
            add(segment, "lag_s", _lag_of_first_hour(estimate, truth, masks, signal, low_speed_m_s), "s", n)
    return rows


def _lag_of_first_hour(
    estimate: StateTrack, truth: StateTrack, masks: SegmentMasks, signal: str, low_speed_m_s: float
) -> float:
    end_ns, end = truth.rows(0, 1).stamps_ns[0] + LAG_SPAN_NS, 0
    for a, b in row_blocks(len(truth)):
        end = a + int(np.searchsorted(truth.rows(a, b).stamps_ns, end_ns))
        if end < b:
            break
    estimate, truth = estimate.rows(0, end), truth.rows(0, end)
    use = masks.rows(0, end)[ALL] & np.isfinite(signal_error(estimate, truth, signal, low_speed_m_s))
    return lag_s(truth.stamps_ns, np.where(use, getattr(estimate, signal), np.nan), getattr(truth, signal))


def _total_std(estimate: StateTrack, truth: StateTrack, signal: str) -> FloatArray:
    name = {
        "vx_m_s": "vx_std_m_s",
        "vy_m_s": "vy_std_m_s",
        "yaw_rate_rad_s": "yaw_rate_std_rad_s",
        "sideslip_rad": "sideslip_std_rad",
    }.get(signal)
    if name is None:
        return np.full(len(estimate), np.nan)
    of_truth = np.nan_to_num(getattr(truth, name), nan=0.0)
    return np.asarray(np.hypot(getattr(estimate, name), of_truth), dtype=np.float64)


def _score_position(estimate: StateTrack, truth: StateTrack, log: str) -> list[MetricRow]:
    rows = []
    for signal, blocks in (
        ("position_m", _position_errors(estimate, truth)),
        ("lateral_1s_m", iter([lateral_errors_after_one_second(estimate, truth)])),
    ):
        sums = ErrorSums(len(truth))
        for error in blocks:
            sums.add(error[np.isfinite(error)])
        if sums.n:
            figures = sums.figures()
            if signal == "position_m":
                del figures["bias"]  # a distance has no sign
            rows += [
                MetricRow(log, estimate.name, signal, ALL, metric, value, "m", sums.n)
                for metric, value in figures.items()
            ]
    return rows


def _nees_rows(estimate: StateTrack, truth: StateTrack, masks: SegmentMasks, log: str) -> list[MetricRow]:
    if estimate.rows(0, 1).covariance.shape[0] == 0:
        return []
    sums = SegmentSums()
    for a, b in row_blocks(len(truth)):
        parts = range(a, b, NEES_ROWS)
        value = [_nees_of(*(t.rows(i, min(i + NEES_ROWS, b)) for t in (estimate, truth))) for i in parts]
        sums.add(masks.rows(a, b), np.concatenate(value))
    return [
        MetricRow(log, estimate.name, "state", segment, "nees", float(total) / n, "1", n)
        for segment, (n, (total,)) in sums.totals().items()
    ]


def _nees_of(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    covariance = estimate.covariance
    if truth.covariance.shape[0]:
        covariance = covariance + truth.covariance
    error = np.stack([getattr(estimate, s) - getattr(truth, s) for s in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")], axis=1)
    return nees(np.where((estimate.valid & truth.valid)[:, None], error, np.nan), covariance)


def _pose_known(truth: StateTrack) -> BoolArray:
    known: BoolArray = truth.valid & np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad)
    return known


def _motion_known(track: StateTrack) -> BoolArray:
    known: BoolArray = track.valid & np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s)
    return known & np.isfinite(track.yaw_rate_rad_s)


def _dead_reckon(track: StateTrack, reckoner: DeadReckoner) -> tuple[FloatArray, FloatArray, FloatArray]:
    vx = np.where(track.valid, track.vx_m_s, np.nan)
    return reckoner.add(track.stamps_ns, vx, track.vy_m_s, track.yaw_rate_rad_s)
