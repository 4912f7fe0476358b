"""Fault injection for workers: each work item selects the fault."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from pdhef_logtool.storage.files import PendingFile
from pdhef_logtool.workers.supervisor import Tell

#: What to do, and the value to return or a path.
Item = tuple[str, str]
called: list[int] = []


def note_call() -> None:
    """Record a call by the fork server."""
    called.append(os.getpid())


#: Names the file to which :func:`die_at_start` notes how often it killed the fork server.
DEATHS = "PDHEF_TEST_DEATHS"


def die_at_start() -> None:
    """Kill the fork server while it loads."""
    with Path(os.environ[DEATHS]).open("ab") as opened:
        opened.write(b"x")
    os.kill(os.getpid(), signal.SIGKILL)


class Odd:
    """A result that cannot be pickled."""

    def __reduce__(self) -> tuple[object, ...]:
        raise TypeError("not me")


def planted(item: Item, tell: Tell) -> object:
    """Run the fault or action that the item selects."""
    what, value = item
    tell(f"at {what}", 0.5)
    if what in _FAULTS:
        return _FAULTS[what](value, tell)
    if what == "where":
        return os.getpid(), called, threading.active_count(), os.environ.get("OMP_NUM_THREADS")
    return value


def _kill(_value: str, _tell: Tell) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _kill_once(value: str, tell: Tell) -> str:
    if not Path(value).exists():
        Path(value).touch()
        _kill(value, tell)
    return value


def _kill_server_once(value: str, tell: Tell) -> str:
    if not Path(value).exists():
        os.kill(os.getppid(), signal.SIGKILL)
    return _kill_once(value, tell)


def _hang(_value: str, _tell: Tell) -> None:
    time.sleep(600)


def _stop(_value: str, _tell: Tell) -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def _slowly(value: str, tell: Tell) -> str:
    for k in range(10):
        time.sleep(0.1)
        tell("slowly", k / 10)
    return value


def _grow(_value: str, tell: Tell) -> None:
    held = []
    while True:
        tell("at grow", 0.5)
        held.append(bytearray(os.urandom(1 << 16)) * 160)
        time.sleep(0.005)


def _8_gb(_value: str, _tell: Tell) -> int:
    return len(bytearray(8 << 30))


def _raise(_value: str, _tell: Tell) -> None:
    raise ValueError("two\nlines")


def _cut(_value: str, _tell: Tell) -> None:
    """Write half a message and then wait, like a worker stopped during a write."""
    files = [f for f in Path("/proc/self/fd").iterdir() if int(f.name) > 2 and f.is_socket()]
    for file in files:
        os.write(int(file.name), (1000).to_bytes(4, "big") + b"half")
    time.sleep(600)


def _wait(value: str, tell: Tell) -> str:
    """Note the process that it begins in, wait for the word to go on, and write a file that appears whole."""
    path = Path(value)
    with path.with_suffix(".begun").open("a") as file:
        file.write(f"{os.getpid()}\n")
    while not (path.parent / "go").exists():
        tell("at wait", 0.5)
        time.sleep(0.01)
    with PendingFile(path.with_suffix(".done")) as pending:
        pending.path.write_text(value)
    return value


def _burn(value: str, _tell: Tell) -> None:
    until_s = time.process_time() + float(value)
    while time.process_time() < until_s:
        pass


def _alone(value: str, tell: Tell) -> int:
    """Be lost the first time; the second time return how many workers there are."""
    _kill_once(value, tell)
    parent = os.getppid()
    return len(Path(f"/proc/{parent}/task/{parent}/children").read_text().split())


_NAMED = (_kill, _kill_once, _kill_server_once, _hang, _stop, _cut, _slowly, _grow, _raise, _alone, _burn, _wait)
_FAULTS = {of.__name__[1:].replace("_", " "): of for of in _NAMED} | {
    "8 GB": _8_gb,
    "exit": lambda _value, _tell: os._exit(5),
    "quit": lambda _value, _tell: sys.exit(3),
    "odd": lambda _value, _tell: Odd(),
}
