"""The track ``reference``: the sideslip reference of a drive at the stamps of its signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.estimators.reference.drive import SideslipReference
from pdhef_logtool.estimators.vehicle_ukf import sideslip_std
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import INDEPENDENT_SHARE, REFERENCE, StateTrack, make_track


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
        """Return the track at stamps [N], from the first span that contains the stamp; NaN outside of all spans."""
        n = len(stamps_ns)
        states, covariance, shares = (np.full((n, 3), np.nan) for _ in range(3))
        valid, filled = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        for span in self.spans:
            inside = ~filled & (stamps_ns >= span.stamps_ns[0]) & (stamps_ns <= span.stamps_ns[-1])
            if inside.any() and len(span.stamps_ns) > 1:
                filled |= inside
                columns = _interpolated(span, stamps_ns[inside])
                states[inside], covariance[inside], shares[inside], valid[inside] = columns
        vx, vy, yaw_rate = states.T
        full = np.full((n, 3, 3), np.nan)
        full[:, 0, 0], full[:, 0, 1], full[:, 1, 0], full[:, 1, 1] = covariance[:, [0, 1, 1, 2]].T
        law, kinematics, gnss = shares.T
        return make_track(
            self.name,
            stamps_ns,
            vx_m_s=vx,
            vy_m_s=vy,
            yaw_rate_rad_s=yaw_rate,
            covariance=full,
            sideslip_std_rad=sideslip_std(vx, vy, full),
            share_law=law,
            share_kinematics=kinematics,
            share_gnss=gnss,
            independent=np.where(np.isnan(gnss), np.nan, gnss > INDEPENDENT_SHARE),
            valid=valid,
        )


def _interpolated(span: SideslipReference, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return v_x, v_y, r [K, 3], covariance of v_x, v_y and shares [K, 3] each, and validity at stamps of a span."""
    left = np.clip(np.searchsorted(span.stamps_ns, stamps_ns, side="right") - 1, 0, len(span.stamps_ns) - 2)
    step_s = np.asarray((span.stamps_ns[left + 1] - span.stamps_ns[left]) * 1e-9, dtype=np.float64)
    share = (stamps_ns - span.stamps_ns[left]) * 1e-9 / step_s

    def between(column: FloatArray) -> FloatArray:
        weight = share.reshape(-1, *[1] * (column.ndim - 1))
        return np.asarray(column[left] * (1.0 - weight) + column[left + 1] * weight)

    vx = _cubic(span.vx_m_s, span.vx_rate_m_s2, left, share, step_s)
    vy = _cubic(span.vy_m_s, span.vy_rate_m_s2, left, share, step_s)
    law, gnss = between(span.law_share), between(span.gnss_share)
    states, shares = (
        np.stack(c, axis=1) for c in ((vx, vy, between(span.yaw_rate_rad_s)), (law, 1.0 - law - gnss, gnss))
    )
    return states, between(span.covariance), shares, span.valid[left] & span.valid[left + 1]


def _cubic(y: FloatArray, slope: FloatArray, left: IntArray, share: FloatArray, step_s: FloatArray) -> FloatArray:
    """Return the cubic through two knots with their slopes (Hermite) at a share [N] of the interval."""
    y0, y1, m0, m1 = y[left], y[left + 1], slope[left] * step_s, slope[left + 1] * step_s
    s, s2, s3 = share, share**2, share**3
    return np.asarray(
        (2.0 * s3 - 3.0 * s2 + 1.0) * y0 + (s3 - 2.0 * s2 + s) * m0 + (3.0 * s2 - 2.0 * s3) * y1 + (s3 - s2) * m1
    )
