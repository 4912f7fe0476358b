"""All checks of signals, ground truth and vehicle file, in the order of their execution."""

from __future__ import annotations

from collections.abc import Mapping

from pdhef_logtool.drive.checks.kind import CheckKind
from pdhef_logtool.records.entries import load_entries

#: Modules of this package that export ``CHECKS``. Add the name of a new one here.
MODULES = (
    "mounting",
    "changed",
    "by_relations",
    "level",
    "truth_sideslip",
    "truth_position",
    "sensor_errors",
    "late_sensors",
    "vehicle_file",
)


def registered() -> Mapping[str, CheckKind]:
    """Return the checks by name; their files are imported at the first call."""
    return load_entries("pdhef_logtool.drive.checks", MODULES, "CHECKS")
