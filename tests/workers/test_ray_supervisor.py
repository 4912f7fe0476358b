"""A cluster of three nodes here, one of which is lost while its task runs. Part of ``make fleet``."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.records.errors import UsageError, WorkerError
from pdhef_logtool.workers.ray_supervisor import supervise_on_ray
from pdhef_logtool.workers.supervisor import Failure, Limits
from tests.conftest import ROOT
from tests.workers.planted_work import Item, planted
from tests.workers.ray_nodes import START_S, cluster_of_one, grow, processes_of

#: Ray is not imported here: its import takes seconds, and most runs of the tests leave these out.
pytestmark = [
    pytest.mark.fleet,
    pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install 'pdhef-logtool[ray]'"),
]
PRELOAD = ["tests.workers.planted_work"]


@pytest.fixture
def cluster() -> Iterator[Any]:
    with cluster_of_one() as made:
        yield made


def test_faults_end_on_a_node_as_they_do_here(cluster: Any) -> None:
    items = [("well", "x"), ("kill", ""), ("raise", ""), ("hang", "")]
    found = supervise_on_ray(planted, items, address=cluster.address, limits=Limits(silence_s=3.0), preload=PRELOAD)  # type: ignore[var-annotated]
    ended = sorted(found, key=lambda e: e.number)
    assert [e.item for e in ended] == items
    assert [(e.result, e.failure) for e in ended] == [
        ("x", None),
        (None, Failure("the worker was killed (signal 9)", "at kill", 2)),
        (None, Failure("raised ValueError: two lines", "at raise", 1)),
        (None, Failure("nothing heard for 3 s", "at hang", 2)),
    ]


def test_a_node_that_is_lost_while_its_task_runs_costs_no_item(cluster: Any, tmp_path: Path) -> None:
    """Every item records its process and waits. The test kills the node of one item, then releases all items."""
    nodes = grow(cluster)
    lost: list[Path] = []

    def kill_one() -> None:
        ends = time.monotonic() + 2 * START_S
        while not lost and time.monotonic() < ends:
            time.sleep(0.05)
            running = {int(p.read_text()): p for p in tmp_path.glob("*.begun") if p.read_text().endswith("\n")}
            for node in nodes:
                pids = processes_of(node)
                if here := [running[pid] for pid in pids if pid in running]:
                    # As when its machine is gone: all of it at once.
                    for pid in pids:
                        os.kill(pid, signal.SIGKILL)
                    cluster.remove_node(node, allow_graceful=False)
                    lost.extend(here)
                    break
        (tmp_path / "go").touch()

    items: list[Item] = [("wait", f"{tmp_path}/{i}") for i in range(9)]
    killer = threading.Thread(target=kill_one)
    killer.start()
    found = supervise_on_ray(planted, items, address=cluster.address, limits=Limits(), preload=PRELOAD)
    ended = list(found)  # type: ignore[var-annotated]
    killer.join()
    assert Counter(e.number for e in ended) == Counter(range(9))
    assert {e.failure for e in ended} == {None}
    assert all(e.result == e.item[1] for e in ended)
    (begun,) = lost
    assert len(begun.read_text().split()) == 2, "it was begun again on another node"
    assert sorted(p.read_text() for p in tmp_path.glob("*.done")) == sorted(value for _, value in items)
    assert not list(tmp_path.glob(".*")), "no file is left half-written"


def lose_cluster(folder: Path) -> None:
    """Kill the only node of a cluster while it works; its death sends signals to the process that started it."""
    with cluster_of_one() as cluster:

        def kill() -> None:
            while not list(folder.glob("*.begun")):
                time.sleep(0.05)
            for pid in processes_of(cluster.head_node):
                os.kill(pid, signal.SIGKILL)

        threading.Thread(target=kill, daemon=True).start()
        items: list[Item] = [("wait", f"{folder}/0")] * 3
        try:
            list(supervise_on_ray(planted, items, address=cluster.address, limits=Limits(), preload=PRELOAD))
        except WorkerError as error:
            print(error, flush=True)


def test_a_cluster_that_is_lost_is_one_error_and_no_failure_of_its_items(tmp_path: Path) -> None:
    start = "from pathlib import Path; from tests.workers.test_ray_supervisor import lose_cluster"
    script = f"{start}; lose_cluster(Path({str(tmp_path)!r}))"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "--ray: expected a Ray cluster that keeps running, got " in ended.stdout, ended.stderr


def test_where_there_is_no_cluster_that_is_told() -> None:
    with pytest.raises(UsageError, match=r"--ray: expected the address of a Ray cluster, got 127\.0\.0\.1:1 "):
        next(supervise_on_ray(planted, [], address="127.0.0.1:1", limits=Limits()))
