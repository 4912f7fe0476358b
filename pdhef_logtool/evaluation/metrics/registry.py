"""Every metric of the tool, in the order in which figures are written."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType

from pdhef_logtool.evaluation.metrics.metric import Metric

#: Files of this package that export ``METRICS``. A new metric: a file, and its name here.
MODULES = (
    "availability",
    "errors",
    "coverage",
    "lag",
    "nees",
    "innovations",
    "whiteness",
    "lateral_consistency",
    "yaw_consistency",
    "disagreement",
    "residual_active",
    "reference",
    "sensor_residuals",
    "exposure",
    "independence",
)


def registered() -> Mapping[str, Metric]:
    """Return the metrics by name; their files are imported at the first call."""
    return _load(MODULES)


@cache
def _load(modules: tuple[str, ...]) -> Mapping[str, Metric]:
    metrics: dict[str, Metric] = {}
    for module in modules:
        for metric in import_module(f"pdhef_logtool.evaluation.metrics.{module}").METRICS:
            if metric.name in metrics:
                raise ValueError(f"metric {metric.name!r} of {module}.py is registered twice")
            metrics[metric.name] = metric
    return MappingProxyType(metrics)
