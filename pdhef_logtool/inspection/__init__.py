"""What a log holds, how it maps to signals, and whether that makes sense."""

from __future__ import annotations

from pdhef_logtool.inspection.rendering import render_inspection
from pdhef_logtool.inspection.report import (
    ClockReport,
    Inspection,
    SignalReport,
    TopicReport,
    inspect_drive_log,
    inspect_log,
    mapping_comments,
    write_mapping,
)

__all__ = [
    "ClockReport",
    "Inspection",
    "SignalReport",
    "TopicReport",
    "inspect_drive_log",
    "inspect_log",
    "mapping_comments",
    "render_inspection",
    "write_mapping",
]
