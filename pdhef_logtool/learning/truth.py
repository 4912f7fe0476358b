"""The sideslip that teaches: ground truth, or on request the sideslip reference where a log has none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.learning.drives import no_true_sideslip
from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import reference_of
from pdhef_logtool.runs.self_calibrating import calibrate_drive, lacking

#: Sideslip error of a single track, at which ground truth of the same uncertainty has half the weight, rad.
MODEL_STD_RAD = math.radians(0.3)

#: Gives what teaches at stamps [N].
TruthAt = Callable[[IntArray], StateTrack]


def weight_of(std_rad: FloatArray) -> FloatArray:
    """Return the weights of a sideslip by its 1-sigma: one over its variance and the model's together, 1 if exact."""
    return np.asarray(1.0 / (1.0 + (std_rad / MODEL_STD_RAD) ** 2), dtype=np.float64)


def teaching_reference(drive: Drive, config: RunConfig) -> tuple[TruthAt | None, str]:
    """Return the reference that teaches, None where a log has ground truth; and why there is neither."""
    lacks = no_true_sideslip(drive.plan)
    if not lacks or config.reference != "on" or lacking(drive):
        return None, lacks
    reference = reference_of(drive, calibrate_drive(drive, config), config)
    if reference is None or reference.estimator is None:
        return None, f"{lacks}, and no sideslip reference: {'' if reference is None else reference.document['refused']}"
    reference_at = reference.estimator.at
    return lambda stamps_ns: independent(reference_at(stamps_ns)), ""


def independent(reference: StateTrack) -> StateTrack:
    """Return a reference without the stamps at which it is not independent of the estimators' sensors."""
    return replace(reference, valid=reference.valid & (reference.independent > 0.0))
