"""Supervised workers, here or on nodes of Ray (``make fleet``): one that dies, hangs or grows loses only its item."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.records.errors import UsageError, WorkerError
from pdhef_logtool.workers.ray_supervisor import supervise_on_ray
from pdhef_logtool.workers.supervisor import Ended, Failure, Limits, supervise
from tests.conftest import ROOT
from tests.workers.planted_work import DEATHS, Item, called, planted
from tests.workers.ray_nodes import cluster_of_one, processes_of

LIMITS = Limits(silence_s=3.0, memory_bytes=400_000_000)
PRELOAD = ["tests.workers.planted_work:note_call"]
NO_RAY = "Ray is not installed: pip install 'pdhef-logtool[ray]'"
REASONS = {
    "kill": "the worker was killed (signal 9)",
    "exit": "the worker ended with exit code 5",
    "hang": "nothing heard for 3 s",
    "stop": "nothing heard for 3 s",
    "cut": "it stopped in the middle of a message",
    "grow": "took more than 400 MB",
    "8 GB": "took more than 400 MB",
    "raise": "raised ValueError: two lines",
    "quit": "raised SystemExit: 3",
    "odd": "raised TypeError: not me",
}
#: Faults that are not retried.
FINAL = {"raise", "quit", "odd"}


def outcomes(items: list[Item], jobs: int, limits: Limits = LIMITS) -> list[Ended[Item, object]]:
    """Return how the items ended, in their order."""
    ended = sorted(supervise(planted, items, jobs=jobs, limits=limits, preload=PRELOAD), key=lambda e: e.number)
    assert [e.number for e in ended] == list(range(len(items)))
    assert [e.item for e in ended] == items
    return ended


def assert_as_planted(ended: list[Ended[Item, object]]) -> None:
    for e in ended:
        what, value = e.item
        if what in REASONS:
            assert e.failure == Failure(REASONS[what], f"at {what}", 1 if what in FINAL else 2)
            assert e.result is None
        else:
            assert e.failure is None
            assert e.result == value


@pytest.mark.slow
def test_each_fault_costs_its_own_item_only(tmp_path):
    items = [(what, "") for what in REASONS] + [("kill once", str(tmp_path / "once")), ("slowly", "x")]
    items = [x for i, fault in enumerate(items) for x in (fault, ("well", str(i)))]
    assert_as_planted(outcomes(items, 2))


@settings(max_examples=6, deadline=None)
@given(
    items=st.lists(st.tuples(st.sampled_from(["well", "well", "kill", "exit", "raise", "odd"]), st.text(max_size=5))),
    jobs=st.integers(1, 4),
)
def test_every_item_ends_once_whatever_happens_in_any_order(items, jobs):
    assert_as_planted(outcomes(items, jobs, Limits(silence_s=600.0)))


def test_a_lost_item_is_tried_again_when_nothing_else_runs(tmp_path):
    items = [("alone", str(tmp_path / "mark")), *[("well", "")] * 4]
    ended = list(supervise(planted, items, jobs=3, preload=PRELOAD))
    assert [e.number for e in ended[-1:]] == [0]
    assert ended[-1].result == 1


def test_workers_have_one_thread_and_live_as_long_as_the_run():
    ended = outcomes([("where", "")] * 20, 2, Limits())
    pids, calls, threads, omp = zip(*(e.result for e in ended), strict=True)
    assert len(set(pids)) <= 2
    assert os.getpid() not in pids
    assert set(threads) == {1}
    assert set(omp) == {"1"}
    assert {len(c) for c in calls} == {1}, "the fork server called it, once for all"
    assert not called


def test_the_processor_time_of_workers_counts_as_that_of_the_command():
    before = os.times()
    outcomes([("burn", "0.3")] * 2, 2, Limits())
    after = os.times()
    assert after.children_user + after.children_system - before.children_user - before.children_system > 0.6


def test_one_job_without_limits_runs_here():
    told: list[tuple[int, str, float]] = []
    items = [("where", ""), ("raise", ""), ("well", "x")]
    ended = list(supervise(planted, items, jobs=1, progress=lambda *what: told.append(what)))
    assert ended[0].result[0] == os.getpid()
    assert ended[1].failure == Failure(REASONS["raise"], "at raise", 1)
    assert ended[2].result == "x"
    assert told == [(0, "at where", 0.5), (1, "at raise", 0.5), (2, "at well", 0.5)]


def test_a_fork_server_that_dies_with_a_worker_costs_no_item(tmp_path):
    warned: list[str] = []
    items = [("kill server once", str(tmp_path / "once")), *[("well", "x")] * 3]
    ended = list(supervise(planted, items, jobs=2, preload=PRELOAD, warn=warned.append))
    assert {(e.item[1], e.result, e.failure) for e in ended} == {(value, value, None) for _, value in items}
    assert warned == ["the fork server died (signal 9): restart 1 of 3, no item is lost"]


def test_a_fork_server_that_dies_again_and_again_is_one_error(tmp_path, monkeypatch):
    deaths = tmp_path / "deaths"
    deaths.touch()
    monkeypatch.setenv(DEATHS, str(deaths))
    with pytest.raises(WorkerError, match="4 that died, the last one by signal 9"):
        list(supervise(planted, [("well", "")] * 4, jobs=2, preload=["tests.workers.planted_work:die_at_start"]))
    assert deaths.read_text() == "xxxx"


def test_no_jobs_are_refused_before_anything_is_pulled():
    with pytest.raises(UsageError, match="at least one process"):
        list(supervise(planted, [], jobs=0))


def test_items_are_pulled_as_workers_become_free():
    pulled = 0

    def items() -> Iterator[Item]:
        nonlocal pulled
        while True:
            pulled += 1
            yield "well", ""

    with closing(supervise(planted, items(), jobs=2, preload=PRELOAD)) as ended:
        for count, _ in zip(range(10), ended, strict=False):
            assert pulled <= count + 1 + 2


SCRIPT = """
import sys
from pathlib import Path
from pdhef_logtool.workers.supervisor import Limits, supervise
from tests.workers.planted_work import planted

def heard(number, text, share):
    print("heard", flush=True)

for ended in supervise(planted, [("hang", "")] * 2, jobs=2, limits=Limits(silence_s=600.0), progress=heard):
    pass
"""


AT_MODULE_LEVEL = """
from multiprocessing import get_context
from pdhef_logtool.workers.supervisor import supervise
from tests.workers.planted_work import planted

def result(item):
    (ended,) = supervise(planted, [item], jobs=2)
    return ended.result

print(result(("well", "here")))
with get_context("fork").Pool(1) as pool:
    print(*pool.map(result, [("well", "in a pool")]))
"""


def test_workers_start_at_module_level_and_in_daemonic_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(AT_MODULE_LEVEL)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    ended = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("here\nin a pool\n", "")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_all_ends_with_the_parent_without_a_word(number):
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(SCRIPT)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout.readline() == "heard\n"
        assert process.stdout.readline() == "heard\n"
        if number == signal.SIGKILL:
            process.kill()
        else:
            os.killpg(process.pid, number)
        # Its pipes close when the last process that holds them is gone.
        _, err = process.communicate(timeout=300)
    told = [line for line in err.splitlines() if line and not line.startswith((" ", "Traceback"))]
    assert told == ([] if number == signal.SIGKILL else ["KeyboardInterrupt"]), "the workers and the server say nothing"


@pytest.mark.fleet
def test_faults_end_on_a_node_as_they_do_here():
    pytest.importorskip("ray", reason=NO_RAY)
    items = [("well", "x"), ("kill", ""), ("raise", ""), ("hang", "")]
    with cluster_of_one() as cluster:
        options = {"limits": Limits(silence_s=3.0), "preload": PRELOAD}
        found = list(supervise_on_ray(planted, items, address=cluster.address, **options))
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


@pytest.mark.fleet
def test_a_cluster_that_is_lost_is_one_error_and_no_failure_of_its_items(tmp_path):
    pytest.importorskip("ray", reason=NO_RAY)
    start = "from pathlib import Path; from tests.workers.test_supervisor import lose_cluster"
    script = f"{start}; lose_cluster(Path({str(tmp_path)!r}))"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "--ray: expected a Ray cluster that keeps running, got " in ended.stdout, ended.stderr
