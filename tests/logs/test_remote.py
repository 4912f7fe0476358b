"""Logs on a server: the same figures as from the file, each byte once, few requests, faults in one line."""

from __future__ import annotations

import dataclasses
import os
import random
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.logs import remote_source
from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.container import Wanted
from pdhef_logtool.logs.discovery import LogInput, find_logs, identity_of
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import log_metadata, open_log
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.logs.remote_source import RemoteSource
from pdhef_logtool.records.errors import EXIT_FAILURE, LogError, UsageError
from tests.camera_log import with_camera, write_apart
from tests.counting_server import CountingServer, cutting, serving, stalling, status

pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")

NOTHING_YET = Wanted(frozenset())


@pytest.fixture(scope="module")
def saloon() -> Car:
    return Car.load("saloon")


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_source, "WAITS_S", (0.01, 0.02))


def _all_of(log: DriveLog) -> list[tuple[object, ...]]:
    """Return every stamp and number of a log, its topics and losses."""
    found: list[tuple[object, ...]] = []
    for topic in log.topics:
        fields = [f.path for f in log.fields(topic.name) if f.kind == "number"]
        columns = log.read({topic.name: fields})[topic.name]
        values = b"".join(np.asarray(v).tobytes() for v in columns.fields.values())
        found.append((topic, columns.log_time_ns.tobytes(), columns.publish_time_ns.tobytes(), values))
    return [*found, (log.start_ns, log.end_ns, [dataclasses.replace(x, where="") for x in log.lost])]


def _read(place: Path | RemotePlace) -> list[tuple[object, ...]]:
    with closing(open_log(place)) as log:
        return _all_of(log)


def _place(server: CountingServer, name: str) -> RemotePlace:
    return RemotePlace(server.place(name))


# ------------------------------------------------------------------------------------------------------- ranges


@settings(max_examples=8, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 400_000), st.integers(0, 200_000)), max_size=8), st.randoms())
def test_any_split_gives_the_same_bytes_and_none_twice(reads: list[tuple[int, int]], order: random.Random) -> None:
    data = random.Random(1).randbytes(400_000)
    with serving(x=data) as server:
        with closing(RemoteSource(_place(server, "x"))) as source:
            source.prefetch([(at, at + n) for at, n in reads if order.random() < 0.5])
            order.shuffle(reads)
            for at, n in reads:
                assert source.fetch(at, n) == data[at : at + n]
            source.fetch_whole()
            assert source.path.read_bytes() == data
            assert source.fetch(0, len(data)) == data
        assert server.twice() == 0
        assert all(r.end - r.start <= remote_source.MOST_RANGE_BYTES for r in server.requests)


# -------------------------------------------------------------------------------------------------- the same log


def test_a_drive_apart_from_its_camera_costs_its_chunks_alone(
    tmp_path: Path, sample_logs_dir: Path, saloon: Car
) -> None:
    file = tmp_path / "apart.mcap"
    write_apart(file, with_camera(sample_logs_dir / "dlc.mcap", 2_000_000_000))
    with serving(**{file.name: file.read_bytes()}) as server:
        hashes = []
        for place in (_place(server, file.name), file):
            with read_drive(place, saloon) as drive:
                assert len(drive.whole().signals) > 900
                hashes.append((drive.signals_sha256, drive.truth_sha256, drive.losses))
                assert place is file or drive.sha256 == identity_of(LogInput(place, "x"))
        sensors = 6
        assert len(server.requests) <= 3 + sensors
        assert server.twice() == 0
        assert server.bytes_sent < 0.7 * file.stat().st_size
        assert hashes[0] == hashes[1]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[: len(data) * 2 // 3],
        lambda data: data[:-40],
        lambda data: data[:50_000] + bytes(64) + data[50_064:],
    ],
    ids=["cut", "no footer", "damaged"],
)
def test_a_damaged_log_loses_the_same(tmp_path: Path, sample_logs_dir: Path, spoil: Callable[[bytes], bytes]) -> None:
    file = tmp_path / "damaged.mcap"
    file.write_bytes(spoil((sample_logs_dir / "dlc.mcap").read_bytes()))
    with serving(**{file.name: file.read_bytes()}) as server:
        with closing(open_log(_place(server, file.name), wanted=NOTHING_YET)):
            log = open_log(_place(server, file.name), wanted=Wanted(frozenset({"/imu/data"})))
        with closing(log), closing(open_log(file)) as local:
            assert _all_of(log) == _all_of(local)
            assert local.lost
        assert server.twice() == 0


def test_other_formats_are_fetched_once_as_a_whole(tmp_path: Path, sample_logs_dir: Path) -> None:
    (database,) = (sample_logs_dir / "step_rosbag2").glob("*.db3")
    plain = (sample_logs_dir / "dlc.mcap").read_bytes()
    files = {"dlc.mcap.zst": zstandard.ZstdCompressor(1).compress(plain), "step.db3": database.read_bytes()}
    with serving(**files) as server:
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
            assert _read(_place(server, name)) == _read(tmp_path / name)
        assert server.twice() == 0


def test_a_server_without_ranges_gives_all_at_once(sample_logs_dir: Path) -> None:
    file = sample_logs_dir / "dlc.mcap"
    with serving(**{file.name: file.read_bytes()}) as server:
        server.ranges = False
        assert _read(_place(server, file.name)) == _read(file)
        assert len(server.requests) == 1


def _copies() -> list[Path]:
    """Return the copies in the cache."""
    return sorted(Path(os.environ["PDHEF_CACHE_DIR"]).glob("remote/*/object/*"))


def test_a_later_command_fetches_no_byte_again(served: CountingServer, sample_logs_dir: Path) -> None:
    place = _place(served, "dlc.mcap")
    first = _read(place)
    served.requests.clear()
    assert _read(place) == first
    assert served.bytes_sent == 1, "the check of the version"
    (copy,) = _copies()
    damaged = bytearray(copy.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    copy.write_bytes(damaged)
    assert _read(place) == first
    assert served.bytes_sent > remote_source.BLOCK_BYTES
    served.files["dlc.mcap"] = (sample_logs_dir / "road.mcap").read_bytes()
    assert _read(place) == _read(sample_logs_dir / "road.mcap")


def test_copies_in_use_stay_and_the_others_are_removed(served: CountingServer, monkeypatch: pytest.MonkeyPatch) -> None:
    served.files["again.mcap"] = served.files["dlc.mcap"]
    with closing(open_log(_place(served, "dlc.mcap"))):
        monkeypatch.setattr(remote_source, "CACHE_BYTES", 0)
        _read(_place(served, "again.mcap"))
        assert [path.name for path in _copies()] == ["dlc.mcap"]
    assert _copies() == []


def test_metadata_is_read_from_head_and_tail(sample_logs_dir: Path) -> None:
    file = sample_logs_dir / "road.mcap"
    with serving(**{file.name: file.read_bytes()}) as server:
        assert log_metadata(_place(server, file.name)) == log_metadata(file)
        assert server.bytes_sent < 0.1 * file.stat().st_size


# ------------------------------------------------------------------------------------------------------- faults


def _error(server: CountingServer, name: str = "dlc.mcap") -> SourceError:
    with pytest.raises(SourceError) as raised:
        _read(_place(server, name))
    text = str(raised.value)
    assert "\n" not in text
    assert f"{server.url}/{name}" in text
    assert raised.value.exit_code == EXIT_FAILURE
    return raised.value


@pytest.fixture
def served(sample_logs_dir: Path) -> Iterator[CountingServer]:
    with serving(**{"dlc.mcap": (sample_logs_dir / "dlc.mcap").read_bytes()}) as server:
        yield server


@pytest.mark.parametrize(
    ("fault", "words", "requests"),
    [
        (status(429, {"Retry-After": "1"}), "status 429, 3 times in turn", 3),
        (status(503), "status 503, 3 times in turn", 3),
        (status(503, after=1), "status 503, 3 times in turn", 4),
        (status(404), "no such object", 1),
        (status(403), "a refusal (status 403); give credentials", 1),
        (status(302, {"Location": "/dlc.mcap"}), "cannot be requested", None),
        (cutting(100), "an answer that is cut, 3 times in turn", 4),
        (stalling(0.4), "silence of 0.2 s, 3 times in turn", 3),
    ],
    ids=["429", "503", "503 later", "404", "403", "round and round", "cuts", "stalls"],
)
def test_faults_end_in_one_line(
    served: CountingServer, monkeypatch: pytest.MonkeyPatch, fault, words: str, requests: int | None
) -> None:
    served.fault = fault
    if words.startswith("silence"):
        monkeypatch.setattr(remote_source, "SILENCE_S", 0.2)
    assert words in str(_error(served))
    assert requests is None or len(served.requests) == requests


def test_a_server_that_is_busy_or_cuts_for_a_while_costs_time_only(served: CountingServer, sample_logs_dir) -> None:
    served.fault = status(503, times=2)
    assert _read(_place(served, "dlc.mcap")) == _read(sample_logs_dir / "dlc.mcap")
    served.files["again.mcap"] = served.files["dlc.mcap"]
    served.requests.clear()
    served.fault = cutting(30_000, times=2)
    assert _read(_place(served, "again.mcap")) == _read(sample_logs_dir / "dlc.mcap")


@pytest.mark.parametrize("without_headers", [(), ("ETag",), ("ETag", "Last-Modified")])
def test_a_changed_object_is_an_error(tmp_path: Path, sample_logs_dir: Path, without_headers: tuple[str, ...]) -> None:
    write_apart(tmp_path / "apart.mcap", with_camera(sample_logs_dir / "dlc.mcap", 2_000_000_000))
    data = (tmp_path / "apart.mcap").read_bytes()
    with serving(**{"apart.mcap": data}) as server:
        server.without = frozenset(without_headers)
        with closing(open_log(_place(server, "apart.mcap"), wanted=NOTHING_YET)) as log:
            server.files["apart.mcap"] = data[:-1000]
            with pytest.raises(SourceError, match=r"expected the object that was opened, got another one"):
                log.read({"/camera": ["data"]})
        with closing(open_log(_place(server, "apart.mcap"))) as log:  # the copy of the former object is not used again
            assert log.lost


def test_nobody_answers() -> None:
    with serving(x=b"") as server:
        gone = server.url
    with pytest.raises(SourceError, match="no connection"):
        open_log(f"{gone}/x.mcap")


def test_empty_and_other_content(served: CountingServer) -> None:
    served.files |= {"empty.mcap": b"", "page.html": b"<html>" * 1000}
    with pytest.raises(LogError, match="an empty file"):
        open_log(served.place("empty.mcap"))
    with pytest.raises(LogError, match="none of these"):
        open_log(served.place("page.html"))
    assert served.bytes_sent <= remote_source.BLOCK_BYTES


def test_no_room_is_said(served: CountingServer) -> None:
    resource = pytest.importorskip("resource", reason="limits the size of files")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        assert "set PDHEF_CACHE_DIR" in str(_error(served))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# -------------------------------------------------------------------------------------------- names and secrets


def test_nothing_secret_is_shown(served: CountingServer) -> None:
    secret = served.place("dlc.mcap").replace("http://", "http://me:hunter2@") + "?X-Amz-Signature=cafe&part=1"
    place = RemotePlace(secret)
    assert str(place) == served.place("dlc.mcap")
    assert place.identity == served.place("dlc.mcap") + "?part=1"
    assert "hunter2" not in repr(find_logs([secret]))
    with closing(open_log(secret)) as log:
        assert "hunter2" not in repr((log.path, log.lost))
    assert served.requests[0].headers["Authorization"].startswith("Basic ")
    served.fault = status(500)
    with pytest.raises(SourceError) as raised:
        open_log(secret)
    assert not {"hunter2", "cafe"} & set(str(raised.value).replace("=", " ").replace("@", " ").split())
    assert [r.path for r in served.requests if r.path != "dlc.mcap"] == []


def test_identity_is_url_size_and_etag(served: CountingServer) -> None:
    (log,) = find_logs([served.place("dlc.mcap")])
    first = identity_of(log)
    assert len(served.requests) == 1
    assert identity_of(log) == first
    (signed,) = find_logs([served.place("dlc.mcap") + "?Signature=2"])
    assert identity_of(signed) == first
    served.files["dlc.mcap"] += b"x"
    assert identity_of(log) != first


def test_urls_lists_and_files_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sample_logs_dir: Path) -> None:
    listed = tmp_path / "list.txt"
    dlc = sample_logs_dir / "dlc.mcap"
    listed.write_text(f"# drives\nhttps://host/a/one.mcap\n\n{dlc}\nhttps://host/b/one.mcap\n")
    found = find_logs([f"@{listed}", str(dlc)])
    assert [str(i.path) for i in found] == ["https://host/a/one.mcap", str(dlc), "https://host/b/one.mcap"]
    assert len({i.stem for i in found}) == 3
    assert [i.stem for i in find_logs(["https://host/a/one.mcap", "https://host/b/one.mcap"])] == ["a__one", "b__one"]
    assert find_logs(["https://host/a/one.mcap?x=1"])[0].stem == "one"
    asked = [f"https://host/get?id={i}&sig=x" for i in (1, 2)]
    assert {i.stem for i in find_logs(asked)} == {i.stem for i in find_logs(asked[::-1])}
    assert len(find_logs([*asked, "https://host/get?id=1&sig=y"])) == 2
    monkeypatch.chdir(tmp_path)
    (tmp_path / "@odd").mkdir()
    (tmp_path / "@odd" / "drive.mcap").write_bytes(dlc.read_bytes())
    assert [i.stem for i in find_logs(["@odd"])] == ["drive"]
    assert [i.stem for i in find_logs(["@odd/*.mcap"])] == ["drive"]
    with pytest.raises(UsageError, match="s3://, http://, https://"):
        find_logs(["gs://bucket/one.mcap"])
    with pytest.raises(UsageError, match="s3://, http://, https://"):
        find_logs(["https://"])
