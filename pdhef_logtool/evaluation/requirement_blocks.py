"""Metric of each requirement in blocks of 10 s of one drive, for confidence bounds from few drives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.metrics import EvaluatedDrive
from pdhef_logtool.evaluation.metrics.errors import errors_of
from pdhef_logtool.evaluation.smoothing import median_step_ns
from pdhef_logtool.evaluation.track_errors import NORMAL_95, scorable, truth_speed
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.evaluation.validation_plan import MEANS, POOLED, SQUARES, Requirement
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import REFERENCE, StateTrack

#: Errors are correlated over seconds (docs/method.md#evaluation).
BLOCK_S = 10.0
#: Largest number of blocks per requirement in a report; a longer drive has longer blocks.
_MOST_BLOCKS = 60


@dataclass(frozen=True, slots=True)
class RequirementBlocks:
    """The scored driving of one requirement in one drive, block by block.

    Attributes
    ----------
    of : :attr:`~.validation_plan.Requirement.measured`. block_s : length of a block.
    number, n, seconds, metres : index from the start, scored stamps, time and distance of each block [K].
    value, baseline : metric of the estimator and of the baseline in each block [K]; baseline empty without one.
    std : root mean square of the reference's 1-sigma in the block [K]; empty for ground truth.
    """

    of: str
    block_s: float
    number: Sequence[int]
    n: Sequence[int]
    seconds: Sequence[float]
    metres: Sequence[float]
    value: Sequence[float]
    baseline: Sequence[float] = ()
    std: Sequence[float] = ()

    @property
    def estimated(self) -> bool:
        """Whether errors are relative to the estimated reference."""
        return bool(self.std)


def requirement_blocks(
    requirements: Sequence[Requirement], main: str | None, drive: EvaluatedDrive, truth: StateTrack
) -> list[RequirementBlocks]:
    """Return the blocks of all requirements with a mean over stamps as the metric and with data in this drive.

    ``main`` : the selected estimate, for requirements without an estimator. ``truth`` : ground truth of the drive, or
    its estimated reference.
    """
    results: list[RequirementBlocks] = []
    for requirement in requirements:
        name = requirement.estimator or main
        if any(b.of == requirement.measured for b in results) or name is None:
            continue
        if not _has_blocks(requirement, drive, estimated=truth.name == REFERENCE):
            continue
        named = [name, *([requirement.baseline] if requirement.baseline != requirement.other_run else [])]
        tracks = [drive.tracks.get(n) for n in named if n is not None]
        if all(track is not None and len(track) == len(truth) for track in tracks):
            blocks = _blocks(requirement, [t for t in tracks if t is not None], truth, drive)
            if blocks is not None:
                results.append(blocks)
    return results


def _has_blocks(requirement: Requirement, drive: EvaluatedDrive, *, estimated: bool) -> bool:
    scored = requirement.signal in SCORED_SIGNALS and requirement.signal not in drive.dependent
    if estimated:
        return scored and (requirement.signal, requirement.metric) == ("sideslip_rad", "rmse")
    return (
        scored
        and requirement.statistic == POOLED
        and requirement.metric in (SQUARES | MEANS) - {"reference_rms", "reference_independent"}
        and requirement.segment in drive.masks
    )


def _blocks(
    requirement: Requirement, tracks: Sequence[StateTrack], truth: StateTrack, drive: EvaluatedDrive
) -> RequirementBlocks | None:
    """Return the summands of one requirement, summed over blocks of time."""
    estimated = truth.name == REFERENCE
    if not len(truth):
        return None
    since_ns = truth.stamps_ns - truth.stamps_ns[0]
    block_s = BLOCK_S * max(1, math.ceil(float(since_ns[-1]) * 1e-9 / (BLOCK_S * _MOST_BLOCKS)))
    step_s = median_step_ns(truth.stamps_ns) * 1e-9
    columns = _summands(requirement, tracks, truth, drive.low_speed_m_s)
    used = np.isfinite(columns).all(axis=0) & drive.masks[requirement.segment]
    block = since_ns[used] // round(block_s * 1e9)
    way = np.nan_to_num(truth_speed(truth)[used]) * step_s
    std = truth.sideslip_std_rad[used] ** 2 if estimated else np.zeros(len(block))
    sums = np.stack([np.bincount(block, weights) for weights in (np.ones(len(block)), way, std, *columns[:, used])])
    numbers = np.flatnonzero(sums[0])
    kept = sums[:, numbers]
    if not kept.shape[1]:
        return None
    counts, metres, variance, *scored = kept
    power = 0.5 if requirement.metric in SQUARES else 1.0
    values = [_rounded((s / counts) ** power) for s in scored]
    return RequirementBlocks(
        requirement.measured,
        block_s,
        numbers.tolist(),
        [int(c) for c in counts],
        _rounded(counts * step_s),
        _rounded(metres),
        values[0],
        values[1] if len(values) > 1 else (),
        _rounded(np.sqrt(variance / counts)) if estimated else (),
    )


def _rounded(values: FloatArray) -> list[float]:
    return [float(f"{v:.9g}") for v in values]


def _summands(
    requirement: Requirement, tracks: Sequence[StateTrack], truth: StateTrack, low_speed_m_s: float
) -> FloatArray:
    """Return the values [tracks, M] that the metric averages; NaN at stamps that are not scored."""
    used, rows = scorable(truth, requirement.signal, low_speed_m_s), []
    for track in tracks:
        if truth.name == REFERENCE:
            used = truth.valid & (truth.vx_m_s > low_speed_m_s) & (track.vx_m_s > low_speed_m_s)
        columns = errors_of(track, truth, requirement.signal, used)
        error, std = columns["error"], columns.get("std", np.full(len(track), np.nan))
        values = {
            "rmse": error**2,
            "mae": np.abs(error),
            "bias": error,
            "availability": columns["available"],
            "coverage95": np.where(np.isfinite(std), np.abs(error) <= NORMAL_95 * std, np.nan),
        }
        rows.append(values[requirement.metric])
    return np.stack(rows)


def from_document(documents: Sequence[Mapping[str, object]]) -> list[RequirementBlocks]:
    """Return the blocks of a report.json."""
    return [RequirementBlocks(**document) for document in documents]  # type: ignore[arg-type]
