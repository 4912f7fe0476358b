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
from pdhef_logtool.records.geometry import dead_reckon, wrap_angle
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
    _check_shapes(estimate, truth, masks)
    masks = {ALL: np.ones(len(truth), dtype=np.bool_), **masks}
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
    rows = []
    innovation = np.isfinite(track.nis) & (track.nis_dof > 0)
    for segment, mask in masks.items():
        use = mask & innovation
        n = int(np.count_nonzero(use))
        if n:
            mean, dof = float(np.mean(track.nis[use])), float(np.mean(track.nis_dof[use]))
            rows.append(MetricRow(log, track.name, "state", segment, "nis", mean, "1", n))
            rows.append(MetricRow(log, track.name, "state", segment, "nis_dof", dof, "1", n))
        inside = int(np.count_nonzero(mask))
        if inside:
            share = float(np.mean(track.diverged[mask]))
            rows.append(MetricRow(log, track.name, "state", segment, "diverged", share, "1", inside))
    return rows


def known_by_segment(values: FloatArray, masks: Mapping[str, BoolArray]) -> Iterator[tuple[str, FloatArray]]:
    """Yield the finite ones of values [N] of each segment that has any."""
    for segment, mask in masks.items():
        inside = values[mask & np.isfinite(values)]
        if inside.size:
            yield segment, inside


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
    size = np.abs(error)
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "mae": float(np.mean(size)),
        "bias": float(np.mean(error)),
        "p95_abs": float(np.percentile(size, 95.0)),
        "max_abs": float(np.max(size)),
    }


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
    error = np.full(len(truth), np.nan)
    pose = _pose_known(truth)
    ready = np.flatnonzero(pose & _motion_known(estimate))
    if ready.size:
        first = int(ready[0])
        start = (float(truth.x_m[first]), float(truth.y_m[first]), float(truth.yaw_rad[first]))
        x, y, _ = _dead_reckon(estimate, first, start)
        error[first:] = np.where(pose[first:], np.hypot(x - truth.x_m[first:], y - truth.y_m[first:]), np.nan)
    return error


def lateral_errors_after_one_second(estimate: StateTrack, truth: StateTrack) -> FloatArray:
    """Return the lateral error [K] in m at the end of each second that can be scored; positive = estimate left."""
    pose, motion = _pose_known(truth), _motion_known(estimate)
    if not (pose & motion).any():
        return np.empty(0)
    t = truth.stamps_ns
    first = int(np.flatnonzero(pose & motion)[0])
    marks = np.arange(int(t[first]), int(t[-1]) + 1, round(ANCHOR_S * 1e9))
    anchors = np.searchsorted(t, marks)
    i, j = anchors[:-1], anchors[1:]
    lost = np.concatenate([[0], np.cumsum(~motion)])
    gaps = np.concatenate([[0], np.cumsum(np.diff(t) > round(MAX_STEP_S * 1e9))])
    whole = (lost[j + 1] == lost[i]) & (gaps[j] == gaps[i]) & pose[i] & pose[j] & (j > i)
    i, j = i[whole], j[whole]
    # One dead reckoning serves all seconds: a new start pose only turns and moves it.
    x, y, yaw = _dead_reckon(estimate, 0, (0.0, 0.0, 0.0))
    turn = truth.yaw_rad[i] - yaw[i]
    dx = np.cos(turn) * (x[j] - x[i]) - np.sin(turn) * (y[j] - y[i]) - (truth.x_m[j] - truth.x_m[i])
    dy = np.sin(turn) * (x[j] - x[i]) + np.cos(turn) * (y[j] - y[i]) - (truth.y_m[j] - truth.y_m[i])
    return np.asarray(-np.sin(truth.yaw_rad[j]) * dx + np.cos(truth.yaw_rad[j]) * dy, dtype=np.float64)


def _check_shapes(estimate: StateTrack, truth: StateTrack, masks: Mapping[str, BoolArray]) -> None:
    if not np.array_equal(estimate.stamps_ns, truth.stamps_ns):
        raise ValueError(f"estimate {estimate.name} and truth must be at the same stamps")
    for name, mask in masks.items():
        if mask.shape != (len(truth),):
            raise ValueError(f"mask {name}: expected shape ({len(truth)},), got {mask.shape}")


def _scorable(truth: StateTrack, signal: str, low_speed_m_s: float) -> BoolArray:
    scorable: BoolArray = truth.valid & np.isfinite(getattr(truth, signal))
    if signal == "sideslip_rad":
        scorable = scorable & (truth_speed(truth) > low_speed_m_s)
    return scorable


def _score_signal(
    estimate: StateTrack, truth: StateTrack, masks: Mapping[str, BoolArray], signal: str, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    scorable = _scorable(truth, signal, low_speed_m_s)
    error = signal_error(estimate, truth, signal, low_speed_m_s)
    reference: FloatArray = getattr(truth, signal)
    sigma = _total_std(estimate, truth, signal)
    rows: list[MetricRow] = []

    def add(segment: str, metric: str, value: float, unit: str, n: int) -> None:
        rows.append(MetricRow(log, estimate.name, signal, segment, metric, value, unit, n))

    for segment, mask in masks.items():
        asked = mask & scorable
        expected = int(np.count_nonzero(asked))
        if expected == 0:
            continue
        use = asked & np.isfinite(error)
        n = int(np.count_nonzero(use))
        add(segment, "availability", n / expected, "1", expected)
        if n == 0:
            continue
        figures = summarise_errors(error[use])
        for metric, value in figures.items():
            add(segment, metric, value, SCORED_SIGNALS[signal], n)
        size = float(np.sqrt(np.mean(reference[use] ** 2)))
        add(segment, "rmse_relative", figures["rmse"] / size if size > 0 else float("nan"), "1", n)
        banded = use & np.isfinite(sigma)
        if banded.any():
            covered = np.abs(error[banded]) <= NORMAL_95 * sigma[banded]
            add(segment, "coverage95", float(np.mean(covered)), "1", int(covered.size))
        if segment == ALL:
            stamps = truth.stamps_ns
            hour = slice(0, int(np.searchsorted(stamps, stamps[0] + LAG_SPAN_NS)))
            values = np.where(use[hour], getattr(estimate, signal)[hour], np.nan)
            add(segment, "lag_s", lag_s(stamps[hour], values, reference[hour]), "s", n)
    return rows


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
    for signal, error in (
        ("position_m", position_error(estimate, truth)),
        ("lateral_1s_m", lateral_errors_after_one_second(estimate, truth)),
    ):
        error = error[np.isfinite(error)]
        if error.size:
            figures = summarise_errors(error)
            if signal == "position_m":
                del figures["bias"]  # a distance has no sign
            rows += [
                MetricRow(log, estimate.name, signal, ALL, metric, value, "m", int(error.size))
                for metric, value in figures.items()
            ]
    return rows


def _nees_rows(estimate: StateTrack, truth: StateTrack, masks: Mapping[str, BoolArray], log: str) -> list[MetricRow]:
    n = len(estimate)
    if estimate.rows(0, 1).covariance.shape[0] == 0:
        return []
    starts = range(0, n, NEES_ROWS)
    blocks = [_nees_of(*(t.rows(a, a + NEES_ROWS) for t in (estimate, truth))) for a in starts]
    value = np.concatenate(blocks)
    return [
        MetricRow(log, estimate.name, "state", segment, "nees", float(np.mean(inside)), "1", int(inside.size))
        for segment, inside in known_by_segment(value, masks)
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


def _dead_reckon(
    track: StateTrack, first: int, start: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    vx = np.where(track.valid, track.vx_m_s, np.nan)
    return dead_reckon(track.stamps_ns[first:], vx[first:], track.vy_m_s[first:], track.yaw_rate_rad_s[first:], start)
