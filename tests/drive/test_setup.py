"""A frozen set-up is determined once, from another log or the first seconds; later data do not change it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.plan import setup_of
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.setup import LogUntil, Setup, load_setup, setup_toml
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.runs.frames import estimate

CHANGE_S = 30.0


#: Fields that change their sign when the IMU is turned by half a turn about the vertical.
TURNED = tuple(f"{vector}.{axis}" for vector in ("linear_acceleration", "angular_velocity") for axis in "xy")


class ChangedLater:
    """A log with a change: from a given time on, its IMU is rotated by 180° and its messages arrive 70 ms later."""

    def __init__(self, log: Any, change_ns: int) -> None:
        self._log, self._change_ns = log, change_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def read(self, requests: Any, start_ns: Any = None, end_ns: Any = None, **options: Any) -> dict[str, Any]:
        columns = dict(self._log.read(requests, start_ns, end_ns, **options))
        for topic, read in columns.items():
            later = read.log_time_ns >= self._change_ns
            changed = {
                path: np.where(later, -values, values) if path in TURNED else values
                for path, values in read.fields.items()
            }
            columns[topic] = replace(read, fields=changed, log_time_ns=read.log_time_ns + later * 70_000_000)
        return columns


def signals(log: Path, options: ReadOptions) -> tuple[Signals, Setup]:
    with read_drive(log, Car.load("saloon"), options=options) as drive:
        return drive.whole().signals, setup_of(drive.plan)


@pytest.fixture(scope="module")
def road(sample_logs_dir: Path) -> Path:
    return sample_logs_dir / "road.mcap"


def before_the_change(both: Signals) -> list[np.ndarray[Any, Any]]:
    rows = both.stamps_ns < both.stamps_ns[0] + (CHANGE_S - 3.0) * 1e9
    return [
        both.steer_rad[rows],
        both.ay_m_s2[rows],
        both.yaw_rate_rad_s[rows],
        both.speed_m_s[rows],
        both.ready_ns[rows],
    ]


@pytest.mark.parametrize("how", ["whole log", "first seconds", "file"])
def test_with_a_set_up_the_future_changes_nothing_that_came_before(
    how: str, road: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ReadOptions(setup_from_s=None if how == "whole log" else CHANGE_S - 5.0)
    as_recorded, setup = signals(road, options)
    if how == "file":
        (tmp_path / "setup.toml").write_text(setup_toml(setup, "Of a test."))
        options = ReadOptions(setup=tmp_path / "setup.toml")
        as_recorded, _ = signals(road, options)
    really_open = reading.open_log

    def opened(*args: Any, **more: Any) -> Any:
        log = really_open(*args, **more)
        return ChangedLater(log, log.start_ns + round(CHANGE_S * 1e9))

    monkeypatch.setattr(reading, "open_log", opened)
    changed, _ = signals(road, options)
    both = zip(before_the_change(as_recorded), before_the_change(changed), strict=True)
    same = [np.array_equal(a, b, equal_nan=True) for a, b in both]
    assert all(same) == (how != "whole log")  # mounting and delays of a whole log look at all of it
    later = np.array_equal(changed.ay_m_s2[-500:], -as_recorded.ay_m_s2[-500:], equal_nan=True)
    assert later == (how != "whole log")


@pytest.mark.slow
def test_no_causal_estimate_depends_on_the_future(road: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every estimator, with the set-up of the first seconds."""
    options = ReadOptions(setup_from_s=CHANGE_S - 5.0, end="60")

    def estimates() -> dict[str, Any]:
        with read_drive(road, Car.load("saloon"), options=options) as drive:
            tracks = estimate(drive, ["all"]).tracks
        return {name: track for name, track in tracks.items() if name != "truth"}

    as_recorded = estimates()
    really_open = reading.open_log

    def opened(*args: Any, **more: Any) -> Any:
        log = really_open(*args, **more)
        return ChangedLater(log, log.start_ns + round(CHANGE_S * 1e9))

    monkeypatch.setattr(reading, "open_log", opened)
    changed = estimates()
    assert len(changed) > 8
    for name, track in as_recorded.items():
        rows = track.stamps_ns < track.stamps_ns[0] + (CHANGE_S - 3.0) * 1e9
        same = np.array_equal(track.sideslip_rad[rows], changed[name].sideslip_rad[rows], equal_nan=True)
        assert same == spec_of(name).causal, name


def test_a_set_up_is_read_back_as_it_was_written(road: Path, tmp_path: Path) -> None:
    _, setup = signals(road, ReadOptions(setup_from_s=20.0))
    path = tmp_path / "setup.toml"
    path.write_text(setup_toml(setup, "Of a test.\nTwo lines."))
    assert repr(load_setup(path)) == repr(setup)  # NaN is NaN
    assert path.read_text().startswith("# Of a test.\n# Two lines.\n")


def test_the_same_set_up_gives_the_same_signals(road: Path, tmp_path: Path) -> None:
    whole, setup = signals(road, ReadOptions())
    (tmp_path / "setup.toml").write_text(setup_toml(setup, "Of a test."))
    again, _ = signals(road, ReadOptions(setup=tmp_path / "setup.toml"))
    np.testing.assert_array_equal(whole.ay_m_s2, again.ay_m_s2)
    np.testing.assert_array_equal(whole.ready_ns, again.ready_ns)


def test_a_set_up_of_other_topics_is_refused_in_one_line(sample_logs_dir: Path, road: Path, tmp_path: Path) -> None:
    _, setup = signals(road, ReadOptions(setup_from_s=20.0))
    text = setup_toml(setup, "Of a test.").replace("/imu/data", "/imu/other")
    (tmp_path / "setup.toml").write_text(text)
    with pytest.raises(MappingError, match="/imu/other"):
        signals(road, ReadOptions(setup=tmp_path / "setup.toml"))
    (tmp_path / "setup.toml").write_text(text.replace("decided_s", "decided"))
    with pytest.raises(MappingError, match="decided_s"):
        signals(road, ReadOptions(setup=tmp_path / "setup.toml"))


def test_a_log_until_some_time_reads_nothing_after_it(road: Path) -> None:
    log = reading.open_log(road)
    until = log.start_ns + 5_000_000_000
    cut: Any = LogUntil(log, until)
    request = {"/imu/data": ["linear_acceleration.y"]}
    assert cut.end_ns == until
    for columns in (cut.read(request), cut.read(request, None, until + 10**9), cut.read(request, cut.start_ns, None)):
        assert len(columns["/imu/data"]) > 0 and columns["/imu/data"].log_time_ns.max() < until
    log.close()
