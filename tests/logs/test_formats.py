"""A table format from a separate package: with one module and one entry point, every command reads it."""

from __future__ import annotations

import importlib
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import Car, inspect_log, read_drive
from pdhef_logtool.logs import formats
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.mat_log import open_mat
from pdhef_logtool.logs.mdf_log import open_mdf
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, Meter
from pdhef_logtool.logs.table_file import LogFile, TableFile, Tables
from pdhef_logtool.logs.table_log import Table, TableLog
from pdhef_logtool.records.errors import LogError, PdhefError, UsageError

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
[signals.ax_m_s2]
topic = "imu"
field = "longitudinal_acceleration"
[signals.ay_m_s2]
topic = "imu"
field = "lateral_acceleration"
scale = 9.80665
[signals.yaw_rate_rad_s]
topic = "imu"
field = "yaw_rate"
scale = 0.017453292519943295
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an installed package that adds the format: a module and an entry point."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copy(Path(__file__).with_name("npz_log.py"), folder)
    about = folder / "npz_log-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: npz-log\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[pdhef.log_formats]\nnpz = npz_log:FORMAT\n")
    return folder


@pytest.fixture
def _installed(package: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(package))
    importlib.invalidate_caches()
    formats.formats_of_other_packages.cache_clear()
    yield
    formats.formats_of_other_packages.cache_clear()


@pytest.fixture(scope="module")
def npz(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log of the format: the signals of a sample log, steering and wheels at half of the IMU's rate."""
    columns: dict[str, np.ndarray] = {}  # type: ignore[type-arg]
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
def test_an_inspection_shows_tables_and_their_units(npz: Path) -> None:
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
def test_a_compressed_file_and_a_folder_of_one_file_are_read_too(npz: Path, tmp_path: Path) -> None:
    import zstandard

    (tmp_path / "drive.npz.zst").write_bytes(zstandard.compress(npz.read_bytes()))
    expected = open_log(npz).read({"imu": ["yaw_rate"]})["imu"]
    for place in (tmp_path / "drive.npz.zst", tmp_path):
        with closing(open_log(place)) as log:
            found = log.read({"imu": ["yaw_rate"]})["imu"]
            np.testing.assert_array_equal(found.fields["yaw_rate"], expected.fields["yaw_rate"])


def test_a_table_has_ascending_times_and_tables_have_different_names(npz: Path) -> None:
    stamps_ns, file = np.arange(5) * 10, LogFile(npz, npz, Meter())
    good, descending = (Table.of_arrays("t", stamps, {"x": np.arange(5.0)}, {}) for stamps in (stamps_ns, -stamps_ns))
    for tables, match in (([descending], "ascending times"), ([good, good], "different names")):
        with pytest.raises(LogError, match=match):
            TableLog(file, "toy", tables)


def test_the_message_for_an_unknown_file_lists_the_formats(tmp_path: Path) -> None:
    (tmp_path / "drive.npz").write_bytes(b"PK\x03\x04")
    titles = ", ".join(f.title for f in formats.FORMATS)
    with pytest.raises(PdhefError, match=f"expected {titles} or a rosbag2 folder"):
        open_log(tmp_path / "drive.npz")


@pytest.mark.usefixtures("_installed")
def test_a_search_takes_files_of_the_format_and_a_mapping_file_names_their_columns(npz: Path, tmp_path: Path) -> None:
    assert [log.path for log in find_logs([str(npz.parent)])] == [npz]
    (tmp_path / "m.toml").write_text(MAPPING)
    from pdhef_logtool import load_mapping

    with read_drive(npz, Car.load("saloon"), load_mapping(tmp_path / "m.toml")) as drive:
        assert drive.available >= {"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"}


@pytest.mark.parametrize(
    ("module", "reader", "head"),
    [("asammdf", open_mdf, b"MDF     4.10    "), ("h5py", open_mat, b"MATLAB 7.3 MAT-file")],
)
def test_a_missing_extra_is_a_usage_error_with_the_command(
    module: str, reader: Callable[[TableFile], Tables], head: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=re.escape("pip install 'pdhef-logtool[formats]'")):
        reader(TableFile(BytesIO(head + bytes(100)), len(head) + 100, "a", DEFAULT_LIMITS))
