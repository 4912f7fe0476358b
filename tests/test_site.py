"""The documentation site: a strict build, and a search that works from disk."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("material", reason="builds the site: pip install '.[docs]'")
ROOT = Path(__file__).resolve().parents[1]
CHROMIUM = next((p for n in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(n))), None)
pytestmark = pytest.mark.slow


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine (apt-get install chromium)")
def test_the_site_search_works_from_disk(tmp_path):
    assert CHROMIUM is not None
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    page = (tmp_path / "site" / "index.html").as_uri() + "?q=sideslip"
    command = [CHROMIUM, *options, "--virtual-time-budget=20000", "--dump-dom", page]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    assert not re.search(r'<(script|link)[^>]*(src|href)="https?://', dom)
    count = re.search(r"(\d+) matching documents", dom)
    assert count is not None and int(count[1]) > 5
