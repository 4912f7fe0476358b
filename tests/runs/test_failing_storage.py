"""Logs and outputs on storage that fails during a run."""

import json
import os
import shutil
from pathlib import Path

import polars as pl
import pytest

from pdhef_logtool.logs import byte_source
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.runs import working
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.journal import Journal
from pdhef_logtool.runs.working import DriveEnd, DriveTask, run_drive
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.workers.supervisor import Tell
from studies.torture.workers import Ended, command
from tests.failing_writes import failing_writes
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import Counted, contents, named_logs, run

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
    assert contents(out) == contents(tmp_path / "undisturbed")


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
    before = contents(out)
    deed(of_drive(out, kind, "b"))
    run(logs, out, resume=True, say=said.append, work=work)
    how = "damaged" if deed is flip else "gone"
    assert (work.asked, said) == (["b"], [f"1 of 2 drives are run again: their outputs are {how}"])
    assert contents(out) == before


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
    before, journal = contents(out), out / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    (number,) = (n for n, line in enumerate(lines) if json.loads(line).get("label") == "b")
    value = json.loads(lines[number])["error_rad"]
    lines[number] = lines[number].replace(str(value).encode(), str(value + 1.0).encode())
    journal.write_bytes(b"".join(lines))
    run(logs, out, resume=True, say=said.append, work=work)
    assert work.asked == ["b"]
    assert said == ["journal.jsonl: 1 line is damaged or of another version: the drives of these are run again"]
    assert contents(out) == before
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
    flip(out / "tables/metrics.parquet")
    for name, call in {
        "tables/metrics.parquet": ("compare", str(out), str(out)),
        "run.json": ("report", str(out)),
    }.items():
        if name == "run.json":
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
