"""One damaged log is the same to every command: the same losses in the same words, and exit code 3."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pdhef_logtool.learning.drives import DriveRecord, exit_code, tell_drive
from pdhef_logtool.records.signals import Loss


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
