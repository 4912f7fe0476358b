"""The supervisor of ``supervisor.py`` on the machines of a Ray cluster.

A task is a supervised worker on a node that Ray chooses: a worker that dies, hangs or exceeds its memory is an ordinary
outcome, so that Ray repeats a task only if its node is lost.
"""

import atexit
import itertools
import logging
import signal
import socket
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TypeAlias, TypeVar

from pdhef_logtool.records.errors import UsageError, WorkerError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.workers.supervisor import Crew, Ended, Failure, Limits, Tell, describe_error

T = TypeVar("T")
R = TypeVar("R")

#: Nodes that an item may lose, for example preemptible machines.
MAX_RETRIES = 1000
#: Items submitted to Ray per processor, so that no processor waits for the next one.
_AHEAD = 2
_LOOK_S = 5.0
_CONNECT_S = 20.0


#: The work of a node: a name of the run, the work, its limits, and modules to load before.
_Orders: TypeAlias = tuple[str, Callable[[Any, Tell], Any], Limits, tuple[str, ...]]


def supervise_on_ray(
    work: Callable[[T, Tell], R], items: Iterable[T], *, address: str, limits: Limits, preload: Sequence[str] = ()
) -> Generator[Ended[T, R], None, None]:
    """Do the work on every item, one for each processor of a cluster at a time, and yield how each ended.

    Arguments and results as for :func:`~.supervisor.supervise`; the nodes have this package and the work's module
    installed. A lost item is tried once more alone on its processor, beside the items of other processors.

    Parameters
    ----------
    address : of the cluster as ``ray.init`` takes it: ``auto``, ``HOST:PORT`` or ``ray://HOST:PORT``.

    Raises
    ------
    UsageError : Ray is not installed, or there is no cluster.
    WorkerError : the cluster is lost, or its nodes cannot run workers.
    """
    orders = f"{process_name()}-{next(_RUNS)}", work, limits, tuple(preload)
    with _connected(address) as ray:
        try:
            yield from _submitted(ray, orders, items)
        except (ray.exceptions.RayError, ConnectionError) as error:
            raise WorkerError(
                expected="a Ray cluster that keeps running",
                got=describe_error(error).partition(". ")[0],
                where="--ray",
                remedy="check the cluster with ray status",
            ) from None


_RUNS = itertools.count()


def _submitted(ray: Any, orders: _Orders, items: Iterable[T]) -> Iterator[Ended[T, Any]]:
    task = ray.remote(num_cpus=1, max_retries=MAX_RETRIES, retry_exceptions=False)(_end_on_node)
    waiting = enumerate(items)
    under_way: dict[Any, tuple[int, T]] = {}
    while True:
        room = _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
        for number, item in itertools.islice(waiting, max(0, room - len(under_way))):
            under_way[task.remote(orders, item)] = number, item
        if not under_way:
            return
        done, _ = ray.wait(list(under_way), num_returns=1, timeout=_LOOK_S)
        for reference in done:
            result, failure = ray.get(reference)
            yield Ended(*under_way.pop(reference), result, failure)
        del done


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect to a cluster, and leave it unless this process was connected before."""
    ray = required("ray", "ray", "distributes a run over a cluster", "--ray")
    if ray.is_initialized():
        yield ray
        return
    main = threading.current_thread() is threading.main_thread()
    was = signal.getsignal(signal.SIGTERM)
    try:
        _check_reachable(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise UsageError(
            expected="the address of a Ray cluster",
            got=f"{address} ({describe_error(error).partition('. ')[0]})",
            where="--ray",
            remedy="check the cluster with ray status",
        ) from None
    if main:
        signal.signal(signal.SIGTERM, was)  # Ray has put its own in its place
    with suppress(AttributeError):
        # It prints messages about lost nodes on stdout, where results go.
        ray._private.worker.print_to_stdstream = lambda *_, **__: None
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise OSError if the port is closed: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()


#: The worker of this node's process, by the run that it works for.
_crews: dict[str, Crew[Any, Any]] = {}


def _end_on_node(orders: _Orders, item: Any) -> tuple[Any, Failure | None]:
    """Do the work on an item in a worker process, which is kept for further tasks of the run."""
    run, work, limits, preload = orders
    if run not in _crews:
        _dismiss()
        _crews[run] = Crew(work, jobs=1, limits=limits, preload=preload)
    (ended,) = _crews[run].each([item])
    return ended.result, ended.failure


@atexit.register
def _dismiss() -> None:
    while _crews:
        _crews.popitem()[1].__exit__()
