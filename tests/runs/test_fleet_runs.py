"""A run of several logs: its journal, resumed, repeated and aborted drives; nodes of Ray (``make fleet``)."""

import json
import os
import re
import shutil
import signal
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pdhef_logtool import Reporter, RunConfig
from pdhef_logtool.evaluation.validation_plan import default_plan
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.results.fleet import summarise
from pdhef_logtool.results.opened_run import JOURNAL_FILE, METRICS_FILE, open_run
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.runs import fleet
from pdhef_logtool.runs.fleet import Schedule, run_logs
from pdhef_logtool.runs.working import DriveEnd, DriveTask, run_on_node
from pdhef_logtool.storage import object_store
from pdhef_logtool.storage.object_store import LEFT_OVER_S
from pdhef_logtool.storage.outputs import LOCK_FILE
from pdhef_logtool.workers.supervisor import Limits, Tell
from tests.run_report import follows
from tests.runs.stub_drives import planted_stub, stub_drive, waiting_drive
from tests.s3_store import forget_file_systems, s3_store
from tests.workers.ray_nodes import START_S, cluster_of_one, grow, processes_of


def named_logs(folder: Path, *names: str) -> Path:
    """Write logs that contain only their names; the stub does not read them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}.mcap").write_text(f"this is {folder.name}/{name}")
    return folder


def labels(output: Path) -> list[str]:
    return [log.label for log in open_run(output).logs]


class Counted:
    """A stub that records the requested drives."""

    def __init__(self, ends: Callable[[DriveTask, Tell], DriveEnd] = stub_drive) -> None:
        self.asked: list[str] = []
        self._ends = ends

    def __call__(self, task: DriveTask, tell: Tell) -> DriveEnd:
        self.asked.append(task.log.stem)
        return self._ends(task, tell)


def run(folder: Path | list[str], output: Path, config: RunConfig | None = None, **options: Any) -> Any:
    arguments = folder if isinstance(folder, list) else [str(folder)]
    names = ("jobs", "ray", "resume", "repeat")
    schedule = Schedule(**{n: options.pop(n) for n in names if n in options}, limits=options.pop("limits", Limits()))
    silent = Reporter()
    warn, note = options.pop("warn", silent.warn), options.pop("say", silent.note)
    config = replace(config or RunConfig(), full_worst=options.pop("full_worst", None))
    options = {"work": stub_drive, "report": False, "schedule": schedule, **options}
    return run_logs(arguments, output, config, reporter=Reporter(warn=warn, note=note), **options)


def test_what_is_done_is_not_done_again_and_a_folder_added_later_runs_alone(tmp_path):
    day = named_logs(tmp_path / "logs/day", "a", "b")
    out, work = tmp_path / "out", Counted()
    run(day, out, work=work)
    assert (work.asked, labels(out)) == (["a", "b"], ["a", "b"])
    named_logs(tmp_path / "logs/night", "a", "c")
    run(tmp_path / "logs", out, work=work, resume=True)
    # The labels that were given stay, although the new folder has an `a` too.
    assert labels(out)[:2] == ["a", "b"]
    assert work.asked == ["a", "b", *labels(out)[2:]]
    metrics = pl.read_parquet(out / "metrics.parquet")
    assert list(dict.fromkeys(metrics["log"])) == labels(out)
    parts = pl.scan_parquet(out / "tables/parts/*.parquet").select(pl.col("metrics").explode().struct.unnest())
    assert parts.collect().sort("log").equals(metrics.sort("log"))


def test_a_log_is_known_by_what_it_holds(tmp_path):
    logs, out, work = named_logs(tmp_path / "logs", "a", "b"), tmp_path / "out", Counted()
    run(logs, out, work=work)
    (logs / "later").mkdir()
    (logs / "a.mcap").rename(logs / "later/moved.mcap")
    os.utime(logs / "b.mcap", ns=(1, 1))
    run(logs, out, work=work, resume=True)
    assert (labels(out), work.asked) == (["b", "a"], ["a", "b"])
    said: list[str] = []
    (logs / "b.mcap").write_text("recorded again")
    run(logs, out, work=work, resume=True, say=said.append)
    assert (labels(out), work.asked) == (["b", "a"], ["a", "b", "b"])
    assert said == ["1 of 2 drives are run again: their logs have changed"]


def test_the_same_drive_under_two_names_is_run_once_and_that_is_said(tmp_path):
    logs, out, work = named_logs(tmp_path / "logs", "a"), tmp_path / "out", Counted()
    shutil.copy(logs / "a.mcap", logs / "b.mcap")
    warned: list[str] = []
    for options in ({}, {"resume": True}):
        run(logs, out, work=work, warn=warned.append, **options)
    assert (labels(out), work.asked) == (["a"], ["a"])
    assert warned == ["b.mcap has the same content as a.mcap: the drive is run once"] * 2


def test_resuming_reads_no_log_again(tmp_path, monkeypatch):
    logs, out = named_logs(tmp_path / "logs", "a", "b"), tmp_path / "out"
    run(logs, out)

    def read(_: object) -> str:
        raise AssertionError("a log was read to be known again")

    monkeypatch.setattr("pdhef_logtool.runs.working.identity_of", read)
    work = Counted()
    run(logs, out, resume=True, work=work)
    assert work.asked == []


def test_what_is_run_anew_is_said_and_why(tmp_path, sample_logs_dir):
    car = tmp_path / "car.toml"
    text = (sample_logs_dir / "vehicle.toml").read_text()
    car.write_text(text)
    logs, out, work, said = named_logs(tmp_path / "logs", "a", "b"), tmp_path / "out", Counted(), list[str]()
    run(logs, out, RunConfig(car=car), work=work)
    car.write_text(text.replace("1440.0", "1450.0"))
    run(logs, out, RunConfig(car=car), work=work, resume=True, say=said.append)
    run(logs, out, RunConfig(car=car, friction=0.4), work=work, resume=True, say=said.append)
    run(logs, out, RunConfig(car=car, friction=0.4), work=work, resume=True, say=said.append)
    assert said == [
        "2 of 2 drives are run again: the car's physics changed",
        "2 of 2 drives are run again: --friction auto → 0.4",
    ]
    assert work.asked == ["a", "b"] * 3
    assert len(list((out / "tables/parts").iterdir())) == 2


def test_more_is_kept_when_it_is_asked_for_and_never_less(tmp_path):
    logs, out, work = named_logs(tmp_path / "logs", "a", "b"), tmp_path / "out", Counted()
    run(logs, out, RunConfig(keep="metrics"), work=work)
    run(logs, out, RunConfig(keep="metrics"), work=work, repeat=["b"])
    assert work.asked == ["a", "b", "b"]
    assert labels(out) == ["a", "b"]
    run(logs, out, RunConfig(keep="estimates"), work=work, resume=True)
    assert work.asked == ["a", "b", "b", "a"]
    with pytest.raises(UsageError, match="--repeat: expected the name of a log"):
        run(logs, out, RunConfig(keep="metrics"), repeat=["c"])
    with pytest.raises(UsageError, match="friction"):
        run(logs, out, RunConfig(keep="metrics", friction=0.4), repeat=["a"])


def test_many_logs_keep_metrics_and_the_worst_in_full_and_say_so_first(tmp_path, monkeypatch):
    for module in ("fleet", "run_result"):
        monkeypatch.setattr(f"pdhef_logtool.runs.{module}.FEW_LOGS", 7)
    logs = named_logs(tmp_path / "logs", *(f"drive{i:02d}" for i in range(8)))
    work, said = Counted(), list[str]()
    result = run(logs, tmp_path / "out", work=work, say=said.append, full_worst=2)
    assert result.is_fleet
    assert said[0].startswith("8 logs: figures and a short report of each are kept, no tracks")
    errors = pl.read_parquet(tmp_path / "out/metrics.parquet").filter(pl.col("metric") == "rmse")
    worst = errors.sort("value", "log", descending=[True, False])["log"][:2].to_list()
    assert work.asked[8:] == sorted(worst)
    entries = [json.loads(line) for line in (tmp_path / "out" / JOURNAL_FILE).read_text().splitlines()]
    assert [e["keep"] for e in entries if e.get("label") in worst] == ["metrics"] * 2 + ["full"] * 2
    again = Counted()
    run(logs, tmp_path / "out", work=again, full_worst=2, resume=True)
    assert again.asked == []


def test_a_run_that_is_ended_tells_of_what_is_done_and_goes_on(tmp_path):
    logs = named_logs(tmp_path / "logs", "a", "b", "c", "d")
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    run(logs, undisturbed)
    for stops_at in ("b", "d"):

        def stopped(task: DriveTask, tell: Tell, at: str = stops_at) -> DriveEnd:
            if task.log.stem == at:
                raise KeyboardInterrupt
            return stub_drive(task, tell)

        with pytest.raises(KeyboardInterrupt):
            run(logs, out, work=stopped, resume=True)
        document = json.loads((out / "run.json").read_text())
        assert [e["log"] for e in document["logs"]] == ["a", "b", "c"][: 1 if stops_at == "b" else 3]
        assert document["remaining"] == (3 if stops_at == "b" else 1)
        with (out / JOURNAL_FILE).open("ab") as file:
            file.write(b'{"label":"cut off by a k')
    run(logs, out, resume=True)
    assert contents(out) == contents(undisturbed)


def contents(output: Path, *without: str) -> dict[str, bytes]:
    """Return all files but the journal, in which drives stand as they ended."""
    files = (p for p in output.rglob("*") if p.is_file() and p.name not in (JOURNAL_FILE, *without))
    return {p.relative_to(output).as_posix(): p.read_bytes() for p in files}


def test_a_failure_that_may_pass_is_tried_again_and_others_when_asked(tmp_path):
    logs, out = named_logs(tmp_path / "logs", "a", "full", "bad"), tmp_path / "out"

    def failing(task: DriveTask, tell: Tell) -> DriveEnd:
        if task.log.stem in ("bad", "full"):
            outcome = LogOutcome(task.log.stem, task.log.path.name, None, failed="for a test")
            return DriveEnd(outcome, None, again=task.log.stem == "full")
        return stub_drive(task, tell)

    result = run(logs, out, work=failing)
    assert result.exit_code == 3
    for options, asked in (({"resume": True}, ["full"]), ({"repeat": ["failed"]}, ["bad", "full"])):
        work = Counted(failing)
        assert run(logs, out, work=work, **options).exit_code == 3
        assert work.asked == asked
    assert run(logs, out, repeat=["failed"]).exit_code == 0


@pytest.mark.slow
def test_a_log_that_hangs_or_ends_its_worker_is_given_up_and_not_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(fleet, "_PRELOAD", ("tests.runs.stub_drives",))  # all that a stub needs
    logs, out = named_logs(tmp_path / "logs", "a", "hangs", "b", "kills"), tmp_path / "out"
    result = run(logs, out, work=planted_stub, jobs=2, limits=Limits(2.0))
    assert result.exit_code == 3
    outcomes = {r.outcome.log: r.outcome.outcome for r in result.results}
    assert outcomes["a"] == outcomes["b"] == "ok"
    assert outcomes["hangs"] == "failed: nothing heard for 2 s, 2 tries; last heard: before it hangs"
    assert outcomes["kills"].startswith("failed: the worker was killed (signal 9), 2 tries")
    work = Counted()
    assert run(logs, out, work=work, resume=True).exit_code == 3
    assert work.asked == []
    assert run(logs, out, work=work, repeat=["failed"]).exit_code == 0
    assert work.asked == ["hangs", "kills"]


@pytest.mark.fleet
def test_memory_is_flat_to_3000_logs(tmp_path):
    memory: list[int] = []

    def noted(*_: object) -> None:
        memory.append(int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE"))

    logs = named_logs(tmp_path / "logs", *(f"log_{i:05d}" for i in range(3000)))
    run_logs([str(logs)], tmp_path / "out", RunConfig(), report=False, work=stub_drive, reporter=Reporter(noted))
    assert len(labels(tmp_path / "out")) == 3000
    assert memory[-1] - memory[len(memory) // 10] < 30e6


@pytest.mark.slow
def test_metrics_alone_leave_a_short_report_by_the_schema(sample_logs_dir, tmp_path):
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step")]
    config = RunConfig(car=Path("saloon"), keep="metrics", end="4")
    result = run_logs(logs, tmp_path, replace(config, full_worst=1))
    files = {folder.name: {p.name for p in folder.iterdir()} for folder in (tmp_path / "logs").iterdir()}
    (other,) = (name for name, kept in files.items() if kept == {"report.json", "model.toml"})
    (worst,) = files.keys() - {other}
    report = tmp_path / "logs" / other / "report.json"
    assert report.stat().st_size < 40_000
    follows(json.loads(report.read_text()))
    follows(json.loads((tmp_path / "run.json").read_text()), "run.schema.json")
    assert (tmp_path / "logs" / worst / "recording.rrd").is_file()
    assert (tmp_path / "logs" / worst / "report.html").is_file()
    assert (tmp_path / "report.html").is_file()
    assert set(pl.read_parquet(tmp_path / "metrics.parquet")["metric"]) >= {"rmse", "nees", "lag_s"}
    assert [(r.document, r.rows) for r in result.results] == [(None, ())] * 2  # no drive stays in memory


def test_a_fleets_summary_counts_what_the_figures_say(tmp_path):
    logs, out = named_logs(tmp_path / "logs", "a", "b", "c"), tmp_path / "out"

    def failing(task: DriveTask, tell: Tell) -> DriveEnd:
        if task.log.stem == "b":
            return DriveEnd(LogOutcome("b", "b.mcap", None, failed="for a test"), None)
        return stub_drive(task, tell)

    result = run(logs, out, work=failing)
    told = summarise(open_run(out), result.exit_code)
    values = {log: zlib.crc32(log.encode()) / 2**32 for log in "ac"}
    assert (told["logs"], told["done"], told["scored"], told["exit_code"]) == (3, 2, 2, 3)
    assert told["errors"][0]["median_rad"] == pytest.approx(sum(values.values()) / 2)
    assert [w["log"] for w in told["worst"]] == sorted(values, key=lambda log: -values[log])
    assert told["failed"][0]["labels"] == ("b",)
    assert [e["estimator"] for e in told["errors"]] == ["physics"]  # the only one that was asked for is named


@pytest.mark.fleet
def test_a_fleet_on_three_nodes_one_of_which_goes_equals_one_here(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'pdhef-logtool[ray]'")
    named_logs(tmp_path / "logs", *(f"drive_{i}" for i in range(12)))
    monkeypatch.chdir(tmp_path)
    go, lost = tmp_path / "go", []
    with cluster_of_one() as cluster:
        nodes = grow(cluster)

        def kill_one() -> None:
            ends = time.monotonic() + 2 * START_S
            while not lost and time.monotonic() < ends:
                time.sleep(0.05)
                for node in nodes:
                    pids = processes_of(node)
                    if here := [p for p in pids if (tmp_path / f"{p}.begun").exists()]:
                        for pid in pids:
                            os.kill(pid, signal.SIGKILL)
                        cluster.remove_node(node, allow_graceful=False)
                        lost.extend(here)
                        break
            go.touch()

        killer = threading.Thread(target=kill_one)
        killer.start()
        work = partial(waiting_drive, tmp_path)
        # Folders are named as from here: nodes work in the same one.
        run = partial(run_logs, ["logs"], config=RunConfig(keep="metrics"), report=False)
        result = run(output=Path("out"), schedule=Schedule(ray=cluster.address), work=work)
        killer.join()
    assert lost, "a node went while its drive was worked on"
    assert result.exit_code == 0
    assert [log.label for log in open_run(Path("out")).logs] == sorted(f"drive_{i}" for i in range(12))
    run(output=Path("here"), work=stub_drive)
    assert contents(Path("out"), "run.json") == contents(Path("here"), "run.json")
    assert METRICS_FILE in contents(Path("out"), "run.json")
    again = Schedule(ray="127.0.0.1:1", resume=True)
    assert run(output=Path("out"), schedule=again, work=work).exit_code == 0, (
        "nothing is left to do: no cluster is asked for"
    )


@pytest.mark.fleet
def test_a_fleet_on_a_cluster_whose_output_is_in_a_store_equals_one_here(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'pdhef-logtool[ray]'")
    logs = named_logs(tmp_path / "logs", *(f"drive_{i}" for i in range(6)))
    run = partial(run_logs, [str(logs)], config=RunConfig(keep="metrics"), report=False, work=stub_drive)
    with s3_store() as store, cluster_of_one() as cluster:
        assert run(output=f"{store.url}/out", schedule=Schedule(ray=cluster.address)).exit_code == 0
        named_logs(logs, "later")
        assert run(output=f"{store.url}/out", schedule=Schedule(ray=cluster.address, resume=True)).exit_code == 0
        found = store.objects("out")
    run(output=tmp_path / "out")
    timed = ("run.json", "journal.jsonl")
    assert {name: data for name, data in found.items() if name not in timed} == contents(tmp_path / "out", "run.json")


def test_an_output_that_a_node_does_not_see_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (log,) = find_logs([str(named_logs(tmp_path / "logs", "a"))])
    task = DriveTask(log, Path("out"), RunConfig(), default_plan(), page=False, run="")
    told = run_on_node(stub_drive, tmp_path, True, task, lambda *_: None)
    assert isinstance(told, OutputError)
    assert "a folder that all nodes of the cluster see" in str(told)


def test_without_ray_or_a_cluster_there_is_one_line(tmp_path):
    logs = named_logs(tmp_path / "logs", "a", "b")
    with pytest.raises(UsageError, match="--ray: expected"):
        run(logs, tmp_path / "out", ray="127.0.0.1:1")


# ---- A run with its output at a URL: the files equal those in a folder, one command at a time, errors in one line ----

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
