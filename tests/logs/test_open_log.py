"""Format detection and rejected inputs. Opening a log writes no file next to it."""

import importlib
import math
import re
import shutil
import sqlite3
import sys
from collections import Counter
from contextlib import closing
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Message, Statistics
from mcap.stream_reader import StreamReader
from recorded import T0, write_imu, write_vectors

from pdhef_logtool import Car, inspect_log, load_mapping, read_drive
from pdhef_logtool.logs import formats, mcap_log
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.logs.mat_log import open_mat
from pdhef_logtool.logs.mdf_log import open_mdf
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, Meter
from pdhef_logtool.logs.table_file import LogFile, TableFile
from pdhef_logtool.logs.table_log import Table, TableLog
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import EXIT_FAILURE, LogError, UsageError
from studies import mcap_logs
from tests.plug_in import install

VALUES = np.arange(40) * 0.25


def _values(path: Path, topic: str, field: str) -> np.ndarray:
    with closing(open_log(path)) as log:
        assert log.lost == ()
        return log.read({topic: [field]})[topic].fields[field]


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n"


@pytest.mark.parametrize(
    ("content", "got", "suffix"),
    [
        *((LFS, "git lfs pull", suffix) for suffix in (".mcap", ".csv", ".vbo", ".asc", ".mat")),
        (b"", "empty file", ".mcap"),
        (b"time,ay\n0,1\n", "none of these", ".mcap"),
        (b"\x89MCAP0\r\n", "header", ".mcap"),
        (b"#ROSBAG V2.0\n", "bag header", ".mcap"),
        (b"SQLite format 3\0", ".", ".mcap"),
        (b"\x28\xb5\x2f\xfdgarbage", ".", ".mcap"),
        (b"\x89MCAP0\r\n" + b"\xff" * 60, ".", ".mcap"),
        (b"#ROSBAG V2.0\n" + b"\xff" * 60, "bag header", ".mcap"),
    ],
)
def test_what_is_no_log_is_one_clear_line(tmp_path, content, got, suffix):
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(content)
    with pytest.raises(LogError, match=got) as error:
        open_log(path)
    assert error.value.exit_code == EXIT_FAILURE
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_paths_folders_without_one_log_and_other_databases_are_refused(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "missing.mcap")
    with pytest.raises(LogError, match="folder without a log"):
        open_log(tmp_path)
    write_imu(tmp_path / "a.mcap", VALUES)
    write_imu(tmp_path / "b.mcap", VALUES)
    with pytest.raises(LogError, match="2 logs"):
        open_log(tmp_path)
    with sqlite3.connect(tmp_path / "notes.db3") as db:
        db.execute("CREATE TABLE notes (text TEXT)")
    with pytest.raises(LogError, match="tables 'topics' and 'messages'"):
        open_log(tmp_path / "notes.db3")


@pytest.mark.parametrize(
    ("storage", "compression"), [("sqlite3", ""), ("sqlite3", "FILE"), ("sqlite3", "MESSAGE"), ("mcap", "")]
)
def test_rosbag2_folders_of_another_writer_read_right(tmp_path, storage, compression):
    folder = write_vectors(tmp_path / "bag", "/v", len(VALUES), storage, compression)
    with closing(open_log(folder)) as log:
        assert log.kind == f"rosbag2-{storage}"
    np.testing.assert_array_equal(_values(folder, "/v", "x"), VALUES)


@pytest.mark.parametrize("name", ["a.mcap.zstd", "a.mcap.zst"])
def test_a_compressed_file_opens_and_a_cut_one_gives_its_beginning(tmp_path, name):
    plain = write_imu(tmp_path / "a.mcap", np.random.default_rng(0).normal(size=20_000))
    compressed = zstandard.ZstdCompressor().compress(plain.read_bytes())
    path = tmp_path / name
    path.write_bytes(compressed)
    expected = _values(plain, "/imu", "angular_velocity.z")
    np.testing.assert_array_equal(_values(path, "/imu", "angular_velocity.z"), expected)
    path.write_bytes(compressed[: len(compressed) * 2 // 3])
    with closing(open_log(path)) as log:
        read = log.read({"/imu": ["angular_velocity.z"]})["/imu"].fields["angular_velocity.z"]
        assert 0 < len(read) < len(expected)
        np.testing.assert_array_equal(read, expected[: len(read)])
        assert any(loss.kind == "truncated" and str(path) == loss.where for loss in log.lost)


def test_a_split_folder_with_a_missing_file_says_so_and_reads_the_rest(tmp_path, shared_dir):
    folder = tmp_path / "split"
    shutil.copytree(shared_dir / "data/drives/faulty/revs_250lm_a_split", folder)
    for file in folder.iterdir():
        file.chmod(0o644)
    folder.chmod(0o755)
    (folder / "revs_250lm_a_split_1.mcap").unlink()
    with closing(open_log(folder)) as log:
        assert sum(t.messages for t in log.topics) == 39_999 + 40_001
        assert [(loss.kind, loss.severity) for loss in log.lost] == [("missing-file", "lost")]


@pytest.mark.parametrize("text", ["", "a: [", "rosbag2_bagfile_information: 3", "- 1"])
def test_a_broken_metadata_file_is_one_clear_line(tmp_path, text):
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(LogError, match=r"metadata\.yaml"):
        open_log(tmp_path)


def _database_with_pending_writes(folder: Path) -> Path:
    """Leave a database as a recorder that was killed leaves it: rows in the write-ahead log only."""
    source = write_vectors(folder / "bag", "/v", len(VALUES)) / "bag.db3"
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


def test_rows_in_a_write_ahead_log_are_read_and_nothing_is_written_beside(tmp_path):
    path = _database_with_pending_writes(tmp_path)
    before = {p.name: p.read_bytes() for p in path.parent.iterdir()}
    assert len(_values(path, "/v", "x")) == len(VALUES) + 1
    assert {p.name: p.read_bytes() for p in path.parent.iterdir()} == before


# ---- a command decompresses each chunk of a log once, whatever else the chunks contain ----

#: A JSON payload that is larger than the cached part of a chunk.
LARGE = b'{"size": %d, "pixels": "' + b"x" * 20_000 + b'"}'


@pytest.fixture
def mixed(sample_logs_dir, tmp_path):
    """A drive with an image after every 50th message, in the same chunks."""

    def with_images():
        for i, message in enumerate(mcap_logs.messages(sample_logs_dir / "dlc.mcap")):
            yield message
            if i % 50 == 0:
                yield message._replace(topic="/camera", data=LARGE % i, encoding="json", schema=("", "", b""))

    return mcap_logs.write_log(tmp_path / "mixed.mcap", with_images(), "ros2", chunk_size=400_000)


def test_an_inspection_decompresses_each_chunk_once(mixed, monkeypatch):
    opened: Counter[bytes] = Counter()
    decompress = mcap_log.decompress

    def counted(compression: str, stored: memoryview, *rest: object) -> bytes:
        opened[bytes(stored[:4000])] += 1
        return decompress(compression, stored, *rest)

    monkeypatch.setattr(mcap_log, "decompress", counted)
    inspection = inspect_log(mixed)
    assert inspection.signals
    assert len(opened) > 3
    # One more time for the example message of a topic without a schema.
    assert sorted(opened.values())[-2:] in ([1, 1], [1, 2])


def test_sums_times_and_numbers_of_messages_are_those_of_the_file(tmp_path):
    with McapLogWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/v", "std_msgs/msg/Float64")
        for times in np.arange(12).reshape(3, 4):
            writer.write([Columns("/v", times, times, {"data": np.zeros(4)})])
    with (tmp_path / "a.mcap").open("rb") as file:
        records = [*StreamReader(file, validate_crcs=True).records]
    assert [r.sequence for r in records if isinstance(r, Message)] == [*range(12)]
    assert [(r.message_start_time, r.message_end_time) for r in records if isinstance(r, Statistics)] == [(0, 11)]


G_M_S2 = 9.80665
TOPICS = {
    "imu": {
        "lateral_acceleration [g]": ("ay_m_s2", 1 / G_M_S2),
        "longitudinal_acceleration [m/s²]": ("ax_m_s2", 1.0),
        "yaw_rate [°/s]": ("yaw_rate_rad_s", math.degrees(1.0)),
    },
    "esp": {
        "road_wheel_angle [deg]": ("steer_rad", math.degrees(1.0)),
        **{f"wheel_speed_{w} [km/h]": (f"wheel_speed_{w}_m_s", 3.6) for w in ("fl", "fr", "rl", "rr")},
    },
}
MAPPING = """
[signals]
ax_m_s2 = {topic = "imu", field = "longitudinal_acceleration"}
ay_m_s2 = {topic = "imu", field = "lateral_acceleration", scale = 9.80665}
yaw_rate_rad_s = {topic = "imu", field = "yaw_rate", scale = 0.017453292519943295}
"""


@pytest.fixture
def _installed(tmp_path_factory, monkeypatch):
    """Install a package that adds the format: a module and an entry point."""
    folder = tmp_path_factory.mktemp("package")
    code = Path(__file__).with_name("npz_log.py").read_text()
    monkeypatch.syspath_prepend(str(install(folder, code, "npz_log", "pdhef.log_formats", "FORMAT")))
    importlib.invalidate_caches()
    formats.formats_of_other_packages.cache_clear()
    yield
    formats.formats_of_other_packages.cache_clear()


@pytest.fixture(scope="module")
def npz(sample_logs_dir, tmp_path_factory):
    """Return a log of the format: the signals of a sample log, steering and wheels at half of the IMU's rate."""
    columns: dict[str, np.ndarray] = {}
    with read_drive(sample_logs_dir / "dlc.mcap", Car.load("saloon")) as drive:
        signals = drive.whole().signals
        wheels = {f"wheel_speed_{w}_m_s": signals.speed_m_s for w in ("fl", "fr", "rl", "rr")}
        for topic, fields in TOPICS.items():
            rows = slice(10, -10, 1 if topic == "imu" else 2)  # the speed is known there
            columns[f"{topic}/t [s]"] = signals.stamps_ns[rows] * 1e-9
            for name, (signal, scale) in fields.items():
                values = wheels[signal] if signal in wheels else getattr(signals, signal)
                columns[f"{topic}/{name}"] = values[rows] * scale
    path = tmp_path_factory.mktemp("logs") / "drive.npz"
    np.savez(path, **columns)
    return path


@pytest.mark.usefixtures("_installed")
def test_an_inspection_shows_tables_and_their_units(npz):
    found = inspect_log(npz)
    assert found.kind == "npz"
    assert [(t.name, t.encoding, round(t.rate_hz)) for t in found.topics] == [("esp", "npz", 50), ("imu", "npz", 100)]
    taken = {name: report.topic for name, report in found.signals.items()}
    assert taken == {signal: topic for topic, fields in TOPICS.items() for signal, _ in fields.values()}
    with read_drive(npz, Car.load("saloon")) as drive:
        scales = {s.name: s.scale for s in drive.mapping.sources()}
    assert scales == pytest.approx({s: 1 / scale for f in TOPICS.values() for s, scale in f.values()})
    assert found.lost == ()


@pytest.mark.usefixtures("_installed")
def test_a_compressed_file_and_a_folder_of_one_file_are_read_too(npz, tmp_path):
    (tmp_path / "drive.npz.zst").write_bytes(zstandard.compress(npz.read_bytes()))
    expected = open_log(npz).read({"imu": ["yaw_rate"]})["imu"]
    for place in (tmp_path / "drive.npz.zst", tmp_path):
        with closing(open_log(place)) as log:
            found = log.read({"imu": ["yaw_rate"]})["imu"]
            np.testing.assert_array_equal(found.fields["yaw_rate"], expected.fields["yaw_rate"])


def test_a_table_has_ascending_times_and_tables_have_different_names(npz):
    stamps_ns, file = np.arange(5) * 10, LogFile(npz, npz, Meter())
    good, descending = (Table.of_arrays("t", stamps, {"x": np.arange(5.0)}, {}) for stamps in (stamps_ns, -stamps_ns))
    for tables, match in (([descending], "ascending times"), ([good, good], "different names")):
        with pytest.raises(LogError, match=match):
            TableLog(file, "toy", tables)


@pytest.mark.usefixtures("_installed")
def test_a_search_takes_files_of_the_format_and_a_mapping_file_names_their_columns(npz, tmp_path):
    assert [log.path for log in find_logs([str(npz.parent)])] == [npz]
    (tmp_path / "m.toml").write_text(MAPPING)
    with read_drive(npz, Car.load("saloon"), load_mapping(tmp_path / "m.toml")) as drive:
        assert drive.available >= {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"}


@pytest.mark.parametrize(
    ("module", "reader", "head"),
    [("asammdf", open_mdf, b"MDF     4.10    "), ("h5py", open_mat, b"MATLAB 7.3 MAT-file")],
)
def test_a_missing_extra_is_a_usage_error_with_the_command(module, reader, head, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=re.escape("pip install 'pdhef-logtool[formats]'")):
        reader(TableFile(BytesIO(head + bytes(100)), len(head) + 100, "a", DEFAULT_LIMITS))
