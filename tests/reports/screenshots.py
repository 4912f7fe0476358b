"""Writes the pictures of docs/report.md: the pages of the sample logs, as a browser shows them (make pages)."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from browser import Browser

from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

ROOT = Path(__file__).parents[2]
#: Name of the picture, page within the run, and how much of its height is shown.
PICTURES = (("drive.png", "logs/road/report.html", 1560), ("run.png", "report.html", 1100))


def main() -> None:
    logs = [str(ROOT / "sample_logs" / f"{name}.mcap") for name in ("dlc", "road", "sweep", "step")]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        run_logs([log for log in logs if Path(log).is_file()], out, RunConfig(car=Path("saloon"), annotate="none"))
        with Browser(1280, 900) as browser:
            for name, page, height in PICTURES:
                browser.open(out / page)
                browser.screenshot(ROOT / "docs" / "report" / name, height=height)


if __name__ == "__main__":
    (ROOT / "docs" / "report").mkdir(exist_ok=True)
    main()
