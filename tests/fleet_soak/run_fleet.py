"""``python -m tests.fleet_soak.run_fleet LOGS --output OUT --measures FILE``: a run with planted faults, as a process.

Its work on a drive plants the faults and writes the memory after each drive to the file.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import Schedule, run_logs
from pdhef_logtool.workers.supervisor import Limits
from tests.fleet_soak.planted import MEASURES, measured_drive, measured_stub, rss_bytes


def main() -> int:
    """Run a fleet; print its exit code, the parent's memory over the run and the notes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("logs", nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--measures", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--stub", action="store_true")
    parser.add_argument("--silence", type=float, default=60.0)
    given = parser.parse_args()
    os.environ[MEASURES] = str(given.measures)
    memory: list[int] = []
    said: list[str] = []
    result = run_logs(
        given.logs,
        given.output,
        RunConfig(car=Path("saloon")),
        schedule=Schedule(given.jobs, resume=given.resume, limits=Limits(given.silence, 3_000_000_000)),
        report=not given.stub,
        work=measured_stub if given.stub else measured_drive,
        reporter=Reporter(lambda _text, _share: memory.append(rss_bytes()), note=said.append),
    )
    print(json.dumps({"exit_code": result.exit_code, "rss_bytes": memory, "said": said}))
    return result.exit_code


if __name__ == "__main__":
    sys.exit(main())
