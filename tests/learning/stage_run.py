"""One stage of ``learn`` alone, as most tests of a stage run it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.engine import LearnResult, learn
from pdhef_logtool.logs.discovery import Logs
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.runs.config import RunConfig


def run_stage(
    stage: str,
    logs: Logs,
    output: Path | str,
    config: RunConfig,
    *,
    reporter: Reporter = SILENT,
    **settings: Any,
) -> LearnResult:
    """Run one stage on logs and write the car to ``output``."""
    return learn(logs, output, LearnSettings(config=config, stage=stage, **settings), reporter=reporter)
