"""``pdhef run --ray``: three nodes here; one is lost while it works on a drive. Part of ``make fleet``."""

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from pdhef_logtool.evaluation.validation_plan import default_plan
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.opened_run import METRICS_FILE, open_run
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import Schedule, run_logs
from pdhef_logtool.runs.working import DriveTask, run_on_node
from pdhef_logtool.workers.supervisor import Limits
from tests.runs.stub_drives import stub_drive, waiting_drive
from tests.runs.test_fleet_runs import contents, named_logs
from tests.s3_store import s3_store
from tests.workers.ray_nodes import START_S, cluster_of_one, grow, processes_of


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
        run_logs(
            [str(logs)],
            tmp_path / "out",
            RunConfig(),
            schedule=Schedule(ray="127.0.0.1:1", limits=Limits()),
            work=stub_drive,
        )
