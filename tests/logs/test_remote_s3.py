"""Logs in an S3 store: moto's server on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("s3fs", reason="reads s3://: pip install 'pdhef-logtool[s3]'")
pytest.importorskip("moto.server", reason="stands for S3: pip install 'moto[server]'")

from pdhef_logtool.logs import remote_objects, remote_source
from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.container import Wanted
from pdhef_logtool.logs.discovery import find_logs, folders_of, identity_of
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import UsageError


@pytest.fixture(scope="module")
def store() -> Iterator[object]:
    """A client of an empty store, to which the environment points."""
    import botocore.session
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name, value in (("ACCESS_KEY_ID", "key"), ("SECRET_ACCESS_KEY", "hidden"), ("DEFAULT_REGION", "us-east-1")):
            patch.setenv(f"AWS_{name}", value)
        patch.setattr(remote_objects, "PATIENCE", remote_objects.Patience(2.0, 2.0, 2, 0.01, 0.02))
        client = botocore.session.get_session().create_client("s3")
        client.create_bucket(Bucket="cars")
        yield client
        for spool in list(remote_source._spools.values()):
            assert spool.users == 0, "a source was not closed"
            remote_source._forget(spool)
    server.stop()


def test_a_prefix_is_searched_like_a_folder(store) -> None:
    keys = ["day/b.mcap", "day/car/a.bag.zst", "day/notes.txt", "day/.old/c.mcap", "day/run/run.json", "day/run/d.mcap"]
    for key in [*keys, "other/e.mcap"]:
        store.put_object(Bucket="cars", Key=key, Body=b"x")
    found = find_logs(["s3://cars/day/"])
    assert [str(i.path) for i in found] == ["s3://cars/day/b.mcap", "s3://cars/day/car/a.bag.zst"]
    assert [i.stem for i in found] == ["b", "car__a"]
    assert folders_of(found) == ["", "car"]
    assert len(find_logs(["s3://cars"])) == 3
    with pytest.raises(UsageError, match="at least one log"):
        find_logs(["s3://cars/none/"])
    with pytest.raises(SourceError, match="no such"):
        find_logs(["s3://bikes/"])


def test_same_log_and_a_changed_one(store, sample_logs_dir: Path) -> None:
    file = sample_logs_dir / "dlc.mcap"
    store.put_object(Bucket="cars", Key="a b/dlc+1.mcap", Body=file.read_bytes())
    url = "s3://cars/a b/dlc+1.mcap"
    asked = {"/imu/data": ["angular_velocity.z"]}
    local, first = open_log(file), open_log(url, wanted=Wanted(frozenset()))
    there = open_log(url, wanted=Wanted(frozenset(asked)))
    first.close()
    (a,), (b,) = local.read(asked).values(), there.read(asked).values()
    assert a.fields["angular_velocity.z"].tobytes() == b.fields["angular_velocity.z"].tobytes()
    assert local.topics == there.topics
    there.close()
    local.close()
    (log,) = find_logs([url])
    known = identity_of(log)
    opened = open_log(url, wanted=Wanted(frozenset()))
    assert identity_of(log) == known
    store.put_object(Bucket="cars", Key="a b/dlc+1.mcap", Body=file.read_bytes()[:-1])
    # Read bytes are held until they are wanted elsewhere: without them the store is asked again. Other tests of this
    # process may have left sources of their own.
    remote_source._spools[log.path].held = []
    with pytest.raises(SourceError, match="another one"):
        opened.read(asked)
    opened.close()
    assert identity_of(log) != known


def test_no_such_object_and_an_empty_one(store) -> None:
    with pytest.raises(SourceError, match="no such object") as raised:
        open_log("s3://cars/none.mcap")
    assert "hidden" not in str(raised.value)
    store.put_object(Bucket="cars", Key="empty.mcap", Body=b"")
    with pytest.raises(Exception, match="an empty file"):
        open_log("s3://cars/empty.mcap")
