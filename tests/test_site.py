"""The documentation site: a strict build, and a search that works from disk."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.reports.browser import CHROMIUM, WHY_NOT

pytest.importorskip("material", reason="builds the site: pip install '.[docs]'")
ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


@pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)
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
