"""The default limits: amounts that recorders write pass, amounts that harm a machine do not."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError, Meter, ResourceLimits

MIB = 1 << 20


@pytest.mark.parametrize(
    ("limit", "sound", "harmful"),
    [
        ("chunk_bytes", 64 * MIB, 1024 * MIB),
        ("chunk_ratio", 500, 10_000),
        ("chunk_messages", 200_000, 10_000_000),
        ("messages_per_byte", 1.0, 100.0),
        ("channels", 2000, 65_000),
        ("metadata_bytes", 16 * MIB, 512 * MIB),
        ("schema_bytes", MIB, 64 * MIB),
        ("schema_leaves", 5000, 1_000_000),
        ("schema_depth", 16, 200),
        ("array_width", 40_000, 10_000_000),
        ("table_bytes", 100 * MIB, 2048 * MIB),
        ("table_ratio", 16, 1000),
        ("seconds", 3.0, 60.0),
        ("seconds_per_mib", 10.0, 200.0),
    ],
)
def test_sound_amounts_pass_and_harmful_ones_do_not(limit: str, sound: float, harmful: float) -> None:
    DEFAULT_LIMITS.check(limit, sound, "a file")
    with pytest.raises(LimitError, match=f"a file: expected at most .* {limit.replace('_', ' ')}, got .*--set budget"):
        DEFAULT_LIMITS.check(limit, harmful, "a file")
    DEFAULT_LIMITS.times(harmful / sound).check(limit, harmful, "a file")


def test_every_default_is_tested() -> None:
    (mark,) = test_sound_amounts_pass_and_harmful_ones_do_not.pytestmark  # type: ignore[attr-defined]
    assert {name for name, *_ in mark.args[1]} == set(ResourceLimits.__slots__)


@pytest.mark.parametrize(
    ("size", "stored", "limit"),
    [(2, 1, ""), (1, 1 / MIB, ""), (2, 100 / MIB, "chunk ratio"), (1024, 1024, "chunk bytes"), (2, 0, "chunk ratio")],
)
def test_small_parts_may_unfold_as_they_like(size: int, stored: float, limit: str) -> None:
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_unpacked(size * MIB, round(stored * MIB), "a chunk")


@pytest.mark.parametrize(("size", "stored", "limit"), [(100, 1, ""), (600, 1, "table bytes"), (600, 20, "")])
def test_tables_may_be_as_large_as_their_file_gives_reason_for(size: int, stored: int, limit: str) -> None:
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_table(size * MIB, stored * MIB, "a file")


@pytest.mark.parametrize(
    ("count", "stored", "limit"),
    [(60_000, 1, ""), (10**5, 10**5, ""), (10**5, 1000, "messages per byte"), (10**7, 1 << 30, "chunk messages")],
)
def test_many_messages_need_bytes(count: int, stored: int, limit: str) -> None:
    with pytest.raises(LimitError, match=limit) if limit else nullcontext():
        DEFAULT_LIMITS.check_messages(count, stored)


def test_time_grows_with_what_is_read_and_counts_again_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("pdhef_logtool.logs.resource_limits.time.thread_time", lambda: now[0])
    meter = Meter(ResourceLimits(seconds=5.0, seconds_per_mib=20.0))
    assert meter.allowed_s == 5.0
    for _ in range(2):
        with meter.running(MIB // 4):
            now[0] += 7.0
            meter.check()
    assert meter.allowed_s == 15.0
    meter.check()
    with meter.running(), pytest.raises(LimitError, match="longer than 15 s"):
        now[0] += 1.1
        meter.check()
