"""Logs in an S3 store: moto's server on this machine."""

from contextlib import closing

import pytest

from pdhef_logtool.logs.byte_source import SourceError
from pdhef_logtool.logs.discovery import find_logs, folders_of, identity_of
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import UsageError
from tests.counting_server import empty_cache
from tests.s3_store import s3_store

pytestmark = pytest.mark.slow


@pytest.fixture
def store():
    with s3_store() as empty:
        yield empty


def test_a_prefix_is_searched_like_a_folder(store):
    keys = ["day/b.mcap", "day/car/a.bag.zst", "day/notes.txt", "day/.old/c.mcap", "day/run/run.json", "day/run/d.mcap"]
    for key in [*keys, "other/e.mcap"]:
        store.put(key, b"x")
    found = find_logs([f"{store.url}/day/"])
    assert [str(i.path) for i in found] == [f"{store.url}/day/b.mcap", f"{store.url}/day/car/a.bag.zst"]
    assert [i.stem for i in found] == ["b", "car__a"]
    assert folders_of(found) == ["", "car"]
    assert len(find_logs([store.url])) == 3
    with pytest.raises(UsageError, match="at least one log"):
        find_logs([f"{store.url}/none/"])
    with pytest.raises(SourceError, match="no such"):
        find_logs(["s3://bikes/"])


def test_same_log_and_a_changed_one(store, sample_logs_dir):
    file = sample_logs_dir / "road.mcap"
    store.put("a b/dlc+1.mcap", file.read_bytes())
    url = f"{store.url}/a b/dlc+1.mcap"
    asked = {"/imu/data": ["angular_velocity.z"]}
    with closing(open_log(file)) as local, closing(open_log(url)) as there:
        (a,), (b,) = local.read(asked).values(), there.read(asked).values()
        assert a.fields["angular_velocity.z"].tobytes() == b.fields["angular_velocity.z"].tobytes()
        assert local.topics == there.topics
    (log,) = find_logs([url])
    known = identity_of(log)
    with empty_cache():
        opened = open_log(url)
    assert identity_of(log) == known
    store.put("a b/dlc+1.mcap", file.read_bytes()[:-1])
    with pytest.raises(SourceError, match="another one"):
        opened.read(asked)
    opened.close()
    assert identity_of(log) != known
