"""Runs on storage that fails, and runs that are killed, meet each other, or would overwrite their input."""

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pdhef_logtool import RunConfig, open_run
from pdhef_logtool.logs import byte_source
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.runs import working
from pdhef_logtool.runs.drive_outputs import LOG_FILES
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.journal import Journal
from pdhef_logtool.runs.recorded_estimates import score_log
from pdhef_logtool.runs.working import DriveEnd, DriveTask, run_drive
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.workers.supervisor import Tell
from studies.torture.crashes import contents, faults, kill_run, leftovers
from studies.torture.workers import Ended, command
from tests.command_line import called
from tests.failing_writes import failing_writes
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import Counted, contents as without_journal, named_logs, run

#: Every command of a process writes the same files, however short the drive.
SLICE = ("--start", "2", "--end", "4")


def config(sample_logs_dir: Path, **changes: Any) -> RunConfig:
    """Return settings of a short run: one second of driving, without the compiler."""
    usual = {"car": sample_logs_dir / "vehicle.toml", "estimators": ("zero",), "annotate": "sidecar"}
    return RunConfig(**{**usual, "start": "2", "end": "3", **changes})


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
    assert terminated.code == 143
    said = terminated.err.splitlines()[-1]
    assert said.startswith("pdhef: terminated; no output file was left incomplete")
    assert said.endswith("; 0 of 2 logs are done")
    assert faults(out) == leftovers(out) == []
    killed = kill_run(arguments, out, after_s=0.2, writing=True)
    assert killed.code in (0, -signal.SIGKILL), killed
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


CONFIG = RunConfig(car=Path("saloon"), estimators=("zero",), keep="metrics", end="1.5")


@pytest.fixture
def logs(sample_logs_dir, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("dlc", "step"):
        shutil.copy(sample_logs_dir / f"{name}.mcap", folder)
    return folder


@pytest.mark.slow
def test_a_log_that_changes_fails_alone_and_is_run_again(logs, tmp_path):
    def changing(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
        def told(text: str, share: float) -> None:
            if task.log.stem == "dlc" and share > 0.5:
                os.utime(task.log.path)
            tell(text, share)

        return run_drive(task, told)

    result = run([str(logs)], tmp_path / "out", CONFIG, work=changing)
    assert result.exit_code == 3
    failed = {r.outcome.log: r.outcome.failed for r in result.results}
    assert failed["step"] is None
    assert "changed while it was read" in str(failed["dlc"])
    assert not (tmp_path / "out/logs/dlc").exists()
    assert run([str(logs)], tmp_path / "out", CONFIG, work=run_drive, resume=True).exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize("returns", [True, False])
def test_a_log_that_vanishes_is_waited_for_and_is_not_given_up(logs, tmp_path, monkeypatch, returns):
    monkeypatch.setattr(working, "_WAITS_S", (0.0, 0.0))
    away, lines = tmp_path / "away", list[str]()

    def vanishing(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
        if task.log.stem == "dlc":
            logs.rename(away)

        def told(text: str, share: float) -> None:
            lines.append(text)
            if returns and text == "dlc: waits for the log":
                away.rename(logs)

        end = run_drive(task, told)
        if away.exists():
            away.rename(logs)
        return end

    out = tmp_path / "out"
    assert run([str(logs)], out, CONFIG, work=vanishing).exit_code == (0 if returns else 3)
    assert lines.count("dlc: waits for the log") == (1 if returns else 2)
    assert run([str(logs)], out, CONFIG, work=run_drive, resume=True).exit_code == 0


def test_a_disk_that_fails_is_no_damage_of_the_log():
    with pytest.raises(byte_source.SourceError, match="Stale file handle"):
        byte_source.raise_source_error(OSError(116, "Stale file handle"))
    byte_source.raise_source_error(ValueError("damage"))


def full_disk(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
    """Meet a full disk at the drive ``b``."""
    if task.log.stem != "b":
        return stub_drive(task, tell)
    try:
        with failing_writes(1):
            write_bytes(task.output / "x", b"x")
    except OutputError as error:
        assert error.ends_run
        return error
    raise AssertionError


def test_a_full_disk_ends_the_run_at_once_and_quarantines_nothing(tmp_path):
    folder, out, work = named_logs(tmp_path / "logs", "a", "b", "c", "d"), tmp_path / "out", Counted(full_disk)
    run(folder, tmp_path / "undisturbed")
    with pytest.raises(OutputError, match=r"No space left.*; 1 of 4 logs are done; --resume goes on$") as raised:
        run(folder, out, work=work)
    assert (raised.value.exit_code, work.asked) == (1, ["a", "b"])
    assert run(folder, out, resume=True).exit_code == 0
    assert without_journal(out) == without_journal(tmp_path / "undisturbed")


OPTIONS = ("--car", "saloon", "-e", "zero,kinematic", "--end", "1.5", "--keep", "estimates", "--no-report")


@pytest.fixture(scope="module")
def sound(sample_logs_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("sound") / "out"
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step")]
    assert command("run", *logs, "-o", str(out), *OPTIONS).code == 0
    return out


@pytest.fixture
def out(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "out"))


def flip(path: Path, at: float = 0.5) -> None:
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 1
    path.write_bytes(data)


def warnings(ended: Ended) -> list[str]:
    return [line for line in ended.err.splitlines() if line.startswith("warning: ")]


def of_drive(out: Path, kind: str, label: str) -> Path:
    if kind == "part":
        (part,) = (p for p in (out / "tables/parts").iterdir() if pl.read_parquet(p)["drives"][0][0]["log"] == label)
        return part
    return out / "logs" / label / kind


@pytest.mark.parametrize("kind", ["report.json", "metrics.parquet", "part"])
@pytest.mark.parametrize("deed", [flip, Path.unlink])
def test_a_drive_whose_outputs_are_damaged_or_gone_is_run_again_and_that_is_said(tmp_path, kind, deed):
    logs, out, said, work = named_logs(tmp_path / "logs", "a", "b"), tmp_path / "out", list[str](), Counted()
    run(logs, out)
    before = without_journal(out)
    deed(of_drive(out, kind, "b"))
    run(logs, out, resume=True, say=said.append, work=work)
    how = "damaged" if deed is flip else "gone"
    assert (work.asked, said) == (["b"], [f"1 of 2 drives are run again: their outputs are {how}"])
    assert without_journal(out) == before


@pytest.mark.slow
def test_every_file_of_a_drive_is_regenerated_and_a_page_alone(out, sample_logs_dir):
    logs, keep = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step")], ("--keep", "full")
    options = [o for o in OPTIONS if o not in ("--keep", "estimates", "--no-report")]
    assert command("run", *logs, "-o", str(out), *options, *keep).code == 0
    files = {p.name: p.read_bytes() for p in (out / "logs/dlc").iterdir() if p.is_file()}
    assert {"model.toml", "recording.rrd", "annotated.mcap", "report.html"} <= set(files)
    entries = map(json.loads, (out / "journal.jsonl").read_text().splitlines())
    outputs = [e["outputs"] for e in entries if e.get("label") == "dlc"][-1]
    assert {Path(o).name for o in outputs if "dlc" in o} == files.keys()
    for name in ("recording.rrd", "report.html"):  # the others are checked by their digests in the same way
        flip(out / "logs/dlc" / name)
        ended = command("run", *logs, "-o", str(out), *options, *keep, "--resume")
        assert ended.code == 0
        assert ("1 of 2 drives are run again: their outputs are damaged" in ended.err) is (name != "report.html")
        assert name.endswith(".rrd") or (out / "logs/dlc" / name).read_bytes() == files[name]


def test_a_damaged_line_of_the_journal_costs_its_drive_alone_and_is_said_once(tmp_path):
    logs, out, said, work = named_logs(tmp_path / "logs", *"abc"), tmp_path / "out", list[str](), Counted()
    run(logs, out)
    before, journal = without_journal(out), out / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    (number,) = (n for n, line in enumerate(lines) if json.loads(line).get("label") == "b")
    value = json.loads(lines[number])["error_rad"]
    lines[number] = lines[number].replace(str(value).encode(), str(value + 1.0).encode())
    journal.write_bytes(b"".join(lines))
    run(logs, out, resume=True, say=said.append, work=work)
    assert work.asked == ["b"]
    assert said == ["journal.jsonl: 1 line is damaged or of another version: the drives of these are run again"]
    assert without_journal(out) == before
    assert Journal.read(out).damaged == 0
    run(logs, out, resume=True, say=said.append, work=work)
    assert (work.asked, len(said)) == (["b"], 1)


def test_a_damaged_drive_is_named_and_the_others_are_used(out, sound):
    flip(of_drive(out, "estimates.parquet", "dlc"))
    told = f"{of_drive(out, 'estimates.parquet', 'dlc')}: expected the estimates.parquet that run.json names, got "
    report = command("report", str(out))
    assert report.code == 3
    assert warnings(report)[0].startswith(f"warning: page of dlc: the figures cannot be drawn: {told}")
    events = command("events", str(out), "--where", "speed_m_s > 1")
    assert events.code == 3
    assert [line.startswith(f"warning: {told}") for line in warnings(events)] == [True]
    assert "1 event in 1 of 1 drives" in events.out
    flip(of_drive(out, "report.json", "step"))
    compared = command("compare", str(out), str(sound), "--cluster", "day", "--max-regression", "5%", "--json")
    assert (compared.code, json.loads(compared.out)["verdict"], warnings(compared)) == (0, "equal", [])  # reads tables


def test_where_nothing_is_usable_the_exit_code_is_1(out):
    for label in ("dlc", "step"):
        flip(of_drive(out, "report.json", label))
        flip(of_drive(out, "estimates.parquet", label))
    report, events = command("report", str(out)), command("events", str(out), "--where", "speed_m_s > 1")
    assert (report.code, events.code) == (1, 1)
    assert (len(warnings(report)), len(warnings(events))) == (2, 2)
    for name, call in (("tables/metrics.parquet", ("compare", str(out), str(out))), ("run.json", ("report", str(out)))):
        flip(out / name)
        ended = command(*call)
        assert ended.code == 1
        assert ended.err.startswith(f"pdhef: {out / name}: expected ")
        assert len(ended.err.splitlines()) == 1


def test_a_run_whose_entries_were_changed_is_refused(out):
    document = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(document | {"remaining": 7}))
    with pytest.raises(OutputError, match=r"run\.json.*as it was written"):
        open_run(out)
