"""Fixtures shared by all tests.

Tests run in random order in several processes, and a process can get any part of a file. A test therefore changes
what others see (environment, working directory, module attributes, signal handlers) by fixtures only, writes to
``tmp_path``, lets the system choose ports and takes an S3 bucket of its own (``tests/s3_store.py``). It calls the
command line in its own process (``called`` in ``tests/command_line.py``) unless it is about processes: a start takes
two seconds.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Generator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    if not (SHARED / "data").is_dir():
        pytest.skip("needs ../shared beside the repository (recorded drives that may not be redistributed)")
    return SHARED


@pytest.fixture(scope="session")
def sample_logs_dir() -> Path:
    return ROOT / "sample_logs"


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
    """Leave what takes long or needs extras to ``make fleet``."""
    if item.get_closest_marker("fleet") is not None and not os.environ.get("PDHEF_FLEET"):
        pytest.skip("make fleet runs it")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a marker ``slow`` that leaves a package without a test in the quick tier.

    The tests of a package are in the folder of its name. Only a collection of all folders can tell; this runs before
    ``-m`` takes any test away.
    """
    tests = ROOT / "tests"
    collected = {item.path.relative_to(tests).parts[0] for item in items}
    if not {p.parent.name for p in tests.glob("*/test_*.py")} <= collected:
        return
    quick = {item.path.relative_to(tests).parts[0] for item in items if item.get_closest_marker("slow") is None}
    packages = {p.parent.name for p in (ROOT / "pdhef_logtool").glob("*/__init__.py")} | {"truthsim"}
    if missing := sorted(packages - quick):
        raise pytest.UsageError(f"every test of {', '.join(missing)} is marked slow: make quick would not touch it")
