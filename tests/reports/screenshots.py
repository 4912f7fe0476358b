"""Writes the pictures of docs/report.md: the pages of the sample logs, as a browser shows them (make pages)."""

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from browser import Browser
from PIL import Image

from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

ROOT = Path(__file__).parents[2]
#: Name of the picture, page within the run, and how much of its height is shown.
PICTURES = (("drive.png", "logs/road/report.html", 1560), ("run.png", "report.html", 1100))

#: Until the web viewer of Rerun has drawn a recording with software.
WAIT_S = 75.0


def main() -> None:
    logs = [str(ROOT / "sample_logs" / f"{name}.mcap") for name in ("dlc", "road", "sweep", "step")]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        run_logs([log for log in logs if Path(log).is_file()], out, RunConfig(car=Path("saloon"), annotate="none"))
        with Browser(1280, 900) as browser:
            for name, page, height in PICTURES:
                browser.open(out / page)
                browser.screenshot(ROOT / "docs" / "report" / name, height=height)
        picture_of_recording(out / "logs" / "dlc" / "recording.rrd", ROOT / "docs" / "report" / "recording.png")


def picture_of_recording(recording: Path, picture: Path) -> None:
    """Take a picture of a recording in Rerun's web viewer."""
    with socket.socket() as web, socket.socket() as data:
        for free in (web, data):
            free.bind(("127.0.0.1", 0))
        web_port, data_port = web.getsockname()[1], data.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--serve-web", str(recording)]
    with tempfile.TemporaryDirectory() as home:
        server = subprocess.Popen(
            [*command, "--web-viewer-port", str(web_port), "--port", str(data_port)],
            env={**os.environ, "HOME": home},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            time.sleep(5.0)
            source = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data_port}%2Fproxy"
            with Browser(1600, 1000, webgl=True) as browser:
                browser.call("Page.navigate", url=f"http://127.0.0.1:{web_port}/?url={source}&renderer=webgl")
                time.sleep(WAIT_S)  # it draws without end, and states nowhere that it is ready
                browser.screenshot(picture)
            Image.open(picture).convert("RGB").quantize(128).save(picture, optimize=True)
        finally:
            server.terminate()
            server.wait(10.0)


if __name__ == "__main__":
    (ROOT / "docs" / "report").mkdir(exist_ok=True)
    main()
