"""JSON lines, tables without times, folders of one recording, and files of several runs."""

from __future__ import annotations

import dataclasses
import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError
from pdhef_logtool.logs.table_file import TableFile, TableSettings
from pdhef_logtool.logs.text_logs import open_json_lines
from pdhef_logtool.mapping.choosing import tables_for
from pdhef_logtool.mapping.mapping_file import load_mapping, mapping_to_toml
from pdhef_logtool.records.errors import LogError, MappingFileError

START_S = 1_714_564_800


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def _columns(log: DriveLog, topic: str) -> dict[str, Any]:
    return log.read({topic: [f.path for f in log.fields(topic)]})[topic].fields


# ------------------------------------------------------------------------------------------------ JSON lines


def _json_lines(path: Path, *records: object) -> Path:
    return _write(path, "".join(f"{json.dumps(record)}\n" for record in records))


def test_wide_json_lines_are_columns_with_exact_integers(tmp_path: Path) -> None:
    first_ns = START_S * 10**9 + 1
    records = [{"time": first_ns + i * 10**7, "imu": {"ay": [0.5 * i, i]}, "v [km/h]": i or None} for i in range(40)]
    with closing(open_log(_json_lines(tmp_path / "a.jsonl", *records))) as log:
        assert (log.kind, log.start_ns, log.lost) == ("json-lines", first_ns, ())
        assert {f.path: f.unit for f in log.fields("json")} == {"imu_ay_0": "", "imu_ay_1": "", "v": "km/h"}
        columns = _columns(log, "json")
    np.testing.assert_array_equal(columns["imu_ay_0"], 0.5 * np.arange(40))
    np.testing.assert_array_equal(columns["v"], [np.nan, *range(1, 40)])


def test_json_lines_in_long_form_have_a_column_for_each_name(tmp_path: Path) -> None:
    records = [{"name": n, "value": i + k, "time": START_S + 0.1 * i} for i in range(40) for k, n in enumerate("ab")]
    with closing(open_log(_json_lines(tmp_path / "a.ndjson", *records, [1], "x"))) as log:
        np.testing.assert_array_equal(_columns(log, "json")["b"], np.arange(40) + 1)
        assert [(loss.kind, loss.count) for loss in log.lost] == [("bad-row", 2)]


@pytest.mark.parametrize("text", ["", '[{"a": 1}]\n', "{\n", "x\n"])
def test_a_file_without_objects_in_lines_is_one_line(text: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="a JSON object a line"):
        open_log(_write(tmp_path / "a.json", text or "\n"))


def test_limits_of_json_lines(tmp_path: Path) -> None:
    """Each line has other keys: rows times columns grow as the square of the file."""

    def read(limits: dict[str, int], *records: object) -> list[str]:
        path = _json_lines(tmp_path / "a.jsonl", *records)
        allowed = dataclasses.replace(DEFAULT_LIMITS, **limits)
        with path.open("rb") as stream:
            (table,) = open_json_lines(TableFile(stream, path.stat().st_size, "a", allowed)).tables
        return [f.path for f in table.fields]

    records = [{"time": 0.1 * i, f"k{i}": 1} for i in range(20)]
    assert len(read({"array_width": 21, "table_bytes": 8 * 20 * 21, "table_ratio": 0}, *records)) == 20
    with pytest.raises(LimitError, match="at most 20 array width"):
        read({"array_width": 20}, *records)
    with pytest.raises(LimitError, match="at most 3359 table bytes"):
        read({"table_bytes": 8 * 20 * 21 - 1, "table_ratio": 0}, *records)
    deep = {"time": 1.0, "a": {"b": {"c": 1}}}
    assert read({"schema_depth": 3}, deep, {**deep, "time": 2.0}) == ["a_b_c"]
    assert read({"schema_depth": 2}, deep, {**deep, "time": 2.0, "d": 1}) == ["d"]
    assert read({}, {"time": 1.0, "a": [1] * 16, "b": [1] * 17}, {"time": 2.0})[-1] == "a_15"


# ------------------------------------------------------------------------------------------------ rates and runs


def test_a_table_without_times_asks_for_its_rate(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.csv", "ax,ay\n" + "".join(f"{i}.5,{i}\n" for i in range(100)))
    with pytest.raises(LogError, match="--set rate_hz=100, or rate_hz in the mapping file"):
        open_log(path)
    with closing(open_log(path, settings=TableSettings(rate_hz=50.0))) as log:
        assert np.diff(log.read({"csv": ["ay"]})["csv"].log_time_ns).tolist() == [20_000_000] * 99
        assert [loss.severity for loss in log.lost] == ["note"]
    long = _write(tmp_path / "b.csv", "signal,value\n" + "".join(f"{n},{i}\n" for i in range(50) for n in "ab"))
    with pytest.raises(LogError, match="a column of times"):
        open_log(long, settings=TableSettings(rate_hz=50.0))


def test_a_rate_decides_a_unit_that_is_not_stated(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.csv", "time,ay\n" + "".join(f"{100 * i},{i}\n" for i in range(600)))
    for rate_hz, length_s in ((None, 59.9), (100.0, 5.99), (1e4, 0.0599)):
        with closing(open_log(path, settings=TableSettings(rate_hz=rate_hz))) as log:
            assert (log.end_ns - log.start_ns) * 1e-9 == pytest.approx(length_s, abs=1e-6)
            assert "rate_hz" in log.lost[0].what


@pytest.mark.parametrize("ticks_per_s", [1, 10, 1000, 10_000, 1_000_000])
@pytest.mark.parametrize("unit_m_s", [1.0, 1 / 3.6])
def test_speed_and_positions_decide_the_unit_of_a_clock(ticks_per_s: int, unit_m_s: float, tmp_path: Path) -> None:
    t = np.arange(0, 60, 0.1)
    rows = zip(np.round(t * ticks_per_s, 1), 48.0 + 20.0 * t / 111_195.0, np.full(600, 20.0 / unit_m_s), strict=True)
    text = "time,latitude,longitude,speed\n" + "".join(f"{k:g},{lat:.8f},9.5,{v}\n" for k, lat, v in rows)
    with closing(open_log(_write(tmp_path / "a.csv", text))) as log:
        assert (log.end_ns - log.start_ns) * 1e-9 == pytest.approx(59.9, abs=1e-6)


def test_a_group_is_the_beginning_or_the_end_of_names(tmp_path: Path) -> None:
    scipy_io = pytest.importorskip("scipy.io")
    t = np.arange(100) * 0.01
    imu = {"time": t, "ay": t}
    scipy_io.savemat(tmp_path / "a.mat", {"run_1": {"imu": imu}, "run_2": {"imu": imu, "gps": imu}})
    for group, names in (("run_2", ["run_2_gps", "run_2_imu"]), ("imu", ["run_1_imu", "run_2_imu"])):
        with closing(open_log(tmp_path / "a.mat", settings=TableSettings(group=group))) as log:
            assert [topic.name for topic in log.topics] == names
    with pytest.raises(LogError, match="tables of the group run_3, got run_1_imu, run_2_imu, run_2_gps"):
        open_log(tmp_path / "a.mat", settings=TableSettings(group="run_3"))


def test_rate_and_group_of_a_mapping_file_apply_where_the_user_gives_none(tmp_path: Path) -> None:
    mapping = load_mapping(_write(tmp_path / "m.toml", 'rate_hz = 100\ngroup = "run_1"\n'))
    assert tables_for(mapping, TableSettings()) == TableSettings(100.0, "run_1")
    assert tables_for(mapping, TableSettings(50.0, "run_2")) == TableSettings(50.0, "run_2")
    assert (
        tables_for(load_mapping(_write(tmp_path / "n.toml", mapping_to_toml(mapping))), TableSettings()).rate_hz
        == 100.0
    )
    with pytest.raises(MappingFileError, match="rate_hz"):
        load_mapping(_write(tmp_path / "o.toml", "rate_hz = 0\n"))


# ------------------------------------------------------------------------------------------------ folders


def _sensor(path: Path, names: str, start_s: float, rate_hz: float, n: int) -> Path:
    rows = (f"{start_s + i / rate_hz:.3f}{f',{i}' * names.count(',')}\n" for i in range(n))
    return _write(path, f"{names}\n{''.join(rows)}")


def _telephone(folder: Path, start_s: float = START_S) -> Path:
    for name in ("Accelerometer", "Gyroscope"):
        _sensor(folder / f"{name}.csv", "time,z,y,x", start_s, 100.0, 1000)
    _sensor(folder / "Location.csv", "time,latitude,longitude", start_s, 2.0, 20)
    _write(folder / "Metadata.csv", "version,device\n3,phone\n")
    return folder


@pytest.mark.parametrize("start_s", [0.0, START_S])
def test_files_of_one_recording_are_one_log(start_s: float, tmp_path: Path) -> None:
    folder = _telephone(tmp_path / "telephone", start_s)
    assert [log.path for log in find_logs(str(tmp_path))] == [folder]
    with closing(open_log(folder)) as log:
        assert [(t.name, t.messages) for t in log.topics] == [
            ("Accelerometer", 1000), ("Gyroscope", 1000), ("Location", 20),
        ]  # fmt: skip
        np.testing.assert_array_equal(_columns(log, "Gyroscope")["x"], np.arange(1000))
        assert {(loss.kind, loss.severity) for loss in log.lost} >= {("folder", "note"), ("bad-file", "note")}
        assert not [loss for loss in log.lost if loss.severity == "lost"]
    assert len(find_logs(str(folder), settings=TableSettings(folder="drives"))) == 4


@pytest.mark.parametrize("start_s", [0.0, START_S])
@pytest.mark.parametrize(("titles", "late_s"), [(("time,ax", "time,ax"), 0.0), (("time,ax", "time,ay,az"), 6.0)])
def test_files_of_the_same_columns_or_other_times_are_drives(
    titles: tuple[str, str], late_s: float, start_s: float, tmp_path: Path
) -> None:
    for i, title in enumerate(titles):
        _sensor(tmp_path / "drives" / f"{i}.csv", title, start_s + i * late_s, 100.0, 1000)
    folder = tmp_path / "drives"
    assert [log.path.name for log in find_logs(str(folder))] == ["0.csv", "1.csv"]
    with pytest.raises(LogError, match=r"a folder of 2 logs.*--set folder=recording"):
        open_log(folder)
    forced = TableSettings(folder="recording")
    assert [log.path for log in find_logs(str(folder), settings=forced)] == [folder]
    with closing(open_log(folder, settings=forced)) as log:
        assert [topic.name for topic in log.topics] == ["n_0", "n_1"]


def test_a_damaged_file_of_a_recording_is_a_loss(tmp_path: Path) -> None:
    folder = _telephone(tmp_path / "telephone")
    _write(folder / "Gravity.csv", "\n".join("damaged" * 3 for _ in range(9)))
    with closing(open_log(folder)) as log:
        assert [loss.where for loss in log.lost if loss.severity == "lost"] == [str(folder / "Gravity.csv")]


def test_a_search_takes_texts_only_where_there_are_no_other_tables(tmp_path: Path) -> None:
    for name in (
        "one/a.csv",
        "one/b.log",
        "two/c.log",
        "two/d.jsonl",
        "two/history.jsonl",
        "three/e.vbo",
        "three/f.csv",
    ):
        _write(tmp_path / name, "x")
    found = [log.path.name for log in find_logs(str(tmp_path))]
    assert sorted(found) == ["a.csv", "c.log", "d.jsonl", "e.vbo"]
