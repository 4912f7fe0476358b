"""Format detection and rejected inputs. Opening a log writes no file next to it."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard

from pdhef_logtool.logs.container import Block
from pdhef_logtool.logs.open_log import is_log_folder, open_log
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.errors import EXIT_FAILURE, LogError
from tests.mcap_files import mcap_writer

T0 = 1_700_000_000_000_000_000
VALUES = np.arange(40) * 0.25


def _mcap(path: Path, values: np.ndarray = VALUES, start_ns: int = T0) -> Path:
    stamps = start_ns + np.arange(len(values)) * 10_000_000
    with McapLogWriter(path) as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu", constants={"header.frame_id": "imu"})
        writer.write([TopicBatch("/imu", stamps, stamps, {"angular_velocity.z": values})])
    return path


def _rosbag2(folder: Path, storage: str, *, compression: str | None = None) -> Path:
    """Write a rosbag2 folder with the writer of another project."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "geometry_msgs/msg/Vector3"
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/v", name, typestore=store)
        for i, value in enumerate(VALUES):
            message = store.types[name](x=float(value), y=0.0, z=0.0)
            writer.write(connection, T0 + i, store.serialize_cdr(message, name))
    return folder


def _values(path: Path, topic: str, field: str) -> np.ndarray:
    log = open_log(path)
    try:
        assert log.lost == ()
        return log.read({topic: [field]})[topic].fields[field]
    finally:
        log.close()


@pytest.mark.parametrize(
    ("content", "got"),
    [
        (b"", "empty file"),
        (b"time,ay\n0,1\n", "none of these"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n", "git lfs pull"),
        (b"\x89MCAP0\r\n", "header"),
        (b"#ROSBAG V2.0\n", "bag header"),
        (b"SQLite format 3\0", "."),
        (b"\x28\xb5\x2f\xfdgarbage", "."),
        (b"\x89MCAP0\r\n" + b"\xff" * 60, "."),
        (b"#ROSBAG V2.0\n" + b"\xff" * 60, "bag header"),
    ],
)
def test_what_is_no_log_is_one_clear_line(tmp_path: Path, content: bytes, got: str) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=got) as error:
        open_log(path)
    assert error.value.exit_code == EXIT_FAILURE
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".csv", ".vbo", ".asc", ".mat"])
def test_a_pointer_of_git_lfs_is_named_by_any_suffix(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n")
    with pytest.raises(LogError, match="git lfs pull"):
        open_log(path)


def test_a_database_without_the_tables_of_rosbag2_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE notes (text TEXT)")
    with pytest.raises(LogError, match="tables 'topics' and 'messages'"):
        open_log(path)


def test_missing_paths_and_folders_without_one_log_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "missing.mcap")
    with pytest.raises(LogError, match="folder without a log"):
        open_log(tmp_path)
    _mcap(tmp_path / "a.mcap")
    _mcap(tmp_path / "b.mcap")
    with pytest.raises(LogError, match="2 logs"):
        open_log(tmp_path)


@pytest.mark.parametrize(
    ("storage", "compression"), [("sqlite3", None), ("sqlite3", "FILE"), ("sqlite3", "MESSAGE"), ("mcap", None)]
)
def test_rosbag2_folders_of_another_writer_read_right(tmp_path: Path, storage: str, compression: str | None) -> None:
    folder = _rosbag2(tmp_path / "bag", storage, compression=compression)
    assert is_log_folder(folder)
    log = open_log(folder)
    assert log.kind == f"rosbag2-{storage}"
    log.close()
    np.testing.assert_array_equal(_values(folder, "/v", "x"), VALUES)


@pytest.mark.parametrize("name", ["a.mcap.zstd", "a.mcap.zst"])
def test_a_compressed_file_opens_and_a_cut_one_gives_its_beginning(tmp_path: Path, name: str) -> None:
    plain = _mcap(tmp_path / "a.mcap", np.random.default_rng(0).normal(size=20_000))
    compressed = zstandard.ZstdCompressor().compress(plain.read_bytes())
    path = tmp_path / name
    path.write_bytes(compressed)
    expected = _values(plain, "/imu", "angular_velocity.z")
    np.testing.assert_array_equal(_values(path, "/imu", "angular_velocity.z"), expected)
    path.write_bytes(compressed[: len(compressed) * 2 // 3])
    log = open_log(path)
    read = log.read({"/imu": ["angular_velocity.z"]})["/imu"].fields["angular_velocity.z"]
    assert 0 < len(read) < len(expected)
    np.testing.assert_array_equal(read, expected[: len(read)])
    assert any(loss.kind == "truncated" and str(path) == loss.where for loss in log.lost)
    log.close()


def test_a_split_folder_with_a_missing_file_says_so_and_reads_the_rest(tmp_path: Path, shared_dir: Path) -> None:
    folder = tmp_path / "split"
    shutil.copytree(shared_dir / "data/drives/faulty/revs_250lm_a_split", folder)
    for file in folder.iterdir():
        file.chmod(0o644)
    folder.chmod(0o755)
    (folder / "revs_250lm_a_split_1.mcap").unlink()
    log = open_log(folder)
    assert sum(t.messages for t in log.topics) == 39_999 + 40_001
    assert [(loss.kind, loss.severity) for loss in log.lost] == [("missing-file", "lost")]
    log.close()


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: 3", "- 1"])
def test_a_broken_metadata_file_is_one_clear_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=r"metadata\.yaml"):
        open_log(tmp_path)


def _database_with_pending_writes(folder: Path) -> Path:
    """Leave a database as a recorder that was killed leaves it: rows in the write-ahead log only."""
    source = _rosbag2(folder / "bag", "sqlite3") / "bag.db3"
    path = folder / "killed" / "killed.db3"
    path.parent.mkdir()
    live = folder / "live.db3"
    shutil.copyfile(source, live)
    db = sqlite3.connect(live)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA wal_autocheckpoint=0")
    db.execute(
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, ?, data FROM messages LIMIT 1", (T0 + 99,)
    )
    db.commit()
    shutil.copyfile(live, path)
    shutil.copyfile(live.with_name("live.db3-wal"), path.with_name("killed.db3-wal"))
    db.close()
    return path


def test_rows_in_a_write_ahead_log_are_read_and_nothing_is_written_beside(tmp_path: Path) -> None:
    path = _database_with_pending_writes(tmp_path)
    before = {p.name: p.read_bytes() for p in path.parent.iterdir()}
    assert len(_values(path, "/v", "x")) == len(VALUES) + 1
    assert {p.name: p.read_bytes() for p in path.parent.iterdir()} == before


def test_a_chunk_costs_the_same_however_many_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with mcap_writer(tmp_path / "many.mcap", chunk_size=1) as writer:
        channel = writer.register_channel("/a", "json", 0)
        for i in range(300):
            writer.add_message(channel, i, b'{"x": 1.0}', i)
    asked = 0

    def nbytes(block: Block) -> int:
        nonlocal asked
        asked += 1
        return len(block.buffer)

    monkeypatch.setattr(Block, "nbytes", property(nbytes))
    with closing(open_log(tmp_path / "many.mcap")) as log:
        assert len(log.read({"/a": ["x"]})["/a"].fields["x"]) == 300
    assert 300 <= asked <= 2 * 300
