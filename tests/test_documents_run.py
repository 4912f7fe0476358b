"""The steps in ARCHITECTURE.md and docs/api.md work as written."""

import doctest
import importlib
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.reports.browser import CHROMIUM, WHY_NOT

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]


def blocks(document: str) -> list[str]:
    text = (ROOT / document).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_the_api_page_runs_as_it_stands(sample_logs_dir, tmp_path, monkeypatch, capsys):
    (code,) = blocks("docs/api.md")
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 30
    (tmp_path / "sample_logs").symlink_to(sample_logs_dir)
    monkeypatch.chdir(tmp_path)
    exec(code, {"__name__": "page"})
    assert "adaptive-physics" in capsys.readouterr().out
    assert (tmp_path / "out" / "mycar" / "model.toml").is_file()


def test_the_notebook_runs_cell_by_cell(sample_logs_dir, tmp_path, monkeypatch, capsys):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    notebook = json.loads((ROOT / "docs" / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(notebook["cells"]) == 15
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook["cells"])
    (tmp_path / "sample_logs").symlink_to(sample_logs_dir)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "notebook"}
    for cell in cells:
        exec(cell, names)
    said = capsys.readouterr().out
    assert "Sideslip RMSE of pd-hef: " in said and "Assumed: " in said and "no-slip: " in said
    assert names["frame"]["steer_deg"].abs().max() > 1.0
    by_name = dict(names["errors"].group_by("estimator").agg(names["rmse"]).iter_rows())
    assert by_name["pd-hef"] < 0.2 < by_name["zero"]
    assert {"step_tb", "step_overshoot"} <= set(names["figures"].collect()["metric"])
    assert 0.2 < math.degrees(names["own_rmse"]) < 10.0


def test_every_name_of_the_api_is_there():
    import pdhef_logtool

    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in pdhef_logtool.__all__:
        assert getattr(pdhef_logtool, name) is not None
        assert re.search(rf"\b{name}\b", page), name


@pytest.mark.parametrize("module", ["car.car", "drive.reading", "runs.frames"])
def test_examples_of_the_api_give_what_they_show(module, monkeypatch):
    monkeypatch.chdir(ROOT)
    done = doctest.testmod(importlib.import_module(f"pdhef_logtool.{module}"))
    assert done.attempted and not done.failed


def test_every_option_of_the_pages_exists():
    import typer

    from pdhef_logtool.cli.app import app

    group = typer.main.get_command(app)
    commands: Any = [group, *group.commands.values()]
    options = {o for c in commands for p in c.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
    unknown = []
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        words = " ".join(line for line in text.splitlines() if line.strip().startswith("pdhef ")).split()
        words += " ".join(re.findall(r"`((?:pdhef |--)[^`]*)`", text)).split()
        unknown += [f"{page.name}: {w}" for w in words if w.startswith("--") and w.partition("=")[0] not in options]
    assert unknown == []


# ---- The documentation site: a strict build, and a search that works from disk ----

pytest.importorskip("material", reason="builds the site: pip install '.[docs]'")


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
