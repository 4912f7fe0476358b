"""Records, splits and settings of the drives of the learning commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.car.parts import LearntOn
from pdhef_logtool.learning.drives import DriveRecord, LearnSettings, choose_drives, exit_code, set_manifest, tell_drive
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.config import RunConfig

SALOON = RunConfig(car=Path("saloon"))


def record(name: str, **changes: Any) -> DriveRecord:
    return replace(DriveRecord(name, f"{name}.mcap", sha256=name * 64, seconds=6.0, span_s=(1.5, 7.5)), **changes)


def test_a_record_in_json_and_as_a_car_remembers_it() -> None:
    full = record("a", seconds=1.23456, span_s=(0.12345, 9.87654), split="test")
    document = full.to_dict()
    assert (document["seconds"], document["span_s"]) == (1.235, [0.123, 9.877])
    assert not {"left_out", "reason"} & document.keys()
    assert full.learnt_on == LearntOn(name="a", sha256="a" * 64, start_s=0.12, end_s=9.88)
    without = record("b", span_s=None, left_out="no ground truth")
    assert without.to_dict()["span_s"] is None and without.to_dict()["reason"] == "no ground truth"
    assert (without.learnt_on.start_s, without.learnt_on.end_s) == (0.0, 0.0)


def test_what_a_user_must_know_of_a_drive_is_told_in_order_and_decides_the_exit_code() -> None:
    lost = Loss("gap", "2 s are gone", "/imu")
    note = Loss("late", "late", "/imu", severity="note")
    told: list[str] = []
    tell_drive(record("a", notes=("perfect ground truth",), losses=(lost, note), left_out="it is short"), told.append)
    assert told == ["a: perfect ground truth", "a: 2 s are gone (/imu)", "a is left out: it is short"]
    good, bad = record("a", losses=(note,)), record("b", left_out="x")
    assert [exit_code(r) for r in ([good], [good, bad], [good, record("c", losses=(lost,))], [bad])] == [0, 3, 3, 1]


def test_only_whole_entries_of_a_manifest_count(tmp_path: Path) -> None:
    assert set_manifest(tmp_path) == {}
    entries = [{"file": "a.mcap", "split": "test"}, "text", {"file": 3}, {"split": "train"}]
    (tmp_path / "manifest.json").write_text(json.dumps({"drives": entries, "log": {"file": "b"}}))
    (tmp_path / "manifest.toml").write_text('[[log]]\nfile = "c.mcap"\nsplit = "train"\n')
    assert set_manifest(tmp_path) == {
        "a.mcap": {"file": "a.mcap", "split": "test"},
        "c.mcap": {"file": "c.mcap", "split": "train"},
    }
    (tmp_path / "manifest.json").write_text("no json")
    assert list(set_manifest(tmp_path)) == ["c.mcap"]


def test_three_refused_drives_are_named_and_the_rest_counted(tmp_path: Path) -> None:
    inputs = [LogInput(tmp_path / f"{n}.mcap", n) for n in "abcde"]
    entries = [{"file": f"{n}.mcap", "split": "test"} for n in "abcde"]

    def refused(count: int) -> str:
        (tmp_path / "manifest.json").write_text(json.dumps({"drives": entries[:count]}))
        with pytest.raises(UsageError) as caught:
            choose_drives(inputs, LearnSettings(config=SALOON))
        return str(caught.value)

    assert "a (test), b (test), c (test) and 2 more" in refused(5)
    assert "a (test), b (test), c (test)" in refused(3) and "more" not in refused(3)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(UsageError, match="drives without a set's manifest"):
        choose_drives(inputs, LearnSettings(config=SALOON, split="validation"))
    assert choose_drives(inputs, LearnSettings(config=SALOON)) == (inputs, {})


@pytest.mark.parametrize(
    ("wrong", "place"),
    [({"seed": -1}, "--seed"), ({"stage": "noise"}, "--stages"), ({"stage": "teach,gain"}, "--stages")],
)
def test_wrong_settings_are_usage_errors(wrong: dict[str, Any], place: str) -> None:
    with pytest.raises(UsageError, match=place):
        LearnSettings(config=SALOON, **wrong)
