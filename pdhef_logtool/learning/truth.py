"""Sideslip for training: ground truth, or on request the sideslip reference of a log without ground truth."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.learning.drives import no_true_sideslip
from pdhef_logtool.model.drive_model import DriveModel, lacking
from pdhef_logtool.model.driving import STEP_S, Driving
from pdhef_logtool.records.signals import NS_PER_S, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import reference_of

#: Sideslip error of a single track in rad; ground truth with the same uncertainty has the weight 1/2.
MODEL_STD_RAD = math.radians(0.3)

#: Returns the sideslip for training at stamps [N].
TruthAt = Callable[[IntArray], StateTrack]


def weight_of(std_rad: FloatArray) -> FloatArray:
    """Return weights by the 1-sigma of the sideslip: model variance over the total variance, 1 if exact."""
    return np.asarray(1.0 / (1.0 + (std_rad / MODEL_STD_RAD) ** 2), dtype=np.float64)


def with_truth(driving: Driving, truth: StateTrack) -> Driving:
    """Return driving with ground truth on its grid; NaN in gaps of the ground truth and outside of stretches."""
    start = int(driving.stamps_ns[0]) if len(driving.stamps_ns) else 0
    middle_ns = driving.stamps_ns - round(0.5 * STEP_S * NS_PER_S)  # a cell has the mean of its samples
    seconds, grid = ((s - start).astype(np.float64) for s in (truth.stamps_ns, middle_ns))
    slopes = np.interp(grid, seconds, np.tan(np.where(truth.valid, truth.sideslip_rad, np.nan)), np.nan, np.nan)
    std = np.interp(grid, seconds, np.nan_to_num(truth.sideslip_std_rad))
    inside = np.zeros(len(grid), dtype=np.bool_)
    for first, last in driving.stretches:
        inside[first:last] = True
    return replace(driving, slopes=np.where(inside, slopes, np.nan), weights=weight_of(std))


def teaching_reference(drive: Drive, config: RunConfig) -> tuple[TruthAt | None, str]:
    """Return the reference, or None if a log has ground truth; and the reason if there is neither."""
    lacks = no_true_sideslip(drive.plan)
    if not lacks or config.reference != "on" or lacking(drive):
        return None, lacks
    reference = reference_of(drive, DriveModel.fit(drive), config)
    if reference is None or reference.estimator is None:
        return None, f"{lacks}, and no sideslip reference: {'' if reference is None else reference.document['refused']}"
    reference_at = reference.estimator.at

    def independent(stamps_ns: IntArray) -> StateTrack:
        track = reference_at(stamps_ns)
        return replace(track, valid=track.valid & (track.independent > 0.0))

    return independent, ""
