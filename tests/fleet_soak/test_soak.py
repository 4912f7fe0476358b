"""A fleet with damage, missing ground truth, planted faults, kills and growing memory. ``make fleet`` runs it."""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.results.opened_run import JOURNAL_FILE, open_run
from tests.conftest import ROOT, SHARED

pytestmark = [pytest.mark.fleet, pytest.mark.slow]

#: Drives that were simulated once are kept for the next time.
KEPT = ROOT / "out" / "fleet"
DRIVES, DAMAGED, WITHOUT_TRUTH = int(os.environ.get("PDHEF_FLEET_DRIVES", "300")), 10, 10
PLANTED = ("hangs", "takes_8_gb", "kills")


@pytest.fixture(scope="session")
def drives() -> Path:
    """Simulated drives of 12.5 s."""
    from truthsim.suite import write_suite

    folder = KEPT / "drives"
    write_suite(folder, count=DRIVES, seed=15, processes=2)
    return folder


@pytest.fixture(scope="session")
def logs(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that the fleet holds but the real drives."""
    from truthsim.drive import simulate_drive, write_drive

    root = tmp_path_factory.mktemp("logs")
    (root / "drives").symlink_to(drives)
    whole = sorted(drives.glob("*.mcap"))
    damaged = root / "damaged"
    damaged.mkdir()
    for number, path in enumerate(whole[:DAMAGED]):
        data = bytearray(path.read_bytes())
        if number % 2:
            del data[len(data) * number // DAMAGED :]
        else:
            data[len(data) // 3 : len(data) // 3 + 2000] = bytes(2000)
        (damaged / f"damaged_{number}.mcap").write_bytes(data)
    (root / "no_truth").mkdir()
    for number in range(WITHOUT_TRUTH):
        drive = simulate_drive("sine-sweep", seed=number, duration_s=12.5)
        write_drive(drive, root / "no_truth" / f"no_truth_{number}.mcap", without=["rtk", "perfect"])
    (root / "planted").mkdir()
    for name in PLANTED:
        shutil.copy(whole[0], root / "planted" / f"{name}.mcap")
        with (root / "planted" / f"{name}.mcap").open("ab") as file:
            file.write(name.encode())  # no two logs hold the same
    return root


def arguments(logs: Path) -> list[str]:
    """Return the arguments that name all logs of the fleet."""
    real = SHARED / "data" / "drives"
    return [*(str(p) for p in sorted(logs.iterdir())), *([str(real)] if real.is_dir() else [])]


def start(logs: Sequence[str], output: Path, *options: str) -> subprocess.Popen[str]:
    measures = output.with_suffix(".jsonl")
    command = [sys.executable, "-m", "tests.fleet_soak.run_fleet", *logs, "--output", str(output)]
    return subprocess.Popen(
        [*command, "--measures", str(measures), *options],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def finished(logs: Sequence[str], output: Path, *options: str) -> dict[str, Any]:
    """Run to the end; return the document that the run prints."""
    process = start(logs, output, *options)
    said = process.communicate(timeout=7200.0)[0]
    assert process.returncode in (0, 3), said
    return dict(json.loads(said.splitlines()[-1]))


def drives_of(output: Path) -> list[dict[str, Any]]:
    path = output / JOURNAL_FILE
    lines = path.read_text().splitlines() if path.is_file() else []
    documents = [json.loads(line) for line in lines if line.endswith("}")]
    return [d for d in documents if "outcome" in d]


@pytest.fixture(scope="session")
def undisturbed(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    output = tmp_path_factory.mktemp("undisturbed") / "out"
    return output, finished(arguments(logs), output)


def measures(output: Path) -> list[tuple[int, str]]:
    """Return the memory of the process behind each drive and the log's name, in the order of ending."""
    return [tuple(json.loads(line)) for line in output.with_suffix(".jsonl").read_text().splitlines()]


def test_exactly_the_planted_ones_are_given_up(undisturbed: tuple[Path, dict[str, Any]]) -> None:
    output, found = undisturbed
    assert found["exit_code"] == 3
    quarantined = [d["outcome"] for d in drives_of(output) if d["quarantined"]]
    given_up = {o["file"].partition(".")[0]: o["failed"] for o in quarantined}
    assert set(given_up) == set(PLANTED)
    assert given_up["hangs"] == "nothing heard for 60 s, 2 tries; last heard: before it hangs"
    assert "took more than 3000 MB" in given_up["takes_8_gb"]
    assert given_up["kills"].startswith("the worker was killed (signal 9), 2 tries")
    run = open_run(output)
    ended = {log.entry["file"].partition(".")[0]: log.outcome for log in run.logs}
    assert sum(outcome == "ok" for name, outcome in ended.items() if name.startswith("drive_")) == DRIVES
    assert [ended[f"no_truth_{n}"] for n in range(WITHOUT_TRUTH)] == ["ok"] * WITHOUT_TRUTH
    # Damage where no mapped topic lies is not come across.
    assert sum(outcome != "ok" for name, outcome in ended.items() if name.startswith("damaged_")) >= DAMAGED - 3
    assert sum(log.file("recording.rrd") is not None for log in run.logs) == 5
    sizes = [p.stat().st_size for log in run.logs if (p := log.file("report.json")) is not None]
    assert "figures and a short report of each are kept" in found["said"][0]
    assert sorted(sizes)[-6] <= 20_000  # the five worst are kept in full


def test_a_worker_takes_no_more_memory_after_300_drives_than_after_30(undisturbed: tuple[Path, dict[str, Any]]) -> None:
    simulated = [rss for rss, name in measures(undisturbed[0]) if name.startswith("drive_")]
    early, late = statistics.median(simulated[20:40]), statistics.median(simulated[-20:])
    parent = undisturbed[1]["rss_bytes"]
    assert late < 1.15 * early
    assert parent[-1] - parent[len(parent) // 10] < 100e6


def test_the_parents_memory_is_flat_to_3000_logs(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    for number in range(3000):
        (folder / f"log_{number:05d}.mcap").write_text(f"this is {number}")
    output = tmp_path / "out"
    found = finished([str(folder)], output, "--stub")
    memory = found["rss_bytes"]
    assert len(open_run(output).logs) == 3000
    assert memory[-1] - memory[len(memory) // 10] < 30e6
