"""A command imports only the modules that it needs. Process start dominates the run time of a short log."""

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
def test_the_package_an_inspection_and_a_light_run_load_no_large_library_that_they_do_not_need(tmp_path):
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


#: Read by every Python process that starts, workers too: as if PyTorch were not installed.
_BLOCKED = """
import sys
from importlib.machinery import PathFinder

class WithoutTorch(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] == "torch" else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutTorch
"""
_COMMANDS = """
import contextlib, io, sys
from pdhef_logtool.cli.app import main
for line in sys.stdin.read().splitlines():
    sys.argv, said = ["pdhef", *line.split("|")], io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            main()
        code = 0
    except SystemExit as ended:
        code = ended.code or 0
    print("ended:", line.split("|")[0], code, " ".join(said.getvalue().split()), flush=True)
"""


def ended_without_torch(folder: Path, *commands: tuple[object, ...]) -> list[str]:
    """Run commands in a separate process; return their names, exit codes and lines on stderr."""
    (folder / "sitecustomize.py").write_text(_BLOCKED)
    done = subprocess.run(
        [sys.executable, "-c", _COMMANDS],
        input="\n".join("|".join(map(str, words)) for words in commands),
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=True,
    )
    return [line.removeprefix("ended: ") for line in done.stdout.splitlines() if line.startswith("ended: ")]


@pytest.mark.slow
def test_what_trains_no_network_works_without_it_and_what_trains_one_ends_with_one_line(tmp_path):
    drive = ("sample_logs/dlc.mcap", "--car", "saloon", "--set", "end=3")
    trained = ("train", tmp_path, "-o", tmp_path / "network")
    ran, extracted, *refused = ended_without_torch(
        tmp_path,
        ("run", *drive, "-e", "pd-hef,physics", "--annotate", "none", "-o", tmp_path / "out"),
        ("extract", *drive, "-o", tmp_path / "residuals"),
        trained,
    )
    assert ran.startswith("run 0") and extracted.startswith("extract 0")
    assert (tmp_path / "out/logs/dlc/report.html").is_file()
    remedy = "got an installation without it; pip install 'pdhef-logtool[train]'"
    for line in refused:
        assert line.startswith("train 2 ") and remedy in line, line
    assert not (tmp_path / "network").exists()
