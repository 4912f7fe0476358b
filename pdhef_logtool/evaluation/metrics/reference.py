"""Comparison of estimates with one another and with the sideslip reference, for drives without ground truth."""

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, mean, rms
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import NS_PER_S, FloatArray, IntArray
from pdhef_logtool.records.tracks import REFERENCE, StateTrack

#: Time within which the error of the reference is assumed constant, s.
BLOCK_S = 10.0


def _pairs(drive: EvaluatedDrive) -> Iterator[tuple[str, StateTrack, StateTrack]]:
    tracks = [track for name, track in drive.tracks.items() if name != REFERENCE]
    return ((f"{a.name}~{b.name}", a, b) for a, b in combinations(tracks, 2))


def _disagreement(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the difference of the sideslip of each pair of estimates, without ground truth only."""
    for name, a, b in () if drive.truth is not None or drive.signals is None else _pairs(drive):
        moving = a.valid & b.valid & (a.vx_m_s > drive.low_speed_m_s) & (b.vx_m_s > drive.low_speed_m_s)
        difference = np.where(moving, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
        yield Columns(name, "sideslip_rad", {"difference": difference})


def _activity(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield where a residual with a region of validity acts."""
    for name, track in () if drive.signals is None else drive.tracks.items():
        if ":" not in name and _has_region(track):
            moving = track.valid & (track.vx_m_s > drive.low_speed_m_s)
            active = np.where(moving, track.network_trust > 0.0, np.nan)
            yield Columns(name, "sideslip_rad", {"residual_active": active})


def _has_region(track: StateTrack) -> bool:
    """Return whether the gain is not a constant below 1, which belongs to a network without a region."""
    gain = track.network_trust[np.isfinite(track.network_trust)]
    return bool(gain.size and gain.max() > 0.0 and (gain.min() < gain.max() or gain.max() == 1.0))


def _against_reference(drive: EvaluatedDrive) -> Iterator[Columns]:
    if (reference := drive.tracks.get(REFERENCE)) is None:
        return
    for name, track in drive.tracks.items():
        if name == REFERENCE:
            continue
        used = track.valid & reference.valid
        used &= (reference.vx_m_s > drive.low_speed_m_s) & ~(track.vx_m_s <= drive.low_speed_m_s)
        difference = np.where(used, wrap_angle(track.sideslip_rad - reference.sideslip_rad), np.nan)
        values = {"difference": difference, "std": reference.sideslip_std_rad, "independent": reference.independent}
        yield Columns(name, "sideslip_rad", values)


def _ranked(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the squared differences of each pair from the reference c, with the standard deviation of their difference.

    An error of the reference δ changes the difference of the squares Σ (β_a − β_c)² − (β_b − β_c)² by
    2 Σ (β_a − β_b) δ; δ is its standard deviation, of one sign within ``BLOCK_S`` and independent between.
    """
    if (c := drive.tracks.get(REFERENCE)) is None:
        return
    for name, a, b in _pairs(drive):
        used = a.valid & b.valid & c.valid & (c.vx_m_s > drive.low_speed_m_s)
        of_a, of_b = (wrap_angle(t.sideslip_rad - c.sideslip_rad) ** 2 for t in (a, b))
        std = 2.0 * np.abs(wrap_angle(a.sideslip_rad - b.sideslip_rad)) * c.sideslip_std_rad
        of_a = np.where(used & np.isfinite(of_b + std), of_a, np.nan)
        block = (c.stamps_ns - c.stamps_ns[:1]) // round(BLOCK_S * NS_PER_S)
        yield Columns(name, "sideslip_rad", {"of_a": of_a, "of_b": of_b, "std": std, "block": block})


def _further(of_a: FloatArray, of_b: FloatArray, std: FloatArray, block: IntArray) -> float | None:
    significant = NORMAL_95 * float(np.linalg.norm(np.bincount(block, std)))
    if abs(np.sum(of_a) - np.sum(of_b)) <= significant:
        return None
    return float(np.sqrt(np.mean(of_a)) - np.sqrt(np.mean(of_b)))


METRICS = (
    *described(_disagreement, disagreement_rms=(rms, "difference")),
    *described(_activity, residual_active=mean),
    *described(
        _against_reference,
        reference_rms=(rms, "difference"),
        reference_std=(lambda _, std: rms(std), "difference", "std"),
        reference_independent=(lambda _, independent: mean(independent), "difference", "independent"),
    ),
    *described(_ranked, reference_further=(_further, "of_a", "of_b", "std", "block")),
)
