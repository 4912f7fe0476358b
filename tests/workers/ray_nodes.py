"""A Ray cluster on this machine with nodes that tests can kill."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
_NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}
#: Time limit for the start of a node, with margin for a busy machine.
START_S = 120.0


@contextmanager
def cluster_of_one() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)  # nodes import the work of tests
        terminated = signal.getsignal(signal.SIGTERM)
        made = Cluster(initialize_head=True, head_node_args={**_NODE, "include_dashboard": False})
        try:
            yield made
        finally:
            made.shutdown()
            signal.signal(signal.SIGTERM, terminated)


def grow(cluster: Any) -> list[Any]:
    """Return two more nodes."""
    nodes = [cluster.add_node(wait=False, **_NODE) for _ in range(2)]
    cluster.wait_for_nodes(timeout=START_S)
    return nodes


def processes_of(node: Any) -> list[int]:
    """Return all that runs on a node and its raylet."""
    return [p for info in node.all_processes["raylet"] for p in _below(info.process.pid)]


def _below(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        children = []
    return [pid, *(p for child in children for p in _below(int(child)))]
