"""The cache of slim logs: made once, told apart by what decides them, safe with several processes, mended."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive import slim_cache
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.slim_cache import SlimCache
from pdhef_logtool.logs.discovery import LogInput, identity_of
from pdhef_logtool.logs.reduced_log import is_whole
from pdhef_logtool.mapping import Mapping, SignalSource
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.workers.supervisor import Tell, supervise

DLC = Path(__file__).resolve().parents[2] / "sample_logs/dlc.mcap"
AS_IT_IS = ReadOptions()
LOG = LogInput(DLC, "dlc", (1.0, 9.0))
MAPPING = Mapping(
    signals={
        "ay_m_s2": SignalSource("ay_m_s2", "/imu/data", "linear_acceleration.y"),
        "yaw_rate_rad_s": SignalSource("yaw_rate_rad_s", "/imu/data", "angular_velocity.z"),
    }
)


def _cache(place: Path | str, mapping: Mapping | None = None, options: ReadOptions = AS_IT_IS) -> SlimCache:
    return SlimCache(str(place), mapping, options)


def _use(cache: SlimCache, log: LogInput = LOG) -> tuple[LogInput, list[str]]:
    told: list[str] = []
    with cache.standing_in(log, told.append) as found:
        assert found.local is not None and found.local.is_file()
        assert (found.stem, found.span_s) == (log.stem, log.span_s)
        return found, told


def _entries(place: Path) -> list[Path]:
    return sorted(p for p in place.rglob("*") if p.is_file())


def _make_none(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(slim_cache, "slim_log", lambda *_: pytest.fail("a slim log is made"))


def test_a_log_is_read_once_wherever_it_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = _cache(tmp_path / "cache")
    first, told = _use(cache)
    assert (first.path, told) == (_entries(tmp_path / "cache")[0], [])
    shutil.copy(DLC, tmp_path / "moved.mcap")
    _make_none(monkeypatch)
    assert _use(cache, replace(LOG, path=tmp_path / "moved.mcap"))[0].path == first.path
    with read_drive(DLC, Car.load(None)) as a, read_drive(replace(first, span_s=None), Car.load(None)) as b:
        for drive in (a, b):
            list(drive.windows())
        assert (a.sha256, a.signals_sha256, a.file) == (b.sha256, b.signals_sha256, b.file)


def test_what_decides_an_entry_tells_it_apart(tmp_path: Path) -> None:
    place = tmp_path / "cache"
    rtk = ReadOptions(prefer_truth="rtk")
    wide = replace(
        MAPPING, signals={**MAPPING.signals, "ax_m_s2": SignalSource("ax_m_s2", "/imu/data", "orientation.x")}
    )
    caches = [_cache(place), _cache(place, MAPPING), _cache(place, wide), _cache(place, None, rtk)]
    for number, cache in enumerate(caches, 1):
        _use(cache)
        assert len(_entries(place)) == number
    _use(_cache(place, None, ReadOptions(start="1", sensors="esp", friction=0.4)))
    assert len(_entries(place)) == len(caches)


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["a byte", "the end", "all", "another file"])
def test_a_damaged_entry_is_made_anew_with_a_note(tmp_path: Path, spoilt: str) -> None:
    cache = _cache(tmp_path / "cache")
    whole = _use(cache)[0].local.read_bytes()
    (entry,) = _entries(tmp_path / "cache")
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 1
    contents = {"a byte": flipped, "the end": whole[:-9], "all": b"", "another file": DLC.read_bytes()}
    entry.write_bytes(contents[spoilt])
    assert _use(cache)[1] == ["dlc: its reduced log in the cache is damaged and is written again"]
    assert entry.read_bytes() == whole
    assert _entries(tmp_path / "cache") == [entry]


def test_any_damage_is_seen(tmp_path: Path) -> None:
    path = _use(_cache(tmp_path / "cache"))[0].local
    assert path is not None
    data = path.read_bytes()
    copy = tmp_path / "copy.mcap"
    for at in [*range(0, len(data), len(data) // 50), *range(len(data) - 60, len(data))]:
        copy.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        assert not is_whole(copy), at


def _make(place: str, tell: Tell) -> bytes:
    with _cache(place).standing_in(LOG) as found:
        assert found.local is not None
        return found.local.read_bytes()[-40:]


@pytest.mark.slow
@pytest.mark.fleet
def test_several_processes_share_a_cache(tmp_path: Path) -> None:
    ended = list(supervise(_make, [str(tmp_path)] * 6, jobs=3))
    assert [one.failure for one in ended] == [None] * 6
    assert len({one.result for one in ended}) == 1
    assert len(_entries(tmp_path)) == 1


def test_a_bounded_cache_lets_go_of_what_was_not_used_for_longest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slim(_log: LogInput, target: Path, *_: object) -> object:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(bytes(1000))
        return SimpleNamespace(identity=target.name.partition("-")[0])

    def use(name: str) -> None:
        with cache.standing_in(LogInput(tmp_path / name, name)):
            pass

    monkeypatch.setattr(slim_cache, "slim_log", slim)
    monkeypatch.setattr(slim_cache, "_is_sound", Path.is_file)
    cache = _cache(tmp_path / "cache", options=ReadOptions(cache_max_gb=3.5e-6))
    kept = {}
    for number, name in enumerate("abcd"):
        (tmp_path / name).write_text(name)
        kept[name] = f"{identity_of(LogInput(tmp_path / name, name))}-"
        use(name)
        for path in _entries(tmp_path / "cache"):
            if path.name.startswith(kept[name]):
                os.utime(path, ns=(number, number))
        if name == "c":
            use("a")
    left = {name for name in "abcd" for p in _entries(tmp_path / "cache") if p.name.startswith(kept[name])}
    assert left == {"a", "c", "d"}, "b was not used for longest"


def test_a_store_serves_as_well() -> None:
    import fsspec

    cache = _cache("memory://slim/logs/")
    assert _use(cache)[1] == []
    store = fsspec.filesystem("memory")
    (entry,) = store.find("/slim/logs")
    with pytest.MonkeyPatch.context() as patch:
        _make_none(patch)
        assert _use(cache)[1] == []
    store.pipe_file(entry, store.cat_file(entry)[:-20])
    assert len(_use(cache)[1]) == 1
    assert store.find("/slim/logs") == [entry]


def test_what_has_no_slim_log_is_read_itself(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    for path in (tmp_path / "bad.mcap", tmp_path / "none.mcap"):
        with _cache(tmp_path / "cache").standing_in(LogInput(path, "x"), pytest.fail) as found:
            assert found.path == path
    assert not (tmp_path / "cache").exists() or not _entries(tmp_path / "cache")


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    told: list[str] = []
    with _cache(tmp_path / "file").standing_in(LOG, told.append) as found:
        assert found == LOG
    assert len(told) == 1 and "the cache" in told[0] and "\n" not in told[0]
    with pytest.raises(UsageError, match="nothing://x"), _cache("nothing://x").standing_in(LOG):
        pass
