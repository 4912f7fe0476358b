"""A command imports only the modules that it needs. Process start dominates the run time of a short log."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_CODE = """
import sys
def loaded(*heavy):
    print("loaded:", *(name for name in heavy if name in sys.modules))
import pdhef_logtool
loaded("numpy", "pydantic")
import pdhef_logtool.cli.inspecting, pdhef_logtool.runs.config, pdhef_logtool.runs.inspection, truthsim.manoeuvres
loaded("numba", "torch", "scipy", "rerun", "polars", "pyarrow")
from pdhef_logtool.cli.app import main
sys.argv = ["pdhef", *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
loaded("torch", "rerun", "scipy.linalg", "scipy.special", "scipy.ndimage", "matplotlib", "polars")
"""


@pytest.mark.slow
def test_the_package_an_inspection_and_a_light_run_load_no_large_library_that_they_do_not_need(tmp_path: Path) -> None:
    words = ("run", "sample_logs/dlc.mcap", "--car", "saloon", "-o", str(tmp_path / "out"), "--end", "2")
    done = subprocess.run(
        [sys.executable, "-c", _CODE, *words, "--keep", "metrics", "--no-report"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert [line.strip() for line in done.stdout.splitlines() if line.startswith("loaded:")] == ["loaded:"] * 3
