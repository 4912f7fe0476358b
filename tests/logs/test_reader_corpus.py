"""Every recording of the corpus, written by other tools, ends as its catalogue says."""

from __future__ import annotations

import contextlib
import json
from contextlib import closing
from pathlib import Path

import pytest
from recorded import counts_of, numeric_paths

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import LogError, MappingError

pytestmark = pytest.mark.slow

# Their test fixtures carry a definition that is not the one the payloads were written with, or align a double to 4.
_WRONG_DEFINITIONS = {
    ("ros2_rosbag2/rosbag2_py/test/resources/sqlite3/talker/talker.db3", "/rosout"),
    ("plotjuggler_pj-mcap-server/test_embedded_timestamp.mcap", "/stamped/value"),
}
# A schema that is no definition, and protobuf messages with the text of a .proto file in the place of descriptors.
_UNDECODABLE = {"/bad/data", "/proto/data"}


def _field_problems(log: DriveLog, file: str) -> list[str]:
    problems = []
    for topic in log.topics:
        if topic.encoding not in ("cdr", "ros1", "json", "protobuf") or topic.name in _UNDECODABLE:
            continue
        paths = numeric_paths(log, topic.name)
        columns = log.read({topic.name: paths})[topic.name]
        if len(columns) != topic.messages:
            problems.append(f"{file} {topic.name}: {len(columns)} of {topic.messages}")
    problems += [
        f"{file}: {loss.where}: {loss.what}"
        for loss in log.lost
        if loss.kind == "undecodable" and (file, loss.where) not in _WRONG_DEFINITIONS
    ]
    return problems


def test_every_recording_ends_as_catalogued_and_every_field_decodes(shared_dir: Path) -> None:
    root = shared_dir / "reader_corpus"
    catalogue = json.loads((root / "CATALOG.json").read_text())
    problems: list[str] = []
    for entry in catalogue:
        outcome, counts = "must-be-rejected", entry["messages"]
        with contextlib.suppress(LogError), closing(open_log(root / entry["file"])) as log:
            counts = counts_of(log)
            assert counts == {t.name: t.messages for t in log.topics}
            outcome = "truncated" if any(loss.severity == "lost" for loss in log.lost) else "ok"
            problems += _field_problems(log, entry["file"])
        if (outcome, counts) != (entry["expected"], entry["messages"]):
            problems.append(f"{entry['file']}: expected {entry['expected']}, got {outcome} with {counts}")
    assert len(catalogue) > 700
    assert not problems, "\n".join(problems)


def test_a_database_that_its_folder_declares_in_another_format_is_not_decoded_as_cdr(shared_dir: Path) -> None:
    folder = shared_dir / "reader_corpus" / "ros2_rosbag2/rosbag2_tests/resources/sqlite3/wrong_rmw_test"
    with closing(open_log(folder)) as log:
        assert {t.encoding for t in log.topics} == {"wrong_format"}
        with pytest.raises(MappingError, match="wrong_format"):
            log.read({"/test_topic": ["bool_value"]})


def test_definitions_behind_a_short_separator_are_read(shared_dir: Path) -> None:
    with closing(
        open_log(shared_dir / "reader_corpus" / "plotjuggler_pj-mcap-server/test_embedded_timestamp.mcap")
    ) as log:
        assert {"header.sec", "header.nanosec", "value"} <= {f.path for f in log.fields("/stamped/value")}
