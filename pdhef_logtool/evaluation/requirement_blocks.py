"""Metric of each requirement in blocks of 10 s of one drive, for confidence bounds from few drives."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.evaluation.metrics import EvaluatedDrive
from pdhef_logtool.evaluation.metrics.errors import errors_of
from pdhef_logtool.evaluation.metrics.metric import registered, rms
from pdhef_logtool.evaluation.smoothing import median_step_ns
from pdhef_logtool.evaluation.track_errors import scorable, truth_speed
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.evaluation.validation_plan import MEANS, POOLED, SQUARES, Requirement
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS
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
    requirements: Sequence[Requirement], main: str | None, drive: EvaluatedDrive
) -> list[RequirementBlocks]:
    """Return the blocks of all requirements with a mean over stamps as the metric and with data in this drive.

    Errors are relative to ground truth; where it does not score a requirement, to the estimated reference.
    ``main`` : the selected estimate, for requirements without an estimator.
    """
    results: dict[str, RequirementBlocks] = {}
    for truth in filter(None, (drive.truth, drive.tracks.get(REFERENCE))):
        for requirement in requirements:
            name = requirement.estimator or main
            names = [name, *filter(None, {requirement.baseline} - {requirement.other_run})]
            tracks = [track for n in names if (track := drive.tracks.get(n or "")) is not None]
            if requirement.measured in results or len(tracks) < len(names):
                continue
            if _has_blocks(requirement, drive, estimated=truth.name == REFERENCE):
                blocks = _blocks(requirement, tracks, truth, drive)
                results |= {} if blocks is None else {requirement.measured: blocks}
    return list(results.values())


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
    """Return the metric of one requirement in blocks of time."""
    if not len(truth):
        return None
    estimated, metric = truth.name == REFERENCE, registered()[requirement.metric]
    since_ns = truth.stamps_ns - truth.stamps_ns[0]
    block_s = BLOCK_S * max(1, math.ceil(float(since_ns[-1]) * S_PER_NS / (BLOCK_S * _MOST_BLOCKS)))
    step_s = median_step_ns(truth.stamps_ns) * S_PER_NS
    scored = scorable(truth, requirement.signal, drive.low_speed_m_s)
    if estimated:
        scored = np.logical_and.reduce([truth.valid, *(t.vx_m_s > drive.low_speed_m_s for t in (truth, *tracks))])
    columns = [errors_of(track, truth, requirement.signal, scored) for track in tracks]
    if not all(columns_of.keys() >= {*metric.over} for columns_of in columns):
        return None
    used = np.all([np.isfinite(c[metric.over[0]]) for c in columns], axis=0) & drive.masks[requirement.segment]
    numbers, firsts = np.unique(since_ns[used] // round(block_s * NS_PER_S), return_index=True)
    if not len(numbers):
        return None
    parts, way = np.split(np.flatnonzero(used), firsts[1:]), np.nan_to_num(truth_speed(truth)) * step_s
    values = [_rounded(metric.formula(*(c[name][p] for name in metric.over)) for p in parts) for c in columns]
    return RequirementBlocks(
        requirement.measured,
        block_s,
        numbers.tolist(),
        [len(p) for p in parts],
        _rounded(len(p) * step_s for p in parts),
        _rounded(way[p].sum() for p in parts),
        values[0],
        values[1] if len(values) > 1 else (),
        _rounded(rms(truth.sideslip_std_rad[p]) for p in parts) if estimated else (),
    )


def _rounded(values: Iterable[float | None]) -> list[float]:
    return [float(f"{v:.9g}") for v in values]


def from_document(documents: Sequence[Mapping[str, object]]) -> list[RequirementBlocks]:
    """Return the blocks of a report.json."""
    return [RequirementBlocks(**document) for document in documents]  # type: ignore[arg-type]
