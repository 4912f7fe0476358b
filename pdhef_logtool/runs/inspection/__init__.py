"""Contents of a log, its mapping to signals, and plausibility checks."""

from __future__ import annotations

from pdhef_logtool.runs.inspection.asking import ask_mapping as ask_mapping
from pdhef_logtool.runs.inspection.fields import fields_of_log as fields_of_log
from pdhef_logtool.runs.inspection.report import inspect_drive_log as inspect_drive_log
from pdhef_logtool.runs.inspection.report import inspect_log as inspect_log
from pdhef_logtool.runs.inspection.report import write_mapping as write_mapping
