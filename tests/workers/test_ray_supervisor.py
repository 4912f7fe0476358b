"""A cluster of three nodes here, one of which is lost while its task runs. Part of ``make fleet``."""

import os
import signal
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import WorkerError
from pdhef_logtool.workers.ray_supervisor import supervise_on_ray
from pdhef_logtool.workers.supervisor import Failure, Limits
from tests.conftest import ROOT
from tests.workers.planted_work import Item, planted
from tests.workers.ray_nodes import cluster_of_one, processes_of

#: Ray is not imported here: its import takes seconds, and most runs of the tests leave these out.
pytestmark = [
    pytest.mark.fleet,
    pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install 'pdhef-logtool[ray]'"),
]
PRELOAD = ["tests.workers.planted_work"]


@pytest.fixture
def cluster():
    with cluster_of_one() as made:
        yield made


def test_faults_end_on_a_node_as_they_do_here(cluster):
    items = [("well", "x"), ("kill", ""), ("raise", ""), ("hang", "")]
    found = supervise_on_ray(planted, items, address=cluster.address, limits=Limits(silence_s=3.0), preload=PRELOAD)
    ended = sorted(found, key=lambda e: e.number)
    assert [e.item for e in ended] == items
    assert [(e.result, e.failure) for e in ended] == [
        ("x", None),
        (None, Failure("the worker was killed (signal 9)", "at kill", 2)),
        (None, Failure("raised ValueError: two lines", "at raise", 1)),
        (None, Failure("nothing heard for 3 s", "at hang", 2)),
    ]


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


def test_a_cluster_that_is_lost_is_one_error_and_no_failure_of_its_items(tmp_path):
    start = "from pathlib import Path; from tests.workers.test_ray_supervisor import lose_cluster"
    script = f"{start}; lose_cluster(Path({str(tmp_path)!r}))"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "--ray: expected a Ray cluster that keeps running, got " in ended.stdout, ended.stderr
