"""Logs on a server: the same figures as from the file, each byte once, faults in one line, safe redirects."""

import asyncio
import dataclasses
import os
import random
import socket
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings, strategies as st
from mcap.reader import make_reader

from pdhef_logtool import Car, ReadOptions, read_drive
from pdhef_logtool.logs import remote_source
from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.container import ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.discovery import LogInput, find_logs, identity_of
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import log_metadata, open_log
from pdhef_logtool.logs.redirect_guard import PrivateRedirectError, RedirectGuard, is_public
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.logs.remote_source import RemoteSource
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, LogError, UsageError
from tests.command_line import called
from tests.counting_server import CountingServer, Fault, cutting, serving, stalling, status

aiohttp = pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")


@pytest.fixture(scope="module")
def saloon():
    return Car.load("saloon")


@pytest.fixture(autouse=True)
def _impatient_and_alone(monkeypatch):
    monkeypatch.setattr(remote_source, "WAITS_S", (0.01, 0.02))
    for name in ("http_proxy", "HTTP_PROXY", "https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


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
def test_any_split_gives_the_same_bytes_and_none_twice(reads, order):
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


_CAMERA = ChannelRecord(-1, "/camera", "cdr", "sensor_msgs/msg/CompressedImage", "ros2msg", b"uint8[] data")
_SLICE_NS, _IMAGE_NS, _IMAGE_BYTES = 2_000_000_000, 200_000_000, 20_000


def with_camera(source: Path, target: Path) -> Path:
    """Copy an MCAP in chunks of 2 s, and behind each write as long a chunk of images."""
    noise, head = random.Random(1), b"\0\1\0\0" + _IMAGE_BYTES.to_bytes(4, "little")
    with source.open("rb") as file, McapLogWriter(target) as writer:
        camera, ids = writer.add_channel(_CAMERA), {}
        for _, rows in groupby(make_reader(file).iter_messages(), lambda row: row[2].log_time // _SLICE_NS):
            sensors = []
            for schema, channel, message in rows:
                if channel.id not in ids:
                    record = (channel.topic, "cdr", schema.name, schema.encoding, schema.data)
                    ids[channel.id] = writer.add_channel(ChannelRecord(-1, *record))
                at = message.log_time
                sensors.append(RawMessage(ids[channel.id], at, at, 0, message.data))
            start_ns = sensors[0].log_time_ns
            stamps = range(start_ns, start_ns + _SLICE_NS, _IMAGE_NS)
            images = [RawMessage(camera, at, at, 0, head + noise.randbytes(_IMAGE_BYTES)) for at in stamps]
            for chunk in (sensors, images):
                writer.write([], [block_of(chunk)])
    return target


def test_a_drive_apart_from_its_camera_costs_its_chunks_alone(tmp_path, sample_logs_dir, saloon):
    file = with_camera(sample_logs_dir / "dlc.mcap", tmp_path / "apart.mcap")
    with serving(**{file.name: file.read_bytes()}) as server:
        hashes = []
        for place in (_place(server, file.name), file):
            with read_drive(place, saloon) as drive:
                assert len(drive.whole().signals) > 900
                read = drive.recorded()
                hashes.append((read.signals_sha256, read.truth_sha256, drive.losses))
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
def test_a_damaged_log_loses_the_same(tmp_path, sample_logs_dir, spoil):
    file = tmp_path / "damaged.mcap"
    file.write_bytes(spoil((sample_logs_dir / "dlc.mcap").read_bytes()))
    with serving(**{file.name: file.read_bytes()}) as server:
        with closing(open_log(_place(server, file.name))) as log, closing(open_log(file)) as local:
            assert _all_of(log) == _all_of(local)
            assert local.lost
        assert server.twice() == 0


def test_other_formats_are_fetched_once_as_a_whole(tmp_path, sample_logs_dir):
    (database,) = (sample_logs_dir / "step_rosbag2").glob("*.db3")
    plain = (sample_logs_dir / "dlc.mcap").read_bytes()
    files = {"dlc.mcap.zst": zstandard.ZstdCompressor(1).compress(plain), "step.db3": database.read_bytes()}
    with serving(**files) as server:
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
            assert _read(_place(server, name)) == _read(tmp_path / name)
        assert server.twice() == 0


def test_a_server_without_ranges_gives_all_at_once(served, sample_logs_dir):
    served.ranges = False
    assert _read(_place(served, "dlc.mcap")) == _read(sample_logs_dir / "dlc.mcap")
    assert len(served.requests) == 1


def _copies() -> list[Path]:
    """Return the copies in the cache."""
    return sorted(Path(os.environ["PDHEF_CACHE_DIR"]).glob("remote/*/object/*"))


def test_a_later_command_fetches_no_byte_again(served, sample_logs_dir):
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


def test_copies_in_use_stay_and_the_others_are_removed(served, monkeypatch):
    served.files["again.mcap"] = served.files["dlc.mcap"]
    with closing(open_log(_place(served, "dlc.mcap"))):
        monkeypatch.setattr(remote_source, "CACHE_BYTES", 0)
        _read(_place(served, "again.mcap"))
        assert [path.name for path in _copies()] == ["dlc.mcap"]
    assert _copies() == []


def test_metadata_is_read_from_head_and_tail(sample_logs_dir):
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
def served(sample_logs_dir):
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
def test_faults_end_in_one_line(served, monkeypatch, fault, words, requests):
    served.fault = fault
    if words.startswith("silence"):
        monkeypatch.setattr(remote_source, "SILENCE_S", 0.2)
    assert words in str(_error(served))
    assert requests is None or len(served.requests) == requests


def test_a_server_that_is_busy_or_cuts_for_a_while_costs_time_only(served, sample_logs_dir):
    served.fault = status(503, times=2)
    assert _read(_place(served, "dlc.mcap")) == _read(sample_logs_dir / "dlc.mcap")
    served.files["again.mcap"] = served.files["dlc.mcap"]
    served.requests.clear()
    served.fault = cutting(30_000, times=2)
    assert _read(_place(served, "again.mcap")) == _read(sample_logs_dir / "dlc.mcap")


@pytest.mark.parametrize("without_headers", [(), ("ETag",), ("ETag", "Last-Modified")])
def test_a_changed_object_is_an_error(tmp_path, sample_logs_dir, without_headers):
    data = with_camera(sample_logs_dir / "dlc.mcap", tmp_path / "apart.mcap").read_bytes()
    with serving(**{"apart.mcap": data}) as server:
        server.without = frozenset(without_headers)
        with closing(open_log(_place(server, "apart.mcap"))) as log:
            server.files["apart.mcap"] = data[:-1000]
            with pytest.raises(SourceError, match=r"expected the object that was opened, got another one"):
                log.read({"/camera": ["data"]})
        with closing(open_log(_place(server, "apart.mcap"))) as log:  # the copy of the former object is not used again
            assert log.lost


def test_nobody_answers():
    with serving(x=b"") as server:
        gone = server.url
    with pytest.raises(SourceError, match="no connection"):
        open_log(f"{gone}/x.mcap")


def test_empty_and_other_content(served):
    served.files |= {"empty.mcap": b"", "page.html": b"<html>" * 1000}
    with pytest.raises(LogError, match="an empty file"):
        open_log(served.place("empty.mcap"))
    with pytest.raises(LogError, match="none of these"):
        open_log(served.place("page.html"))
    assert served.bytes_sent <= remote_source.BLOCK_BYTES


def test_no_room_is_said(served):
    resource = pytest.importorskip("resource", reason="limits the size of files")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        assert "set PDHEF_CACHE_DIR" in str(_error(served))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# -------------------------------------------------------------------------------------------- names and secrets


def test_nothing_secret_is_shown(served):
    secret = served.place("dlc.mcap").replace("http://", "http://me:hunter2@") + "?X-Amz-Signature=cafe&part=1"
    place = RemotePlace(secret)
    assert (str(place), place.parent) == (served.place("dlc.mcap"), served.url)
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


def test_identity_is_url_size_and_etag(served):
    (log,) = find_logs([served.place("dlc.mcap")])
    first = identity_of(log)
    assert len(served.requests) == 1
    assert identity_of(log) == first
    (signed,) = find_logs([served.place("dlc.mcap") + "?Signature=2"])
    assert identity_of(signed) == first
    served.files["dlc.mcap"] += b"x"
    assert identity_of(log) != first


def test_urls_lists_and_files_together(tmp_path, monkeypatch, sample_logs_dir):
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


def _redirecting(to: str, code: int = 302) -> Fault:
    return status(code, {"Location": to}, of="away.mcap")


def _named(monkeypatch: pytest.MonkeyPatch, **addresses: list[str]) -> None:
    """Make names of this test (``NAME.test``) resolve to addresses, the last for good."""

    async def resolve(_: object, host: str, port: int = 0, family: int = 0) -> list[dict[str, Any]]:
        of_name = addresses.get(host.lower().rstrip(".").removesuffix(".test"))
        if of_name is None:
            raise OSError(None, "no such host")
        address = of_name.pop(0) if len(of_name) > 1 else of_name[0]
        return [{"hostname": host, "host": address, "port": port, "family": socket.AF_INET, "proto": 0, "flags": 0}]

    monkeypatch.setattr(aiohttp.DefaultResolver, "resolve", resolve)


TARGETS = {
    "by its name": "http://localhost:{port}/dlc.mcap",
    "as a number": "http://2130706433:{port}/dlc.mcap",
    "in IPv6": "http://[::1]:{port}/dlc.mcap",
    "mapped to IPv6": "http://[::ffff:127.0.0.1]:{port}/dlc.mcap",
    "of a link": "http://169.254.169.254/latest/meta-data",
    "of a network": "http://10.0.0.1/dlc.mcap",
    "unspecified": "http://0.0.0.0:{port}/dlc.mcap",
}


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
@pytest.mark.parametrize("code", [302, 307])
def test_a_redirect_to_another_private_host_is_refused(served, target, code):
    served.fault = _redirecting(target.format(port=served.url.rpartition(":")[2]), code)
    place = RemotePlace(served.place("away.mcap"))
    for use in (open_log, lambda p: identity_of(LogInput(p, "x"))):
        with pytest.raises(LogError) as refused:
            use(place)
        assert "a redirect to " in refused.value.got
        assert "allow_private_redirects=true" in refused.value.remedy
        assert "\n" not in str(refused.value)
    assert {r.path for r in served.requests} == {"away.mcap"}, "nothing else was asked for"


def test_a_redirect_on_the_same_host_is_followed(served):
    served.fault = _redirecting("/dlc.mcap")
    with serving(**served.files) as other:
        for to in ("/dlc.mcap", served.place("dlc.mcap"), other.place("dlc.mcap")):
            served.fault = _redirecting(to)
            with closing(open_log(RemotePlace(f"{served.place('away.mcap')}?{len(to)}"))) as log:
                assert log.lost == ()


def test_an_option_allows_it(served, tmp_path):
    served.fault = _redirecting(served.place("dlc.mcap").replace("127.0.0.1", "localhost"))
    url = served.place("away.mcap")
    with (
        pytest.raises(LogError, match="a redirect to localhost, an address of this machine or its network"),
        read_drive(url, Car.load("saloon")),
    ):
        pass
    with read_drive(url, "saloon", options=ReadOptions(allow_private_redirects=True)) as drive:
        assert drive.losses == ()
    assert called("inspect", url, "--fields").returncode == EXIT_FAILURE
    assert called("inspect", url, "--fields", "--set", "allow_private_redirects=true").returncode == EXIT_OK
    (tmp_path / "pdhef.toml").write_text("allow_private_redirects = true\n")
    assert called("inspect", url, "--fields", cwd=tmp_path).returncode == EXIT_OK


def test_a_public_host_may_redirect_to_public_ones_alone(served, monkeypatch):
    monkeypatch.setattr("pdhef_logtool.logs.redirect_guard.is_public", lambda ip: ip.startswith("127."))
    port = served.url.rpartition(":")[2]
    _named(monkeypatch, one=["127.0.0.1"], two=["127.0.0.1"], inside=["10.0.0.1"])
    for name, followed in (("two", True), ("inside", False)):
        served.fault = _redirecting(f"http://{name}.test:{port}/dlc.mcap")
        place = RemotePlace(f"http://one.test:{port}/away.mcap?{name}")
        if followed:
            open_log(place).close()
        else:
            with pytest.raises(LogError, match=r"a redirect to inside\.test"):
                open_log(place)


def test_a_name_that_turns_private_is_not_connected_to(monkeypatch):
    _named(monkeypatch, origin=["8.8.8.8", "127.0.0.1"], other=["8.8.4.4", "10.0.0.1"], intranet=["10.1.1.1"])

    async def resolved() -> None:
        guard = RedirectGuard("origin.test")
        for name in ("origin.test", "other.test"):
            assert await guard.resolve(name)
            with pytest.raises(PrivateRedirectError):
                await guard.resolve(name)
        assert await RedirectGuard("intranet.test").resolve("Intranet.test.")
        monkeypatch.setenv("HTTPS_PROXY", "http://user:word@intranet.test:3128")
        assert await RedirectGuard("origin.test").resolve("intranet.test")

    asyncio.run(resolved())


PUBLIC = {
    "8.8.8.8": True, "2001:4860:4860::8888": True, "64:ff9b::808:808": True, "::ffff:8.8.8.8": True,
    "127.0.0.1": False, "10.1.2.3": False, "172.16.0.1": False, "192.168.1.1": False, "169.254.169.254": False,
    "100.64.0.1": False, "0.0.0.0": False, "224.0.1.1": False, "255.255.255.255": False, "240.0.0.1": False,
    "::1": False, "::": False, "fe80::1%eth0": False, "fd00::1": False, "::ffff:127.0.0.1": False,
    "::ffff:10.0.0.1": False, "64:ff9b::7f00:1": False, "2002:7f00:1::": False, "ff02::1": False,
}  # fmt: skip


@pytest.mark.parametrize("address", PUBLIC)
def test_which_addresses_are_public(address):
    assert is_public(address) is PUBLIC[address]
