"""A cluster of three nodes here, one of which is lost while its task runs. Part of ``make fleet``."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.ray_supervisor import supervise_on_ray
from pdhef_logtool.records.supervisor import Failure, Limits
from tests.records.planted_work import Item, planted

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'pdhef-logtool[ray]'")
pytestmark = pytest.mark.fleet
PRELOAD = ["tests.records.planted_work"]
NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}
#: What a node may take to start, on a machine that does other things too.
START_S = 120.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        made = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
        try:
            yield made
        finally:
            made.shutdown()


def grown(cluster: Any) -> list[Any]:
    """Return two more nodes."""
    nodes = [cluster.add_node(wait=False, **NODE) for _ in range(2)]
    cluster.wait_for_nodes(timeout=START_S)
    return nodes


def test_faults_end_on_a_node_as_they_do_here(cluster: Any) -> None:
    items = [("well", "x"), ("kill", ""), ("raise", ""), ("hang", "")]
    found = supervise_on_ray(planted, items, address=cluster.address, limits=Limits(silence_s=1.0), preload=PRELOAD)  # type: ignore[var-annotated]
    ended = sorted(found, key=lambda e: e.number)
    assert [e.item for e in ended] == items
    assert [(e.result, e.failure) for e in ended] == [
        ("x", None),
        (None, Failure("the worker was killed (signal 9)", "at kill", 2)),
        (None, Failure("raised ValueError: two lines", "at raise", 1)),
        (None, Failure("nothing heard for 1 s", "at hang", 2)),
    ]


def below(pid: int) -> list[int]:
    """Return a process and all that come from it."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    return [pid, *(p for c in (children.read_text().split() if children.exists() else ()) for p in below(int(c)))]


def processes_of(node: Any) -> list[int]:
    return [p for info in node.all_processes["raylet"] for p in below(info.process.pid)]


def test_a_node_that_is_lost_while_its_task_runs_costs_no_item(cluster: Any, tmp_path: Path) -> None:
    """Every item notes where it begins, and waits; the node of one is killed, then the word is given to go on."""
    nodes = grown(cluster)
    lost: list[Path] = []

    def kill_one() -> None:
        ends = time.monotonic() + START_S
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
    assert len(begun.read_text().split()) == 2, "it was begun anew on another node"
    assert sorted(p.read_text() for p in tmp_path.glob("*.done")) == sorted(value for _, value in items)
    assert not list(tmp_path.glob(".*")), "no file is left half-written"


def test_where_there_is_no_cluster_that_is_told() -> None:
    with pytest.raises(UsageError, match=r"--ray: expected the address of a Ray cluster, got 127\.0\.0\.1:1 "):
        next(supervise_on_ray(planted, [], address="127.0.0.1:1", limits=Limits()))
