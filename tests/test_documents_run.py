"""What ARCHITECTURE.md and docs/api.md tell a reader to do works as it stands there."""

from __future__ import annotations

import doctest
import importlib
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.estimators import table
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


def blocks(document: str) -> list[str]:
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_an_estimator_added_as_architecture_says_runs_under_its_name_as_itself(
    monkeypatch: pytest.MonkeyPatch, sample_logs_dir: Path, tmp_path: Path
) -> None:
    code, line = blocks("ARCHITECTURE.md")
    module = types.ModuleType("pdhef_logtool.estimators.half_slip")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(code, module.__dict__)
    needs, spec = line.split("\n", 1)
    names = {"Spec": table.Spec}
    exec(needs, names)
    monkeypatch.setattr(table, "SPECS", (*table.SPECS, eval(spec.strip(), names)))
    config = RunConfig(car=Path("saloon"), estimators=("zero", "half-slip"), annotate="none")
    result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path, config)
    (report,) = (r.report for r in result.results)
    assert report is not None
    ran = {e["name"]: e["algorithm"]["algorithm"] for e in report["estimators"]}
    assert ran == {"zero": "pass-through", "half-slip": "half-slip"}
    rows = pl.read_parquet(tmp_path / "logs" / "dlc" / "estimates.parquet").filter(estimator="half-slip")
    valid = rows.filter("valid")
    assert len(valid) > 900
    assert np.abs(valid["vy_m_s"].to_numpy()).max() > 0.05
    scored = {r.metric for r in result.results[0].rows if r.estimator == "half-slip" and r.signal == "sideslip_rad"}
    assert "rmse" in scored


def test_the_api_page_runs_as_it_stands(sample_logs_dir: Path, tmp_path: Path) -> None:
    (code,) = blocks("docs/api.md")
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 30
    (tmp_path / "sample_logs").symlink_to(sample_logs_dir)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "adaptive-physics" in done.stdout
    assert (tmp_path / "out" / "mycar" / "noise.toml").is_file()


def test_importing_the_package_loads_nothing() -> None:
    code = "import sys; before = set(sys.modules); import pdhef_logtool; print(sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "numpy" not in done.stdout and "pydantic" not in done.stdout


def test_every_name_of_the_api_is_there() -> None:
    import pdhef_logtool

    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in pdhef_logtool.__all__:
        assert getattr(pdhef_logtool, name) is not None
        assert re.search(rf"\b{name}\b", page), name


@pytest.mark.parametrize("module", ["car.car", "drive.reading", "runs.frames"])
def test_examples_of_the_api_give_what_they_show(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    done = doctest.testmod(importlib.import_module(f"pdhef_logtool.{module}"))
    assert done.attempted and not done.failed
