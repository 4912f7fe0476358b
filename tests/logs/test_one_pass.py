"""A command decompresses each chunk of a log once, whatever else the chunks contain."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import inspect_log
from pdhef_logtool.logs import mcap_log
from pdhef_logtool.logs.open_log import open_log
from tests.mcap_files import copied, mcap_writer

#: A JSON payload that is larger than the cached part of a chunk.
LARGE = b'{"size": %d, "pixels": "' + b"x" * 20_000 + b'"}'


@pytest.fixture
def mixed(sample_logs_dir: Path, tmp_path: Path) -> Path:
    """A drive with an image after every 50th message, in the same chunks."""
    path = tmp_path / "mixed.mcap"
    with mcap_writer(path, profile="ros2", chunk_size=400_000) as writer:
        image = writer.register_channel("/camera", "json", 0)
        for i, message in enumerate(copied(sample_logs_dir / "dlc.mcap", writer)):
            if i % 50 == 0:
                writer.add_message(image, message.log_time, LARGE % i, message.publish_time)
    return path


def test_an_inspection_decompresses_each_chunk_once(mixed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: Counter[bytes] = Counter()
    decompress = mcap_log.decompress

    def counted(compression: str, stored: memoryview, *rest: object) -> bytes:
        opened[bytes(stored[:4000])] += 1
        return decompress(compression, stored, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(mcap_log, "decompress", counted)
    inspection = inspect_log(mixed)
    assert inspection.signals
    assert len(opened) > 3
    # One more time for the example message of a topic without a schema.
    assert sorted(opened.values())[-2:] in ([1, 1], [1, 2])


def test_large_payloads_are_read_again_when_they_are_requested(mixed: Path) -> None:
    with closing(open_log(mixed)) as log:
        small = next(t.name for t in log.topics if t.name != "/camera" and log.fields(t.name))
        path = next(f.path for f in log.fields(small) if f.kind == "number")
        before = log.read({small: [path]}, stamps=["/camera"])
        images = log.read({"/camera": ["size"]})["/camera"]
        after = log.read({small: [path]})[small]
    np.testing.assert_array_equal(images.fields["size"], np.arange(len(images)) * 50)
    np.testing.assert_array_equal(before["/camera"].log_time_ns, images.log_time_ns)
    np.testing.assert_array_equal(before[small].fields[path], after.fields[path])


def test_expected_fields_are_those_of_a_plain_read(mixed: Path) -> None:
    with closing(open_log(mixed)) as log, closing(open_log(mixed)) as plain:
        requests = {t.name: [f.path for f in log.fields(t.name) if f.kind == "number"][:3] for t in log.topics}
        requests = {topic: paths for topic, paths in requests.items() if paths}
        log.expect({topic: paths[:1] for topic, paths in requests.items()})
        middle = (log.start_ns + log.end_ns) // 2
        for window in ((log.start_ns, middle), (middle, log.end_ns), (None, None)):
            for fields in ({t: p[:1] for t, p in requests.items()}, requests):
                kept, read = log.read(fields, *window), plain.read(fields, *window)
                for topic, columns in read.items():
                    np.testing.assert_array_equal(kept[topic].log_time_ns, columns.log_time_ns)
                    for path, values in columns.fields.items():
                        np.testing.assert_array_equal(kept[topic].fields[path], values)
