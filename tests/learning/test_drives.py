"""Records, splits and settings of the drives of the learning commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.learning.drives import DriveRecord, LearnSettings, exit_code, tell_drive
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.config import RunConfig


def record(name: str, **changes: Any) -> DriveRecord:
    return replace(DriveRecord(name, f"{name}.mcap", sha256=name * 64, seconds=6.0, span_s=(1.5, 7.5)), **changes)


def test_what_a_user_must_know_of_a_drive_is_told_in_order_and_decides_the_exit_code() -> None:
    lost = Loss("gap", "2 s are gone", "/imu")
    note = Loss("late", "late", "/imu", severity="note")
    told: list[str] = []
    tell_drive(record("a", notes=("perfect ground truth",), losses=(lost, note), left_out="it is short"), told.append)
    assert told == ["a: perfect ground truth", "a: 2 s are gone (/imu)", "a is left out: it is short"]
    good, bad = record("a", losses=(note,)), record("b", left_out="x")
    assert [exit_code(r) for r in ([good], [good, bad], [good, record("c", losses=(lost,))], [bad])] == [0, 3, 3, 1]


def test_a_wrong_seed_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="--seed"):
        LearnSettings(config=RunConfig(car=Path("saloon")), seed=-1)
