"""What is learnt of drives is the same from a cache of slim logs, by which each drive is read once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive import slim_cache
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.learning.drives import load_drive
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.config import RunConfig, load_config


def written(out: Path) -> dict[str, bytes]:
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def test_drives_in_memory_are_the_same(sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (log,) = find_logs([str(sample_logs_dir / "dlc.mcap")])
    found: list[Any] = []
    for cache in (None, str(tmp_path), str(tmp_path)):
        found.append(load_drive(log, Car.load("saloon"), None, ReadOptions(start="1", end="9", cache=cache)))
        if cache is not None:
            monkeypatch.setattr(slim_cache, "slim_log", lambda *_: pytest.fail("the log is read again"))
    (record, own), *others = found
    for again, drive in others:
        assert again.notes == (*record.notes, "a reduced log replaces dlc.mcap")
        assert replace(again, notes=record.notes) == record
        for track in ("signals", "truth"):
            one, other = getattr(own, track), getattr(drive, track)
            np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_array_equal(own.truth.sideslip_rad, drive.truth.sideslip_rad)
        np.testing.assert_array_equal(own.signals.ay_m_s2, drive.signals.ay_m_s2)


@pytest.mark.slow
def test_a_data_set_is_the_same(sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [str(sample_logs_dir / "dlc.mcap"), str(sample_logs_dir / "step_rosbag2")]
    for number, cache in enumerate((None, str(tmp_path / "cache"), str(tmp_path / "cache"))):
        config = RunConfig(car=Path("saloon"), cache=cache)
        assert extract(logs, tmp_path / f"{number}", ExtractSettings(config)).exit_code == 0
        if cache is not None:
            monkeypatch.setattr(slim_cache, "slim_log", lambda *_: pytest.fail("a log is read again"))
    assert written(tmp_path / "0") == written(tmp_path / "1") == written(tmp_path / "2")


def test_the_bound_is_of_a_cache_that_is_a_folder() -> None:
    assert load_config(None, {"cache": "slim", "cache_max_gb": 2.0}).to_dict() == load_config(None, {}).to_dict() | {
        "annotate": "sidecar"
    }
    for cache in ({}, {"cache": "s3://cars/slim"}):
        with pytest.raises(UsageError, match="cache_max_gb: expected --cache DIR"):
            load_config(None, {**cache, "cache_max_gb": 2.0})
