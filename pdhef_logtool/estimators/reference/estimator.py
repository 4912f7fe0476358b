"""The track ``reference``: the sideslip reference of a drive at the stamps of its signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.estimators.reference.drive import SideslipReference, sideslip_std
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import StepColumns
from pdhef_logtool.records.tracks import INDEPENDENT_SHARE, REFERENCE, StateTrack, make_track


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceSteps(StepColumns):
    """The reference at stamps [K]: v_x, v_y, r [K, 3], covariance of v_x, v_y and shares [K, 3] each."""

    values: FloatArray
    covariance: FloatArray
    shares: FloatArray
    valid: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceEstimator:
    """Returns the reference of spans of a drive, interpolated between knots by cubics with kinematic slopes."""

    algorithm = "sideslip-reference"
    version = 1

    spans: Sequence[SideslipReference]
    notes: tuple[str, ...] = ()
    name: str = REFERENCE
    causal: bool = False
    intervals_note: str = "intervals of the smoother itself"

    def smooth(self, signals: Signals) -> StateTrack:
        """Return the track of a drive (see :class:`~..base.Smoother`)."""
        return self.at(signals.stamps_ns)

    def at(self, stamps_ns: IntArray) -> StateTrack:
        """Return the track at any stamps [N]."""
        return self._track(steps_at(self.spans, stamps_ns), stamps_ns)

    def _track(self, steps: ReferenceSteps, stamps_ns: IntArray) -> StateTrack:
        vx, vy, yaw_rate = steps.values.T
        full = np.full((len(stamps_ns), 3, 3), np.nan)
        full[:, 0, 0], full[:, 0, 1], full[:, 1, 0], full[:, 1, 1] = steps.covariance[:, [0, 1, 1, 2]].T
        law, kinematics, gnss = steps.shares.T
        return make_track(
            self.name,
            stamps_ns,
            vx_m_s=vx,
            vy_m_s=vy,
            yaw_rate_rad_s=yaw_rate,
            covariance=full,
            sideslip_std_rad=sideslip_std(vx, vy, steps.covariance),
            share_law=law,
            share_kinematics=kinematics,
            share_gnss=gnss,
            independent=np.where(np.isnan(gnss), np.nan, gnss > INDEPENDENT_SHARE),
            valid=steps.valid,
        )


def steps_at(spans: Sequence[SideslipReference], stamps_ns: IntArray) -> ReferenceSteps:
    """Return the reference at stamps [N], from the first span that contains the stamp; NaN outside of all spans."""
    n = len(stamps_ns)
    values, covariance, shares = (np.full((n, 3), np.nan) for _ in range(3))
    valid, filled = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
    for span in spans:
        inside = ~filled & (stamps_ns >= span.stamps_ns[0]) & (stamps_ns <= span.stamps_ns[-1])
        if not inside.any() or len(span.stamps_ns) < 2:
            continue
        filled |= inside
        left = np.clip(np.searchsorted(span.stamps_ns, stamps_ns[inside], side="right") - 1, 0, len(span.stamps_ns) - 2)
        step_s = (span.stamps_ns[left + 1] - span.stamps_ns[left]) * 1e-9
        share = (stamps_ns[inside] - span.stamps_ns[left]) * 1e-9 / step_s

        def between(column: FloatArray, left: IntArray = left, share: FloatArray = share) -> FloatArray:
            weight = share.reshape(-1, *[1] * (column.ndim - 1))
            return np.asarray(column[left] * (1.0 - weight) + column[left + 1] * weight)

        vx = _cubic(span.vx_m_s, span.vx_rate_m_s2, left, share, step_s)
        vy = _cubic(span.vy_m_s, span.vy_rate_m_s2, left, share, step_s)
        values[inside] = np.stack([vx, vy, between(span.yaw_rate_rad_s)], axis=1)
        covariance[inside] = between(span.covariance)
        law, gnss = between(span.law_share), between(span.gnss_share)
        shares[inside] = np.stack([law, 1.0 - law - gnss, gnss], axis=1)
        valid[inside] = span.valid[left] & span.valid[left + 1]
    return ReferenceSteps(values, covariance, shares, valid)


def _cubic(y: FloatArray, slope: FloatArray, left: IntArray, share: FloatArray, step_s: FloatArray) -> FloatArray:
    """Return the cubic through two knots with their slopes (Hermite) at a share [N] of the interval."""
    y0, y1, m0, m1 = y[left], y[left + 1], slope[left] * step_s, slope[left + 1] * step_s
    s, s2, s3 = share, share**2, share**3
    return np.asarray(
        (2.0 * s3 - 3.0 * s2 + 1.0) * y0 + (s3 - 2.0 * s2 + s) * m0 + (3.0 * s2 - 2.0 * s3) * y1 + (s3 - s2) * m1
    )
