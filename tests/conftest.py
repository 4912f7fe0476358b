"""Fixtures shared by all tests."""

from __future__ import annotations

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
