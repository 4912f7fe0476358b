"""Offline sideslip estimation, scoring and annotation of drive logs: the public interface (docs/api.md)."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pdhef_logtool.records.version import __version__

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car as Car
    from pdhef_logtool.drive.options import ReadOptions as ReadOptions
    from pdhef_logtool.drive.reading import Drive as Drive, read_drive as read_drive
    from pdhef_logtool.learning.drives import LearnSettings as LearnSettings
    from pdhef_logtool.learning.learn import learn as learn
    from pdhef_logtool.learning.network.extract_command import ExtractSettings as ExtractSettings, extract as extract
    from pdhef_logtool.learning.network.train_command import run_training as train  # noqa: F401
    from pdhef_logtool.mapping import load_mapping as load_mapping
    from pdhef_logtool.records.errors import PdhefError as PdhefError
    from pdhef_logtool.records.reporter import Reporter as Reporter
    from pdhef_logtool.results.comparing import compare as compare
    from pdhef_logtool.results.opened_run import open_run as open_run
    from pdhef_logtool.results.querying import query as query
    from pdhef_logtool.runs.config import RunConfig as RunConfig
    from pdhef_logtool.runs.estimating import choose as choose
    from pdhef_logtool.runs.fleet import (
        Schedule as Schedule,
        run_logs as run,  # noqa: F401
    )
    from pdhef_logtool.runs.frames import estimate as estimate, score as score
    from pdhef_logtool.runs.inspection.report import inspect_log as inspect_log

#: Module of each public name, ``module`` or ``module:name in it``.
_HOMES = {
    "Car": "car.car",
    "ReadOptions": "drive.options",
    "Drive": "drive.reading",
    "read_drive": "drive.reading",
    "inspect_log": "runs.inspection.report",
    "LearnSettings": "learning.drives",
    "learn": "learning.learn",
    "ExtractSettings": "learning.network.extract_command",
    "extract": "learning.network.extract_command",
    "train": "learning.network.train_command:run_training",
    "load_mapping": "mapping",
    "PdhefError": "records.errors",
    "Reporter": "records.reporter",
    "compare": "results.comparing",
    "open_run": "results.opened_run",
    "query": "results.querying",
    "RunConfig": "runs.config",
    "Schedule": "runs.fleet",
    "choose": "runs.estimating",
    "estimate": "runs.frames",
    "score": "runs.frames",
    "run": "runs.fleet:run_logs",
}
__all__ = ["__version__", *sorted(_HOMES)]


def __dir__() -> list[str]:
    """Return the public names."""
    return [*__all__]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that ``import pdhef_logtool`` stays fast."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own_name = _HOMES[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), own_name or name)
