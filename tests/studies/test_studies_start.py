"""Every study runs on this version: each on a tiny set, with its page and results in a temporary folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from studies.pages import DRIVES, ROOT

pytestmark = pytest.mark.slow

SIMULATED = {
    "conditions": ("conditions.md", "studies.conditions --rows in-domain paper-a --drives 1 --jobs 1"),
    "calibration": ("calibration.md", "studies.calibration --cars 1"),
    "comparing": ("calibration.md", "studies.comparing --times 20 --planted 20"),
    "reference": ("reference.md", "studies.reference --cases step.steer,.100.km/h,.GNSS.RTK"),
}
RECORDED = {
    "teaching": ("peers.md", "studies.teaching --cars TT-S"),
    "reference": ("reference.md", "studies.reference --cases Volvo.V40,.slalom,.GNSS.recorded"),
}
NO_RESULTS = ("studies.calibration", "studies.comparing")


def ran(words: str, *options: object) -> str:
    """Run a module with the options, and return what it prints."""
    command = [sys.executable, "-m", *words.split(), *map(str, options)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def start(folder: Path, page: str, words: str) -> None:
    module, *words_of_options = words.split()
    options = [word.replace(".", " ") for word in words_of_options]
    options += [] if module == "studies.comparing" else ["--work", str(folder / "work")]
    options += [] if module in NO_RESULTS else ["--results", str(folder / "results")]
    ran(module, *options, "--out", folder)
    assert "<!-- begin" in (folder / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", SIMULATED)
def test_a_study_of_simulated_drives_starts(name, tmp_path):
    start(tmp_path, *SIMULATED[name])


@pytest.mark.skipif(not DRIVES.is_dir(), reason="needs the recorded drives")
@pytest.mark.parametrize("name", RECORDED)
def test_a_study_of_recorded_drives_starts(name, tmp_path):
    start(tmp_path, *RECORDED[name])


@pytest.mark.skipif(not DRIVES.is_dir(), reason="needs the recorded drives")
def test_the_benchmark_of_own_logs_prints_a_table_without_a_vehicle_file(tmp_path):
    (tmp_path / "v40_slalom.mcap").symlink_to(DRIVES / "v40_slalom.mcap")
    said = ran("studies.peers", "--folder", tmp_path, "--work", tmp_path / "work")
    assert "| `pd-hef` | 1 |" in said


def test_the_torture_judges_mutants_of_every_container(tmp_path):
    words = "studies.torture mutations formats --logs 11 --count 1 --format csv --format bag --jobs 1"
    ran(words, "--work", tmp_path, "--out", tmp_path / "none")
    assert (tmp_path / "formats.json").is_file()
