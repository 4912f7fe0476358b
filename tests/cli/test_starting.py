"""A run imports only the modules that its outputs need. Process start dominates the run time of a short log."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_CODE = """
import sys
from pdhef_logtool.cli.app import main
sys.argv = ["pdhef", *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
heavy = ("torch", "rerun", "scipy.linalg", "scipy.special", "scipy.ndimage", "matplotlib", "polars")
print("loaded:", *(name for name in heavy if name in sys.modules))
"""


@pytest.mark.slow
def test_a_light_run_loads_no_torch_scipy_or_rerun(tmp_path: Path) -> None:
    words = ("run", "sample_logs/dlc.mcap", "--car", "saloon", "-o", str(tmp_path / "out"), "--end", "2")
    done = subprocess.run(
        [sys.executable, "-c", _CODE, *words, "--keep", "metrics", "--no-report"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-1].strip() == "loaded:"
