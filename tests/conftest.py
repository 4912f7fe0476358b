"""Fixtures shared by all tests.

Tests run in random order in several processes, and a process can get any part of a file. A test therefore changes
shared state (environment, working directory, module attributes, signal handlers) by fixtures only, writes to
``tmp_path``, lets the system choose ports and takes a separate S3 bucket (``tests/s3_store.py``). It calls the
command line in the test process (``called`` in ``tests/command_line.py``) unless it is about processes: a start takes
two seconds. Limits in seconds only end a hang (minutes): another load of the machine must not reach them.
"""

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Generator
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
#: Environment variables that pytest sets for each test, and Polars and Ray when they are imported.
OF_LIBRARIES = {"PYTEST_CURRENT_TEST", "PYTHONBREAKPOINT"}
OF_LIBRARIES |= {"RAY_CLIENT_MODE", "_RJEM_MALLOC_CONF", "TORCHINDUCTOR_CACHE_DIR"}

hypothesis.settings.register_profile("any load", deadline=None)
hypothesis.settings.load_profile("any load")


@pytest.fixture(scope="session")
def shared_dir():
    if not (SHARED / "data").is_dir():
        pytest.skip("needs ../shared beside the repository (recorded drives that may not be redistributed)")
    return SHARED


@pytest.fixture(scope="session")
def sample_logs_dir():
    return ROOT / "sample_logs"


@pytest.fixture(scope="session")
def bare_vehicle(sample_logs_dir):
    """Return the vehicle file of the sample logs without a network."""
    head, _, rest = (sample_logs_dir / "vehicle.toml").read_text().partition("[network]")
    return head + rest[rest.index("[sensors]") :]


def pytest_configure() -> None:
    """Restore SIGINT, which a shell without job control ignores in background commands and all their children."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _process_state() -> set[str]:
    """Return the state that all tests of this process share, and its child processes where the system lists them.

    The servers that fork readers of tables are kept on purpose, as their start takes a second.
    """
    readers = sys.modules.get("pdhef_logtool.logs.reader_process")
    kept = {str(server.pid) for server in readers.SERVERS.values()} if readers else set()
    processes: list[str] = []
    for children in Path("/proc/self/task").glob("*/children"):
        with contextlib.suppress(OSError):  # of a thread that has just ended
            processes += children.read_text().split()
    return {
        f"working directory {Path.cwd()}",
        *(f"signal {n}: {signal.getsignal(n)}" for n in signal.valid_signals()),
        *(f"{name}={value}" for name, value in os.environ.items() if name not in OF_LIBRARIES),
        *(f"process {pid}" for pid in processes if pid not in kept),
    }


@pytest.fixture(autouse=True)
def _unchanged_process():
    """Fail a test that leaves a process behind, or another signal handler, environment variable or folder."""
    before = _process_state()
    yield
    after = _process_state()
    ended = {state for state in before - after if state.startswith("process ")}
    assert after == before - ended, "the test leaves its process as it was"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep all that is loaded for tests out of the way of Python's search for unused objects: it is never unused.

    A search looks at every object, and the libraries that tests import have half a million.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave long tests and tests with extras to ``make fleet``."""
    if item.get_closest_marker("fleet") is not None and not os.environ.get("PDHEF_FLEET"):
        pytest.skip("make fleet runs it")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a marker ``slow`` that leaves a package without a test in the quick tier.

    The tests of a package are in the folder of its name. Only a collection of all folders can tell; this runs before
    ``-m`` takes any test away.
    """
    tests = ROOT / "tests"
    collected = {item.path.relative_to(tests).parts[0] for item in items if tests in item.path.parents}
    if not {p.parent.name for p in tests.glob("*/test_*.py")} <= collected:
        return
    quick = {item.path.relative_to(tests).parts[0] for item in items if item.get_closest_marker("slow") is None}
    packages = {p.parent.name for p in (ROOT / "pdhef_logtool").glob("*/__init__.py")} | {"truthsim"}
    if missing := sorted(packages - quick):
        raise pytest.UsageError(f"every test of {', '.join(missing)} is marked slow: make quick would not touch it")
