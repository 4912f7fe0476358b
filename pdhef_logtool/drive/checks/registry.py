"""All checks of signals, ground truth and vehicle file, in the order of their execution."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType

from pdhef_logtool.drive.checks.kind import CheckKind

#: Modules of this package that export ``CHECKS``. Add the name of a new one here.
MODULES = (
    "mounting",
    "by_relations",
    "magnitude",
    "level",
    "truth_sideslip",
    "truth_position",
    "sensor_errors",
    "late_sensors",
    "vehicle_file",
)


def registered() -> Mapping[str, CheckKind]:
    """Return the checks by name; their files are imported at the first call."""
    return _load(MODULES)


@cache
def _load(modules: tuple[str, ...]) -> Mapping[str, CheckKind]:
    kinds: dict[str, CheckKind] = {}
    for module in modules:
        for kind in import_module(f"pdhef_logtool.drive.checks.{module}").CHECKS:
            if kind.name in kinds:
                raise ValueError(f"check {kind.name!r} of {module}.py is registered twice")
            kinds[kind.name] = kind
    return MappingProxyType(kinds)
