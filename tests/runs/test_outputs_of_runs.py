"""Runs that are killed, meet full disks or each other, or would overwrite their input."""

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import LOG_FILES
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.recorded_estimates import score_log
from pdhef_logtool.runs.working import DriveEnd, DriveTask
from pdhef_logtool.workers.supervisor import Tell
from studies.torture.crashes import contents, faults, kill_many, kill_run, leftovers
from tests.command_line import called
from tests.failing_writes import failing_writes
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import run

#: Every command of a process writes the same files, however short the drive.
SLICE = ("--start", "2", "--end", "4")


def config(sample_logs_dir: Path, **changes: Any) -> RunConfig:
    """Return settings of a short run: one second of driving, without the compiler."""
    car = sample_logs_dir / "vehicle.toml"
    return RunConfig(
        **{"car": car, "estimators": ("zero",), "annotate": "sidecar", "start": "2", "end": "3", **changes}
    )


@pytest.fixture
def log(sample_logs_dir):
    return str(sample_logs_dir / "dlc.mcap")


# ------------------------------------------------------------------------------------- outputs that are inputs


def test_a_run_never_replaces_what_it_reads(sample_logs_dir, tmp_path, log):
    folder = tmp_path / "d" / "logs" / "annotated"
    folder.mkdir(parents=True)
    recording = folder / "annotated.mcap"
    shutil.copy(log, recording)
    plan = tmp_path / "plan.toml"
    plan.write_text('[[requirement]]\nid = "a"\nsignal = "sideslip_rad"\nlimit = 1.0\n')
    (tmp_path / "link").symlink_to(tmp_path / "d")
    (tmp_path / "annotated.mcap").symlink_to(recording)
    before = contents(tmp_path)
    plain = config(sample_logs_dir)
    for argument, output in ((recording, tmp_path / "d"), (recording, tmp_path / "link")):
        for act in (run_logs, lambda a, o, c: score_log(a[0], c, estimates=["/x"], output=o)):
            with pytest.raises(UsageError, match="would replace the input"):
                act([str(argument)], output, plain)
    with pytest.raises(UsageError, match="would replace the input"):
        run_logs([str(tmp_path / "annotated.mcap")], tmp_path / "d", plain)
    with pytest.raises(UsageError, match=r"plan\.toml"):
        run_logs([log], tmp_path / "o", config(sample_logs_dir, plan=plan), junit=plan)
    assert contents(tmp_path) == before
    assert not (tmp_path / "o").exists()


def test_a_mapping_in_a_folder_that_is_replaced_is_refused(sample_logs_dir, tmp_path, log):
    mapping = tmp_path / "logs" / "dlc" / "mapping.toml"
    mapping.parent.mkdir(parents=True)
    mapping.write_text("[truth.vy_m_s]\ntopic = 't'\nfield = 'f'\n")
    with pytest.raises(UsageError, match=r"mapping\.toml"):
        run_logs([log], tmp_path, config(sample_logs_dir, mapping=mapping))


# ----------------------------------------------------------------------------------------------- files that stay


def test_a_persons_files_and_what_the_run_does_not_write_stay(sample_logs_dir, tmp_path, log):
    run_logs([log], tmp_path, config(sample_logs_dir))
    folder = tmp_path / "logs" / "dlc"
    (folder / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    run_logs([log], tmp_path, config(sample_logs_dir, estimators=("kinematic",), annotate="none"))
    after = contents(tmp_path)
    assert {p.name for p in folder.iterdir()} == {*LOG_FILES, "notes.txt"}
    kept = ("annotated.mcap", "foxglove.json", "plotjuggler.xml", "notes.txt", "recording.rrd", "model.toml")
    # The page of the run has no estimator.
    same = {p for p in after if after[p] == before[p] and not p.startswith("tables/")} - {"report.html"}
    assert same == {f"logs/dlc/{name}" for name in kept}


# ------------------------------------------------------------------------------------------- disks that fail


@pytest.mark.slow
def test_whichever_write_fails_a_log_is_whole_and_the_error_one_line(sample_logs_dir, tmp_path, log):
    before, after = config(sample_logs_dir), config(sample_logs_dir, estimators=("zero", "kinematic"))
    out, old = tmp_path / "out", tmp_path / "old"
    run_logs([log], out, before)
    (out / "logs" / "dlc" / "notes.txt").write_text("mine")
    shutil.copytree(out, old)
    with failing_writes(0) as counted:
        run_logs([log], out, after)
    states = {"old": contents(old), "new": contents(out)}
    in_log = {k: {p: c for p, c in s.items() if p.startswith("logs")} for k, s in states.items()}
    ended = ""
    # Threads make the number of calls differ by some; test_outputs.py lets each call of a transaction fail.
    number = -30
    while ended != "new" or number < counted.count:
        number += 40
        shutil.rmtree(out)
        shutil.copytree(old, out)
        try:
            with failing_writes(number):
                run_logs([log], out, after)
            ended = "new"
        except OutputError as error:
            ended = "old"
            assert str(error).startswith(str(out)), number
            assert "No space left on device; free some space" in str(error), number
        found = contents(out)
        # The page is made of the finished run: after a failure there is no page, and never the page of the former run.
        here = {p: c for p, c in found.items() if p.startswith("logs")}
        unpaged = {p: c for p, c in in_log["new"].items() if not p.endswith(".html")}
        assert here in (*in_log.values(), unpaged), number
        assert {found["run.json"], states["old"]["run.json"], states["new"]["run.json"]} == {
            states["old"]["run.json"],
            states["new"]["run.json"],
        }, number
        assert found == states["new"] or ended == "old", number
        assert leftovers(out) == [], number
    assert number > 80


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_one_line(sample_logs_dir, tmp_path, log):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="choose a place that you may write to"):
        run_logs([log], tmp_path, config(sample_logs_dir))


def test_a_file_in_the_place_of_a_folder_is_one_line(sample_logs_dir, tmp_path, log):
    (tmp_path / "logs").write_text("mine")
    with pytest.raises(OutputError, match="move it or choose another place"):
        run_logs([log], tmp_path, config(sample_logs_dir))
    assert contents(tmp_path) == {"logs": b"mine"}


# --------------------------------------------------------------------------------------------- kills, two runs


@pytest.mark.slow
def test_kills_leave_whole_logs_and_the_next_run_the_same_results(sample_logs_dir, tmp_path):
    logs = [str(sample_logs_dir / name) for name in ("dlc.mcap", "step.mcap")]
    arguments = [*logs, "--car", "saloon", "-e", "zero", "--no-report", *SLICE]
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    assert called("run", *arguments, "-o", undisturbed).returncode == 0
    terminated = kill_run(arguments, out, after_s=0.0, number=signal.SIGTERM, writing=True)
    assert terminated.exit_code == 143
    said = terminated.said.splitlines()[-1]
    assert said.startswith("pdhef: terminated; no output file was left incomplete")
    assert said.endswith("; 0 of 2 logs are done")
    assert faults(out) == leftovers(out) == []
    (killed,) = kill_many(arguments, out, count=1, lasts_s=0.0, writes_s=0.5, seed=11, signals=(signal.SIGKILL,))
    assert killed.exit_code in (None, -signal.SIGKILL), killed
    assert faults(out) == [], killed
    assert called("run", *arguments, "-o", out).returncode == 0
    found, wanted = contents(out), contents(undisturbed)
    assert found.keys() == wanted.keys()
    del found["journal.jsonl"], wanted["journal.jsonl"]  # it has digests of recordings, which contain times
    assert found == wanted
    assert leftovers(out) == []


def test_a_second_run_in_the_same_folder_is_refused_and_changes_nothing(log, tmp_path):
    def meanwhile(task: DriveTask, tell: Tell) -> DriveEnd:
        with pytest.raises(OutputError, match="another command is writing to"):
            run([log], tmp_path / "out")
        return stub_drive(task, tell)

    run([log], tmp_path / "out", work=meanwhile)
    run([log], tmp_path / "alone")
    assert contents(tmp_path / "out") == contents(tmp_path / "alone")
