"""Full copies: every message, attachment and metadata record of the source, in log-time order."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
from recorded import decoded_by_rosbags

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels, source_profile
from pdhef_logtool.logs.writer import McapLogWriter

pytestmark = pytest.mark.slow

T0 = 1_700_000_000_000_000_000


def _copy(source: Path, target: Path) -> None:
    log = open_log(source)
    with McapLogWriter(target, profile=source_profile(log)) as writer:
        channels = register_channels(writer, log)
        writer.write([], iterate_copy(log, channels))
        for a in log.attachments():
            writer.attachment(a)
        for m in log.metadata_records():
            writer.metadata(m.name, m.metadata)
    log.close()


def _content(path: Path) -> list[tuple[object, ...]]:
    """Everything about every message through another reader, in log-time order."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return [
            (
                m.log_time,
                c.topic,
                c.message_encoding,
                tuple(sorted(c.metadata.items())),
                (s.name, s.encoding, s.data) if s else None,
                m.publish_time,
                m.sequence,
                m.data,
            )
            for s, c, m in make_reader(file, validate_crcs=True).iter_messages()
        ]


@pytest.mark.parametrize(
    "name",
    [
        "data/drives/comma2k19_segment.mcap",
        "data/drives/faulty/revs_250lm_a_disorder.mcap",
        "reader_corpus/plotjuggler_pj-mcap-server/test_unsupported_encoding.mcap",
        "reader_corpus/rerun/foxglove_log.mcap",
    ],
)
def test_copies_of_recordings_equal_their_sources(shared_dir: Path, tmp_path: Path, name: str) -> None:
    _copy(shared_dir / name, tmp_path / "copy.mcap")
    copied, original = _content(tmp_path / "copy.mcap"), _content(shared_dir / name)
    assert len(copied) == len(original)
    assert [m[0] for m in copied] == [m[0] for m in original]
    # The other reader leaves the order of equal log times open.
    assert Counter(copied) == Counter(original)


def test_a_database_copy_keeps_bytes_and_definitions(shared_dir: Path, tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    source = shared_dir / "data/drives/lunda_v40"
    _copy(source, tmp_path / "copy.mcap")
    with AnyReader([source]) as reader:
        expected = [(stamp, c.topic, c.msgtype, bytes(data)) for c, stamp, data in reader.messages()]
    copied = [(m[0], m[1], m[4][0], m[7]) for m in _content(tmp_path / "copy.mcap")]  # type: ignore[index]
    assert sorted(copied) == sorted(expected)
    assert len(decoded_by_rosbags([tmp_path / "copy.mcap"])["/vbox/slip"]) == 2396


@pytest.mark.parametrize(
    "name", ["reader_corpus/plotjuggler/tilt_laser.bag", "reader_corpus/foxglove_rosbag1/example-bz2.bag"]
)
def test_a_copy_of_a_bag_keeps_its_messages(shared_dir: Path, tmp_path: Path, name: str) -> None:
    from rosbags.highlevel import AnyReader

    _copy(shared_dir / name, tmp_path / "copy.mcap")
    with AnyReader([shared_dir / name]) as reader:
        expected = [(stamp, c.topic, bytes(data)) for c, stamp, data in reader.messages()]
    assert sorted((m[0], m[1], m[7]) for m in _content(tmp_path / "copy.mcap")) == sorted(expected)
    with closing(open_log(shared_dir / name)) as bag, closing(open_log(tmp_path / "copy.mcap")) as copy:
        assert copy.topics == bag.topics
        assert {t.encoding for t in copy.topics} == {"ros1"}
        assert [copy.fields(t.name) for t in copy.topics] == [bag.fields(t.name) for t in bag.topics]
