"""report.json: at most 120 paths, and 40 kB of a drive of 10 s."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows

#: Entries whose keys are names: of parameters, of quantities, of reasons, of packages, of the recorder.
NAMED = ("assumed", "dropped", "metadata", "options", "quantities", "versions")


def paths(value: Any, at: str = "") -> Iterator[str]:
    """Yield the path of each leaf; entries of a list have one path, and so have entries by name."""
    if at.rpartition(".")[2] in NAMED:
        yield f"{at}.*"
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield from paths(entry, f"{at}.{key}")
    elif isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value):
        for entry in value:
            yield from paths(entry, f"{at}[]")
    else:
        yield at


def test_entries_of_a_list_and_of_names_have_one_path() -> None:
    document = {"a": [{"b": 1}, {"b": 2, "c": []}], "versions": {"x": "1", "y": "2"}, "d": [1, 2]}
    assert sorted({*paths(document)}) == [".a[].b", ".a[].c", ".d", ".versions.*"]


@pytest.mark.parametrize(
    ("log", "settings"),
    [
        ("dlc", {"car": Path("saloon"), "plan": Path("sample_logs/plan.toml")}),
        pytest.param("fishhook", {}, marks=pytest.mark.slow),
        pytest.param("faults", {"end": "10"}, marks=pytest.mark.slow),
    ],
)
def test_the_document_of_ten_seconds_is_short(
    log: str, settings: dict[str, Any], sample_logs_dir: Path, tmp_path: Path
) -> None:
    run_logs([str(sample_logs_dir / f"{log}.mcap")], tmp_path, RunConfig(keep="estimates", **settings), report=False)
    text = (tmp_path / "logs" / log / "report.json").read_bytes()
    document = json.loads(text)
    follows(document)
    assert len(text) <= 40_000
    assert len({*paths(document)}) <= 120
