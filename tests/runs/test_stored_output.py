"""A run with its output at a URL: the files equal those in a folder, one command at a time, errors in one line."""

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.results.opened_run import JOURNAL_FILE, METRICS_FILE, open_run
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.working import DriveEnd, DriveTask
from pdhef_logtool.storage import object_store
from pdhef_logtool.storage.object_store import LEFT_OVER_S
from pdhef_logtool.storage.outputs import LOCK_FILE
from pdhef_logtool.workers.supervisor import Tell
from tests.runs.stub_drives import stub_drive
from tests.runs.test_fleet_runs import Counted, contents, named_logs, run
from tests.s3_store import forget_file_systems, s3_store

#: Files with times or locations of logs.
TIMED = ("run.json", JOURNAL_FILE)
URL = "memory://fleet/out"


@pytest.fixture(autouse=True)
def memory():
    """The store of this process, empty."""
    import fsspec

    store = fsspec.filesystem("memory")
    store.store.clear()
    yield store
    assert not [path for path in store.store if path.endswith(LOCK_FILE)], "it is held for good"
    store.store.clear()


@pytest.fixture
def s3():
    with s3_store() as store:
        yield store


def stored(store: Any, url: str = URL) -> dict[str, bytes]:
    root = url.removeprefix("memory:/") + "/"
    return {path.removeprefix(root): store.cat_file(path) for path in store.find(root) if Path(path).name not in TIMED}


def test_a_store_has_what_a_folder_has_and_is_gone_on_with(tmp_path, memory):
    logs, work = named_logs(tmp_path / "logs", "a", "b"), Counted()
    result = run(logs, URL, work=work)
    run(logs, tmp_path / "out")
    assert stored(memory) == contents(tmp_path / "out", "run.json")
    assert result.to_dict()["output"] == URL
    assert result.to_dict()["logs"][0]["output"] == f"{URL}/logs/a"
    assert result.results[0].report == {"format": "pdhef.report", "log": {"name": "a"}}
    named_logs(logs, "c")
    said: list[str] = []
    run(logs, URL, work=work, resume=True, say=said.append)
    run(logs, tmp_path / "out", resume=True)
    assert work.asked == ["a", "b", "c"], "only the new log"
    assert (said, stored(memory)) == ([], contents(tmp_path / "out", "run.json"))
    opened = open_run(URL)
    assert (opened.place, [log.label for log in opened.logs]) == (URL, ["a", "b", "c"])
    assert opened.logs[2].report() == {"format": "pdhef.report", "log": {"name": "c"}}
    assert opened.logs[2].estimates() is None
    assert opened.table("metrics").collect().equals(pl.read_parquet(tmp_path / "out" / METRICS_FILE))


def test_a_name_that_is_a_pattern_means_itself(tmp_path):
    logs = named_logs(tmp_path / "logs", "d1", "d[1]")
    for start in ("1", "2"):
        run(logs, URL, config=RunConfig(keep="metrics", start=start))
    run(logs, URL, config=RunConfig(keep="metrics", start="2"), repeat=["d[1]"])
    assert [log.report() for log in open_run(URL).logs] == [
        {"format": "pdhef.report", "log": {"name": name}} for name in ("d1", "d[1]")
    ]


def test_what_was_fetched_in_part_is_fetched_again(tmp_path, memory, monkeypatch):
    run(named_logs(tmp_path / "logs", "a"), URL)
    opened = open_run(URL)

    def cut(_: Any, _name: str, to: str, **_options: Any) -> None:
        Path(to).write_text("{")
        raise TimeoutError

    with monkeypatch.context() as patch, pytest.raises(OutputError, match="no answer"):
        patch.setattr(type(memory), "get_file", cut)
        opened.logs[0].report()
    assert opened.logs[0].report() == {"format": "pdhef.report", "log": {"name": "a"}}


def test_a_store_that_fails_ends_the_run_and_what_is_put_counts(tmp_path, memory, monkeypatch):
    logs, work = named_logs(tmp_path / "logs", "a", "b", "c"), Counted()
    put = type(memory).put_file

    def failing(self: Any, path: str, name: str, **options: Any) -> None:
        if "/logs/b/" in name:
            raise ConnectionError("the store is\nbusy")
        put(self, path, name, **options)

    with monkeypatch.context() as patch, pytest.raises(OutputError) as raised:
        patch.setattr(type(memory), "put_file", failing)
        run(logs, URL, work=work)
    assert re.search(rf"{URL}/logs/b/metrics\.parquet.*--resume goes on$", str(raised.value))
    assert (raised.value.exit_code, work.asked) == (1, ["a", "b"]), "the third log is not started"
    run(logs, URL, work=work, resume=True)
    run(logs, tmp_path / "out")
    assert (work.asked[2:], stored(memory)) == (["b", "c"], contents(tmp_path / "out", "run.json"))


def test_one_command_at_a_time_holds_the_place(tmp_path, memory, monkeypatch):
    logs, lock = named_logs(tmp_path / "logs", "a"), f"/fleet/out/{LOCK_FILE}"

    def within(task: DriveTask, tell: Tell) -> DriveEnd:
        with pytest.raises(OutputError, match=r"one that process \d+ of this or another machine is writing to"):
            run(logs, URL)
        return stub_drive(task, tell)

    run(logs, URL, work=within)
    memory.pipe_file(lock, b"00000000-17-1")  # of another machine
    with pytest.raises(OutputError, match=f"or remove {LOCK_FILE} there if that process has ended"):
        run(logs, URL)
    monkeypatch.setattr(object_store, "LEFT_OVER_S", -1.0)
    run(logs, URL)
    monkeypatch.undo()
    memory.pipe_file(lock, process_name().rpartition("-")[0].encode() + b"-1")  # a process that has ended
    run(logs, URL)
    assert timedelta(seconds=LEFT_OVER_S) > timedelta(minutes=15)
    assert datetime.now(UTC) - memory.modified(f"/fleet/out/{JOURNAL_FILE}") < timedelta(seconds=60)


def test_what_has_lost_its_hold_ends(tmp_path, memory, monkeypatch):
    monkeypatch.setattr("pdhef_logtool.runs.stored_output.EVERY_S", 0.0)
    logs, lock = named_logs(tmp_path / "logs", "a", "b"), f"/fleet/out/{LOCK_FILE}"

    def taken(task: DriveTask, tell: Tell) -> DriveEnd:
        memory.pipe_file(lock, b"00000000-17-1")
        return stub_drive(task, tell)

    with pytest.raises(OutputError):
        run(logs, URL, work=taken)
    assert memory.cat_file(lock) == b"00000000-17-1", "it is theirs"
    memory.rm(lock)


@pytest.mark.slow
def test_what_cannot_be_an_output_is_told_in_one_line(tmp_path, s3):
    logs = named_logs(tmp_path / "logs", "a")
    for url, error, match in (
        ("https://user:secret@host/out", UsageError, "https://host/out: expected a folder, or a URL"),
        ("nothing://x/out", UsageError, "nothing://x/out"),
        (f"file://{tmp_path}/out", UsageError, "or a URL of an object store"),
        ("s3://bikes/out", OutputError, "s3://bikes/out: expected .*the bucket must exist"),
    ):
        with pytest.raises(error, match=match) as raised:
            run(logs, url)
        assert "secret" not in str(raised.value)
    with pytest.raises(OutputError, match=rf"{s3.url}/none: .* without run\.json"):
        open_run(f"{s3.url}/none")
    s3.put("out/logs/a/annotated.mcap", b"x")
    with pytest.raises(UsageError, match="which lies in it"):
        run([f"{s3.url}/out/logs/a/annotated.mcap"], f"{s3.url}/out")
    s3.put(f"held/{LOCK_FILE}", b"00000000-17-1")
    with pytest.raises(OutputError):
        run(logs, f"{s3.url}/held")


@pytest.mark.parametrize("command", [("learn", "x", "--car", "saloon"), ("metrics", "x"), ("extract", "x")])
def test_what_writes_to_folders_alone_takes_no_url(command, tmp_path, monkeypatch):
    from pdhef_logtool.cli.app import app

    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="expected a place on this machine, got s3://cars/out"):
        app([*command, "-o", "s3://cars/out"], standalone_mode=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_without_credentials_there_is_one_line(tmp_path, s3, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    forget_file_systems()
    with pytest.raises(OutputError, match="no credentials; give credentials that permit this"):
        run(named_logs(tmp_path / "logs", "a"), f"{s3.url}/out")
    forget_file_systems()
