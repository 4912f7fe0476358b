"""All metrics of the tool, in the order of output."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, figures
from pdhef_logtool.records.entries import load_entries
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack

#: Modules of this package that export ``METRICS``. Add the name of a new one here.
MODULES = (
    "errors",
    "innovations",
    "lateral_consistency",
    "yaw_consistency",
    "reference",
    "sensors",
    "independence",
    "handling",
)


def registered() -> Mapping[str, Metric]:
    """Return the metrics by name; their files are imported at the first call."""
    return load_entries("pdhef_logtool.evaluation.metrics", MODULES, "METRICS")


def evaluate_drive(drive: EvaluatedDrive, names: Collection[str] | None = None) -> list[MetricRow]:
    """Return the values of all metrics, or of the metrics with these names."""
    return figures(drive, [m for m in registered().values() if names is None or m.name in names])


def score_track(
    estimate: StateTrack, truth: StateTrack, masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    """Return the metrics of one estimate against ground truth at the same stamps [N].

    ``masks``: bool [N] by segment; ``all`` is added when it is absent. ``low_speed_m_s``: sideslip is scored above
    this ground-truth speed.

    Raises
    ------
    ValueError : The tracks or masks are not at the same stamps.
    """
    return evaluate_drive(EvaluatedDrive(log, {estimate.name: estimate}, truth, None, masks, low_speed_m_s))
