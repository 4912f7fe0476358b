"""Logs of tables against the arrays that were written: CSV, JSON lines, VBO, Parquet, MAT, their rates and folders."""

import dataclasses
import datetime as dt
import io
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.io import savemat

from pdhef_logtool import inspect_log
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError
from pdhef_logtool.logs.table_clocks import RELATIVE_NS
from pdhef_logtool.logs.table_file import TableFile, TableSettings
from pdhef_logtool.logs.text_logs import open_json_lines
from pdhef_logtool.mapping import load_mapping, mapping_to_toml, tables_for
from pdhef_logtool.records.errors import LogError, MappingFileError, PdhefError
from tests.command_line import called
from tests.table_contents import opened

N = 200
TIME_S = np.arange(N) * 0.01
AY = np.round(3.0 * np.sin(2.0 * TIME_S), 4)
SPEED = np.round(20.0 + TIME_S, 3)
DAY_NS = 1_714_521_600 * 10**9  # 2024-05-01


def _csv(times: list[str], header: str, separator: str = ",") -> str:
    rows = [separator.join([t, f"{a:.4f}", f"{v:.3f}"]) for t, a, v in zip(times, AY, SPEED, strict=True)]
    return "\n".join([header, *rows, ""])


def _iso(ending: str = "") -> list[str]:
    start = dt.datetime(2024, 5, 1, 12, 0, 0)
    return [(start + dt.timedelta(seconds=float(t))).isoformat(timespec="milliseconds") + ending for t in TIME_S]


NOON_NS = DAY_NS + 12 * 3600 * 10**9
SECONDS = [f"{t:.2f}" for t in TIME_S]
UNITS = {"ay": "m/s²", "speed": "km/h"}
_HEAD = "time,ay [m/s²],speed (km/h)"
CLOCKS = [t.partition("T")[2] for t in _iso()]
#: Dialects beside those of ``test_table_layouts.py``.
DIALECTS = {
    "spaces": (_csv(SECONDS, "time  ay[m/s²]  speed[km/h]", "  "), RELATIVE_NS),
    "iso-offset": (_csv(_iso("+02:00"), _HEAD), NOON_NS - 7200 * 10**9),
    "compact": (_csv([t.replace("-", "").replace(":", "") for t in _iso("Z")], _HEAD), NOON_NS),
    "named-month": (_csv([f"May 1 2024 {t}" for t in CLOCKS], _HEAD), NOON_NS),
    "colon-milliseconds": (_csv([t.replace(".", ":") for t in CLOCKS], _HEAD), RELATIVE_NS + 12 * 3600 * 10**9),
    "clock-by-its-cells": (_csv(CLOCKS, _HEAD.replace("time", "Ώρα")), RELATIVE_NS + 12 * 3600 * 10**9),
    "dead-clock": (_csv([f"0,{t}" for t in SECONDS], "utc," + _HEAD), RELATIVE_NS),
    "extra-comma": (_csv(SECONDS, _HEAD).replace("\n", ",\n"), RELATIVE_NS),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_of_csv_gives_the_same_columns(dialect, tmp_path):
    data, start_ns = DIALECTS[dialect]
    read = opened(tmp_path / "drive.csv", data)
    assert [*read.topics] == ["csv"]
    assert {name: read.units[name] for name in UNITS} == UNITS
    assert read.lost == ()
    np.testing.assert_array_equal(read.columns["ay"], AY)
    np.testing.assert_array_equal(read.columns["speed"], SPEED)
    expected = start_ns + np.round(TIME_S * 1e9).astype(np.int64)
    assert np.abs(read.stamps_ns["csv"] - expected).max() < 500


@settings(max_examples=25, deadline=None)
@given(
    values=st.lists(st.floats(-1e6, 1e6, allow_nan=False).map(lambda x: round(x, 6)), min_size=4, max_size=30),
    separator=st.sampled_from([";", "\t", ","]),
    comma=st.booleans(),
    quoted=st.booleans(),
)
def test_any_numbers_come_back(values, separator, comma, quoted, tmp_path_factory):
    comma = comma and separator != ","
    rows = [[f"{i * 0.02:.2f}", f"{v:.6f}"] for i, v in enumerate(values)]
    cells = [[c.replace(".", ",") if comma else c for c in row] for row in rows]
    text = "\n".join(separator.join(f'"{c}"' if quoted else c for c in row) for row in [["t", "a"], *cells])
    np.testing.assert_array_equal(opened(tmp_path_factory.mktemp("csv") / "a.csv", text).columns["a"], values)


@pytest.mark.parametrize(
    ("texts", "numbers"),
    [
        (["1.5", "-2", "+.5", "3.", "1e-3", "2E+02"], [1.5, -2.0, 0.5, 3.0, 1e-3, 200.0]),
        (["0", "0", "-0,123", "1,5E-05"], [0.0, 0.0, -0.123, 1.5e-05]),
        (["8.734,5", "987,25", "1.234", "12.000.000"], [8734.5, 987.25, 1234.0, 12e6]),
        (["8 734,5", "8\u00a0734,5", "12\u202f345\u202f678,0", "7"], [8734.5, 8734.5, 12345678.0, 7.0]),
        (["8'734.5", "8’734.5", "0.5"], [8734.5, 8734.5, 0.5]),
        (["\u22121.5", "\u2212.5", "2"], [-1.5, -0.5, 2.0]),
        (["0x4f", "0X10", "7"], [79.0, 16.0, 7.0]),
        (["true", "False", "TRUE"], [1.0, 0.0, 1.0]),
        (["1.234", "0,5", "0,25"], [1234.0, 0.5, 0.25]),  # the column has decimal commas
        (["1.234", "10.5", "11.5", "0,25"], [1.234, 10.5, 11.5, 0.25]),
        (["1,234", "0.5"], [1234.0, 0.5]),
    ],
)
def test_a_number_in_any_spelling(texts, numbers, tmp_path):
    rows = [f"{i};{text}" for i, text in enumerate(texts * 9)]
    read = opened(tmp_path / "a.csv", "\n".join(["time [s];a", *rows, ""]))
    np.testing.assert_array_equal(read.columns["a"], numbers * 9)
    assert read.lost == ()


EMPTY = [
    "", " ", "nan", "NaN", "-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND00", "#N/A", "n/a", "NULL", "None", "-", "--",
]  # fmt: skip
UNREADABLE = [
    "ERR", "****", "inf", "-Infinity", "1.#INF", "12.5 km/h", "1e999", "12:00", "0x", "1,2,3", "e5", "+", "x y",
]  # fmt: skip


def test_cells_without_a_number_are_empty_or_a_loss(tmp_path):
    rows = [f"{i};{text}" for i, text in enumerate(["1.5", *EMPTY, *UNREADABLE, *["0.25"] * 200])]
    read = opened(tmp_path / "a.csv", "\n".join(["time [s];a", *rows, ""]))
    assert read.columns["a"][np.isfinite(read.columns["a"])].tolist() == [1.5, *[0.25] * 200]
    assert read.counts == [("bad-cell", len(UNREADABLE))]


def test_columns_at_another_rate_have_their_own_clock_and_repeated_names_a_number(tmp_path):
    rows = [f"{t:.2f},{AY[i]},{SPEED[i] if i % 10 == 0 else ''},{2 * AY[i]}" for i, t in enumerate(TIME_S)]
    read = opened(tmp_path / "a.csv", "\n".join(["t,ay,speed,ay", *rows]))
    assert read.topics == {"csv": N, "csv_2": N // 10}
    np.testing.assert_array_equal(read.columns["ay_2"], 2 * AY)
    np.testing.assert_array_equal(read.columns["speed"], SPEED[::10])
    np.testing.assert_array_equal(read.stamps_ns["csv_2"], read.stamps_ns["csv"][::10])


@pytest.mark.parametrize(
    ("encoding", "title", "name"),
    [
        ("cp932", "ヨーレート [deg/s]", "yaw_rate"),
        ("cp932", "前後加速度", "longitudinal_acceleration"),
        ("gb18030", "横摆角速度 [deg/s]", "yaw_rate"),
        ("utf-8", "횡가속도", "lateral_acceleration"),
        ("latin-1", "Größe [°]", "Groesse"),
        ("cp1252", "Größe – Weg", "Groesse_Weg"),
        ("utf-8", "Wzdłużne", "Wzdluzne"),
        ("utf-8", "Längsbeschl.\\CCP:1 (m/s²)", "Laengsbeschl"),
        ("utf-8", "wheel speed [FL]", "wheel_speed_FL"),
        ("utf-8", "2nd gear", "n_2nd_gear"),
    ],
)
def test_the_bytes_of_the_titles_show_their_encoding(encoding, title, name, tmp_path):
    rows = [f"{t:.2f},{a:.4f}" for t, a in zip(TIME_S, AY, strict=True)]
    assert [*opened(tmp_path / "a.csv", "\n".join([f"t,{title}", *rows]).encode(encoding)).columns] == [name]


def test_columns_behind_times_of_their_own_have_these_and_a_lap_time_is_none(tmp_path):
    rows = [f"{t:.2f};{a:.4f};{t % 0.5:.2f};" for t, a in zip(TIME_S, AY, strict=True)]
    rows = [row + (f"{0.003 + 0.05 * i:.3f};{SPEED[i]}" if i < N // 5 else ";") for i, row in enumerate(rows)]
    read = opened(tmp_path / "a.csv", "\n".join(["time;ay;time;time;speed", *rows]))
    assert (read.topics, read.lost, [*read.columns]) == ({"csv_1": N, "csv_2": N // 5}, (), ["ay", "time_2", "speed"])
    np.testing.assert_array_equal(read.columns["ay"], AY)
    np.testing.assert_array_equal(read.columns["speed"], SPEED[: N // 5])
    expected = RELATIVE_NS + np.round((0.003 + 0.05 * np.arange(N // 5)) * 1e9)
    assert np.abs(read.stamps_ns["csv_2"] - expected).max() < 500


def test_damaged_rows_are_losses_and_the_others_are_read(tmp_path):
    lines = _csv(SECONDS, _HEAD).splitlines()
    lines[10], lines[20], lines[30] = "0.09,1", "0.19,2,3,4,5", ",1.0,2.0"
    text = "\n".join([*lines[:-1], "1.99,1.2"])  # cut within the last row
    read = opened(tmp_path / "a.csv", text)
    assert {*read.counts} == {("bad-row", 2), ("truncated", 1), ("bad-stamp", 1)}
    assert read.topics == {"csv": N - 4}
    done = called("inspect", tmp_path / "a.csv", "--json")
    assert done.returncode == 3
    assert "bad-row" in done.stdout


def test_rows_without_a_quoted_cell_shift_no_columns(tmp_path):
    lines = ["time,note,ay,speed", *(f'{t},"ok, {i}",{AY[i]},{SPEED[i]}' for i, t in enumerate(SECONDS))]
    lines[1], lines[50], lines[60] = '0.0,"ok",1.0', '0.49,"ok",1,2,3', '0.59,"two\nlines",1.5,2.5'
    read = opened(tmp_path / "a.csv", "\n".join([*lines, ""]))
    others = [i for i in range(N) if i not in (0, 49, 59)]
    for name, values, inserted in (("ay", AY, 1.5), ("speed", SPEED, 2.5)):
        np.testing.assert_array_equal(np.delete(read.columns[name], 57), values[others])
        assert read.columns[name][57] == inserted
    assert any("line 2 " in x.where for x in read.lost if (x.kind, x.count) == ("bad-row", 2))


def test_a_cell_without_an_end_costs_only_the_cells_behind_it(tmp_path):
    lines = ["time,ay,speed", *(f"{0.01 * i:.2f},1.5,{i}" for i in range(40_000))]
    lines[10] = '0.09,"1.5,9'
    read = opened(tmp_path / "a.csv", "\n".join([*lines, ""]))
    assert read.counts == [("bad-row", 1)]
    assert read.columns["speed"][-1] == 39_999
    assert len(read.columns["speed"]) > 20_000


def test_titles_in_a_comment_may_have_another_separator_than_the_values(tmp_path):
    rows = [f"{t} {a} {v}" for t, a, v in zip(SECONDS, AY, SPEED, strict=True)]
    read = opened(tmp_path / "a.csv", "\n".join(["# time(s),lateral ay(m/s/s),speed(mph)", *rows, ""]))
    np.testing.assert_array_equal(read.columns["speed"], SPEED)


@pytest.mark.parametrize(
    ("row", "kinds"),
    [("#0.1,5,5", {"bad-cell", "bad-stamp"}), ("#a comment", {"comment"}), ("# one, two", {"comment"})],
)
def test_rows_that_begin_with_a_hash_are_counted(row, kinds, tmp_path):
    lines = ["# made by hand", "# time,ay,speed", *(f"{t},{a},{v}" for t, a, v in zip(SECONDS, AY, SPEED, strict=True))]
    lines.insert(30, row)
    read = opened(tmp_path / "a.csv", "\n".join([*lines, ""]))
    assert read.topics == {"csv": N}
    assert set(read.counts) == {(kind, 1) for kind in kinds}


def test_a_decimal_comma_counts_in_whichever_row_it_is(tmp_path):
    steer = [0.0] * 1500 + [-0.125, 0.25]
    rows = [f"{0.01 * i:.2f};{v:g};1.{i % 10}00,5".replace(".", ",", 1) for i, v in enumerate(steer)]
    text = "\n".join(["time;steer;rpm", *(r.replace("-0.125", "-0,125").replace("0.25", "0,25") for r in rows), ""])
    read = opened(tmp_path / "a.csv", text)
    np.testing.assert_array_equal(read.columns["steer"], steer)
    np.testing.assert_array_equal(read.columns["rpm"][:3], [1000.5, 1100.5, 1200.5])
    assert read.lost == ()


@pytest.mark.parametrize(
    ("separator", "other", "cell", "value", "note"),
    [
        (";", "0,5", "1,234", 1.234, False),  # the file has decimal commas
        (";", "0,5", "1.234", 1234.0, True),
        (";", "0.5", "1,234", 1234.0, True),
        (",", "0.5", '"1,234"', 1234.0, True),
        (",", "0.5", "1.234", 1.234, False),
        (",", "0.5", '"8,734.5"', 8734.5, False),
        (";", "7", "1.234", 1.234, False),
        (";", "7", "1,234", 1.234, True),  # no other column decides
    ],
)
def test_other_columns_decide_what_a_mark_between_digits_is(separator, other, cell, value, note, tmp_path):
    rows = [separator.join([str(i), other, cell, str(i)]) for i in range(30)]
    read = opened(tmp_path / "a.csv", "\n".join([separator.join(["time [s]", "a", "b", "c"]), *rows, ""]))
    assert set(read.columns["b"]) == {value}
    assert read.counts == ([("ambiguous-number", None)] if note else [])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3\n4,5,6\n", "row of column names"),
        ("a,b\n5,6\n1,2\n", "column of times"),
        ("", "CSV"),
        ("hello\nworld\n", "row of column names"),
    ],
)
def test_a_csv_without_header_or_times_is_refused_in_one_line(text, words, tmp_path):
    with pytest.raises(PdhefError, match=words) as refused:
        opened(tmp_path / "a.csv", text)
    assert "\n" not in str(refused.value)


# ------------------------------------------------------------------------------------------------ VBO


def vbo(clock: list[str], *, units: str = "g\n\n°/s\n", created: str = "11/04/2014 @ 09:42") -> bytes:
    """A file of a recorder with one input module: three channels, of which the second has no unit."""
    titles = ["satellites", "time", "latitude", "longitude", "velocity kmh", "heading", "Event 1 time"]
    titles += ["latitude_raw", "Y_Accel", "Temp.", "YawRate"]
    head = f"File created on {created}\n\n[header]\n" + "\n".join(titles) + f"\n\n[channel units]\n{units}\n"
    head += "[comments]\nLog Rate (Hz) : 100.00\n\n[column names]\nsats time lat long\n\n[data]\n"
    rows = [
        f"018 {t} +3608.246{i % 10} -1086.979{i % 10} {72.0 + i * 0.01:07.3f} 231.56  0.0 +3608.2 {AY[i]:+.6E} 20 1.0 "
        for i, t in enumerate(clock)
    ]
    return (head + "\n".join(rows) + "\n").replace("\n", "\r\n").encode("latin-1")


def test_a_vbo_file_keeps_minutes_units_and_the_clock_over_midnight(tmp_path):
    clock = ["235959.980", "235959.990", "000000.000", "000000.010", "000003.000"]
    read = opened(tmp_path / "a.vbo", vbo(clock))
    assert (read.topics, read.lost) == ({"vbox": 5}, ())
    assert {name: unit for name, unit in read.units.items() if unit} == {
        "latitude": "min", "longitude": "min", "latitude_raw": "min", "Y_Accel": "g", "YawRate": "°/s",
    }  # fmt: skip
    midnight_ns = 1_397_260_800 * 10**9  # 2014-04-12
    assert ((read.stamps_ns["vbox"] - midnight_ns) // 10**6).tolist() == [-20, -10, 0, 10, 3000]
    assert (read.columns["longitude"][0], read.columns["velocity_kmh"][1]) == (-1086.9790, 72.01)
    with closing(open_log(tmp_path / "a.vbo")) as log:
        assert log.topics[0].type_name == "vbox/msg/Vbo"


@pytest.mark.parametrize(
    ("lines", "units"),
    [
        ("g\n°/s\n", {"Y_Accel": "g", "YawRate": "°/s", "Temp": ""}),
        ("g\nm/s2\n°/s\n°C\n", {"Y_Accel": "", "YawRate": "°/s", "Temp": ""}),  # whose is g?
    ],
)
def test_of_too_many_or_too_few_units_those_that_belong_to_one_quantity_are_used(lines, units, tmp_path):
    read = opened(tmp_path / "a.vbo", vbo(["100000.00", "100000.01"], units=lines))
    assert {name: read.units[name] for name in units} == units
    (loss,) = read.lost
    assert (loss.kind, loss.severity, loss.count) == ("units", "note", list(units.values()).count(""))


@pytest.mark.parametrize(("east", "turn"), [(1, 90), (-1, 90), (1, 1), (-1, 1)])
def test_the_heading_shows_which_longitude_is_positive(east, turn, tmp_path):
    head = "File created on 01/05/2024\n\n[header]\ntime\nlatitude\nlongitude\nheading\n\n[data]\n"
    heading = np.linspace(0.0, turn, N)
    north, to_east = (np.cumsum(1e-3 * f(np.radians(heading))) for f in (np.cos, np.sin))
    rows = [
        f"1000{i // 100:02d}.{i % 100:02d} {3420 + n:+.6f} {east * (720 + 1.84 * e):+.6f} {h:.3f}"
        for i, (n, e, h) in enumerate(zip(north, to_east, heading, strict=True))
    ]
    read = opened(tmp_path / "a.vbo", head + "\n".join([*rows, ""]))
    is_clear = turn == 90  # a drive to the north does not show the sign
    assert read.counts == ([("mirrored", None)] if is_clear and east > 0 else [])
    assert (read.columns["longitude"][0] < 0.0) == (is_clear or east < 0)


def test_a_cut_vbo_file_is_read_as_far_as_it_goes(tmp_path):
    data = vbo([f"1000{i // 100:02d}.{i % 100:02d}" for i in range(N)])
    read = opened(tmp_path / "a.vbo", data[:-40])
    assert [(x.kind, x.severity) for x in read.lost] == [("truncated", "lost")]
    assert read.topics == {"vbox": N - 1}
    with pytest.raises(PdhefError, match=r"\[header\] and \[data\]"):
        opened(tmp_path / "b.vbo", data[: data.index(b"[data]")])


@pytest.mark.parametrize(("turned_deg", "recognised"), [(0.0, True), (3.0, True), (90.0, False), (180.0, False)])
def test_speed_and_course_of_a_receiver_are_gnss_signals_if_the_path_agrees(turned_deg, recognised, tmp_path):
    time_s = np.arange(0.0, 60.0, 0.1)
    course = 0.4 * np.sin(0.1 * time_s) + 0.8  # clockwise from north, 15 m/s
    north, east = (np.cumsum(15.0 * 0.1 * f(course)) for f in (np.cos, np.sin))
    gnss = {
        "time": time_s,
        "latitude": 60.0 + north / 111_195.0,
        "longitude": 18.0 + east / (111_195.0 * np.cos(np.radians(60.0))),
        "speed_kmh": np.full(len(time_s), 54.0),
        "course_deg": np.degrees(course) + turned_deg,
    }
    savemat(tmp_path / "a.mat", {"gnss": gnss, "imu": {"time": time_s, "yaw_rate_degps": -np.gradient(course, 0.1)}})
    signals = inspect_log(tmp_path / "a.mat").mapping.signals
    if not recognised:
        assert "gnss_course_rad" not in signals
        return
    source = signals["gnss_course_rad"]
    assert (source.topic, source.field, source.offset) == ("gnss", "course_deg", pytest.approx(np.pi / 2.0))
    assert source.scale == pytest.approx(-np.pi / 180.0)
    assert signals["gnss_speed_m_s"].scale == pytest.approx(1.0 / 3.6)


@pytest.mark.parametrize("clock", ["millis", "sensorTimestamp_since1970(s)"])
def test_a_clock_is_dates_before_times_since_a_start(clock, tmp_path):
    start = 1.7e9 if "1970" in clock else 0.0
    factor = 1.0 if "1970" in clock else 1e3
    rows = [f"{(start + t) * factor:.6f},{100.0 + t:.3f},{v:.4f}" for t, v in zip(TIME_S, SPEED, strict=True)]
    read = opened(tmp_path / "a.txt", "\n".join([f"{clock},gyroTimestamp_sinceReboot(s),speed (km/h)", *rows, ""]))
    assert read.stamps_ns["csv"][0] == (RELATIVE_NS if start == 0.0 else round(start * 1e9))


def test_texts_that_name_no_signals_make_no_columns(tmp_path):
    rows = [f"{t:.2f},entry {i},{v:.3f}" for i, (t, v) in enumerate(zip(TIME_S, SPEED, strict=True))]
    assert [*opened(tmp_path / "a.csv", "\n".join(["time,name,value", *rows, ""])).columns] == ["value"]


def test_a_clock_in_two_columns_or_with_named_months(tmp_path):
    rows = [(1_700_000_000 + i // 4, 250_000 * (i % 4)) for i in range(1, 40)]
    parts = "stamp.sec;stamp.usec;speed\n" + "".join(f"{s};{u};{i}\n" for i, (s, u) in enumerate(rows))
    assert opened(tmp_path / "a.csv", parts).stamps_ns["csv"].tolist() == [s * 10**9 + u * 1000 for s, u in rows]
    named = "Device Time,speed\n" + "".join(f"05-Nov-2025 10:00:{i:02}.500,{i}\n" for i in range(20))
    assert opened(tmp_path / "b.csv", named).stamps_ns["csv"][0] == 1_762_336_800_500_000_000


def test_rows_that_share_whole_seconds_are_spread(tmp_path):
    rows = "time,speed\n" + "".join(f"10:00:{(i + 3) // 5:02},{i}\n" for i in range(99))
    assert {*np.diff(opened(tmp_path / "a.csv", rows).stamps_ns["csv"]).tolist()} == {200_000_000}


START_S = 1_714_564_800


# ------------------------------------------------------------------------------------------------ JSON lines


def _json_lines(*records: object) -> str:
    return "".join(f"{json.dumps(record)}\n" for record in records)


def test_wide_json_lines_are_columns_with_exact_integers(tmp_path):
    first_ns = START_S * 10**9 + 1
    records = [{"time": first_ns + i * 10**7, "imu": {"ay": [0.5 * i, i]}, "v [km/h]": i or None} for i in range(40)]
    read = opened(tmp_path / "a.jsonl", _json_lines(*records))
    assert (read.kind, read.stamps_ns["json"][0], read.lost) == ("json-lines", first_ns, ())
    assert read.units == {"imu_ay_0": "", "imu_ay_1": "", "v": "km/h"}
    np.testing.assert_array_equal(read.columns["imu_ay_0"], 0.5 * np.arange(40))
    np.testing.assert_array_equal(read.columns["v"], [np.nan, *range(1, 40)])


def test_json_lines_in_long_form_have_a_column_for_each_name(tmp_path):
    records = [{"name": n, "value": i + k, "time": START_S + 0.1 * i} for i in range(40) for k, n in enumerate("ab")]
    read = opened(tmp_path / "a.ndjson", _json_lines(*records, [1], "x"))
    np.testing.assert_array_equal(read.columns["b"], np.arange(40) + 1)
    assert read.counts == [("bad-row", 2)]


@pytest.mark.parametrize("text", ["", '[{"a": 1}]\n', "{\n", "x\n"])
def test_a_file_without_objects_in_lines_is_one_line(text, tmp_path):
    with pytest.raises(LogError, match="a JSON object a line"):
        opened(tmp_path / "a.json", text or "\n")


def test_rows_of_a_document_have_the_names_beside_them(tmp_path):
    read = opened(
        tmp_path / "a.json", json.dumps({"columns": ["time", "ay"], "data": np.stack([TIME_S, AY], 1).tolist()})
    )
    np.testing.assert_allclose(read.columns["ay"], AY)


def test_limits_of_json_lines():
    """Each line has other keys: rows times columns grow as the square of the file."""

    def read(limits: dict[str, int], *records: object) -> list[str]:
        data, allowed = _json_lines(*records).encode(), dataclasses.replace(DEFAULT_LIMITS, **limits)
        (table,) = open_json_lines(TableFile(io.BytesIO(data), len(data), "a", allowed)).tables
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


def test_a_table_without_times_asks_for_its_rate(tmp_path):
    text = "ax,ay\n" + "".join(f"{i}.5,{i}\n" for i in range(100))
    with pytest.raises(LogError, match="--set rate_hz=100, or rate_hz in the mapping file"):
        opened(tmp_path / "a.csv", text)
    read = opened(tmp_path / "a.csv", rate_hz=50.0)
    assert np.diff(read.stamps_ns["csv"]).tolist() == [20_000_000] * 99
    assert [loss.severity for loss in read.lost] == ["note"]
    long = "signal,value\n" + "".join(f"{n},{i}\n" for i in range(50) for n in "ab")
    with pytest.raises(LogError, match="a column of times"):
        opened(tmp_path / "b.csv", long, rate_hz=50.0)


def test_a_rate_decides_a_unit_that_is_not_stated(tmp_path):
    text = "time,ay\n" + "".join(f"{100 * i},{i}\n" for i in range(600))
    for rate_hz, length_s in ((None, 59.9), (100.0, 5.99), (1e4, 0.0599)):
        read = opened(tmp_path / "a.csv", text, rate_hz=rate_hz)
        assert np.ptp(read.stamps_ns["csv"]) * 1e-9 == pytest.approx(length_s, abs=1e-6)
        assert "rate_hz" in read.lost[0].what


@pytest.mark.parametrize("ticks_per_s", [1, 10, 1000, 10_000, 1_000_000])
@pytest.mark.parametrize("unit_m_s", [1.0, 1 / 3.6])
def test_speed_and_positions_decide_the_unit_of_a_clock(ticks_per_s, unit_m_s, tmp_path):
    t = np.arange(0, 60, 0.1)
    rows = zip(np.round(t * ticks_per_s, 1), 48.0 + 20.0 * t / 111_195.0, np.full(600, 20.0 / unit_m_s), strict=True)
    text = "time,latitude,longitude,speed\n" + "".join(f"{k:g},{lat:.8f},9.5,{v}\n" for k, lat, v in rows)
    assert np.ptp(opened(tmp_path / "a.csv", text).stamps_ns["csv"]) * 1e-9 == pytest.approx(59.9, abs=1e-6)


def test_a_group_is_the_beginning_or_the_end_of_names(tmp_path):
    imu = {"time": TIME_S, "ay": AY}
    savemat(tmp_path / "a.mat", {"run_1": {"imu": imu}, "run_2": {"imu": imu, "gps": imu}})
    for group, names in (("run_2", ["run_2_gps", "run_2_imu"]), ("imu", ["run_1_imu", "run_2_imu"])):
        assert [*opened(tmp_path / "a.mat", group=group).topics] == names
    with pytest.raises(LogError, match="tables of the group run_3, got run_1_imu, run_2_imu, run_2_gps"):
        opened(tmp_path / "a.mat", group="run_3")


def test_rate_and_group_of_a_mapping_file_apply_where_the_user_gives_none(tmp_path):
    (tmp_path / "m.toml").write_text('rate_hz = 100\ngroup = "run_1"\n')
    mapping = load_mapping(tmp_path / "m.toml")
    assert tables_for(mapping, TableSettings()) == TableSettings(100.0, "run_1")
    assert tables_for(mapping, TableSettings(50.0, "run_2")) == TableSettings(50.0, "run_2")
    (tmp_path / "m.toml").write_text(mapping_to_toml(mapping))
    assert tables_for(load_mapping(tmp_path / "m.toml"), TableSettings()).rate_hz == 100.0
    (tmp_path / "m.toml").write_text("rate_hz = 0\n")
    with pytest.raises(MappingFileError, match="rate_hz"):
        load_mapping(tmp_path / "m.toml")


# ------------------------------------------------------------------------------------------------ folders


def _sensor(path: Path, names: str, start_s: float, rate_hz: float, n: int) -> None:
    rows = (f"{start_s + i / rate_hz:.3f}{f',{i}' * names.count(',')}\n" for i in range(n))
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{names}\n{''.join(rows)}")


def _telephone(folder: Path, start_s: float = START_S) -> Path:
    for name in ("Accelerometer", "Gyroscope"):
        _sensor(folder / f"{name}.csv", "time,z,y,x", start_s, 100.0, 1000)
    _sensor(folder / "Location.csv", "time,latitude,longitude", start_s, 2.0, 20)
    (folder / "Metadata.csv").write_text("version,device\n3,phone\n")
    return folder


@pytest.mark.parametrize("start_s", [0.0, START_S])
def test_files_of_one_recording_are_one_log(start_s, tmp_path):
    folder = _telephone(tmp_path / "telephone", start_s)
    assert [log.path for log in find_logs(str(tmp_path))] == [folder]
    read = opened(folder)
    assert read.topics == {"Accelerometer": 1000, "Gyroscope": 1000, "Location": 20}
    np.testing.assert_array_equal(read.columns["x"], np.arange(1000))
    assert {loss.kind for loss in read.lost} >= {"folder", "bad-file"}
    assert {loss.severity for loss in read.lost} == {"note"}
    assert len(find_logs(str(folder), settings=TableSettings(folder="drives"))) == 4


@pytest.mark.parametrize("start_s", [0.0, START_S])
@pytest.mark.parametrize(("titles", "late_s"), [(("time,ax", "time,ax"), 0.0), (("time,ax", "time,ay,az"), 6.0)])
def test_files_of_the_same_columns_or_other_times_are_drives(titles, late_s, start_s, tmp_path):
    for i, title in enumerate(titles):
        _sensor(tmp_path / "drives" / f"{i}.csv", title, start_s + i * late_s, 100.0, 1000)
    folder = tmp_path / "drives"
    assert [log.path.name for log in find_logs(str(folder))] == ["0.csv", "1.csv"]
    with pytest.raises(LogError, match=r"a folder of 2 logs.*--set folder=recording"):
        open_log(folder)
    forced = TableSettings(folder="recording")
    assert [log.path for log in find_logs(str(folder), settings=forced)] == [folder]
    assert [*opened(folder, folder="recording").topics] == ["n_0", "n_1"]


def test_a_damaged_file_of_a_recording_is_a_loss(tmp_path):
    folder = _telephone(tmp_path / "telephone")
    (folder / "Gravity.csv").write_text("\n".join("damaged" * 3 for _ in range(9)))
    assert [loss.where for loss in opened(folder).lost if loss.severity == "lost"] == [str(folder / "Gravity.csv")]


@pytest.mark.parametrize(
    ("files", "logs"),
    [
        ("one/drive.mcap one/notes.csv two/a.csv two/b.parquet", "one/drive.mcap two/a.csv two/b.parquet"),
        ("two/sub/c.vbo two/sub/d.mat", "two/sub/c.vbo"),
        ("one/a.csv one/b.log", "one/a.csv"),
        ("two/c.log two/d.jsonl two/history.jsonl", "two/c.log two/d.jsonl"),
        ("three/e.vbo three/f.csv", "three/e.vbo"),
    ],
)
def test_a_search_takes_general_files_only_where_there_are_no_others(files, logs, tmp_path):
    for name in files.split():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    found = {log.path.relative_to(tmp_path).as_posix() for log in find_logs([str(tmp_path)])}
    assert found == set(logs.split())


def test_bytes_that_are_no_utf_8_cost_no_other_character(tmp_path):
    data = _csv(SECONDS, "time,ay [m/s²],speed [km/h]").encode() + "2.00,1.0,caf\xe9\n".encode("latin-1")
    read = opened(tmp_path / "a.csv", data)
    assert (len(read.columns["ay"]), read.units["ay"]) == (N + 1, "m/s²")
    assert ("bad-cell", 1) in read.counts


def test_a_title_may_have_two_lines(tmp_path):
    text = _csv(SECONDS, '"time","ay\n[m/s²]","speed, measured"') + '"2.0","1","2"\n'
    read = opened(tmp_path / "a.csv", text)
    assert (read.units, read.lost) == ({"ay": "m/s²", "speed_measured": ""}, ())


def test_more_columns_than_the_limit_are_refused_before_they_are_read(tmp_path):
    width = 70_000
    text = "\n".join([",".join(["time", *(f"c{i}" for i in range(width))]), *(f"{i}" + "," * width for i in range(30))])
    with pytest.raises(PdhefError, match="array width"):
        opened(tmp_path / "a.csv", text)


def test_titles_of_a_vbo_file_may_contain_units(tmp_path):
    data = vbo(["100000.00", "100000.01"], units="\n\n\n")
    data = data.replace(b"YawRate\r", b"YawRate [deg/s]\r").replace(b"Y_Accel\r", b"Y_Accel (g)\r")
    read = opened(tmp_path / "a.vbo", data)
    assert [read.units[name] for name in ("YawRate", "Y_Accel", "latitude")] == ["deg/s", "g", "min"]
    assert read.lost == ()


@pytest.mark.parametrize("with_others", [False, True])
def test_a_pair_of_times_and_rising_values_is_a_signal(with_others, tmp_path):
    times = TIME_S + 0.002 * np.sin(9.0 * np.arange(N)) * with_others  # not regular, but those of another pair
    path = np.stack([100.0 + 5.0 * times**2, 10.0 + times], 1)  # positions
    pairs = {"speed": np.stack([times, SPEED], 1)} | ({"ay": np.stack([times, AY], 1)} if with_others else {})
    savemat(tmp_path / "a.mat", pairs | {"xy": path})
    read = opened(tmp_path / "b.mat", (tmp_path / "a.mat").read_bytes())
    assert {*read.columns} == ({"speed", "ay"} if with_others else {"speed"})
    np.testing.assert_array_equal(read.columns["speed"], SPEED)


def test_a_damaged_variable_costs_only_itself(tmp_path):
    savemat(tmp_path / "a.mat", {"t": TIME_S, "ay": AY, "speed": SPEED}, do_compression=True)
    data = bytearray((tmp_path / "a.mat").read_bytes())
    second = 128 + 8 + int.from_bytes(data[132:136], "little")
    data[second + 40 : second + 80] = b"\x00" * 40
    read = opened(tmp_path / "b.mat", bytes(data))
    assert [(x.kind, x.severity) for x in read.lost] == [("bad-variable", "lost")]
    assert [*read.columns] == ["speed"]
    assert [*opened(tmp_path / "c.mat", (tmp_path / "a.mat").read_bytes()[:-30]).columns] == ["ay"]
    assert called("inspect", tmp_path / "c.mat").returncode == 3


def test_a_magnitude_and_its_sign_are_one_signal(tmp_path):
    signed = np.sin(TIME_S)
    rows = [f"{t:.2f},{abs(v):.6f},{int(v < 0)},{int(v < 0)}" for t, v in zip(TIME_S, signed, strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,ESP_Gierrate [rad/s],ESP_VZ_Gierrate,Other_sign", *rows, ""]))
    source = inspect_log(path).mapping.signals["yaw_rate_rad_s"]
    assert (source.field, source.combine) == (("ESP_Gierrate", "ESP_VZ_Gierrate"), "signed")


def test_of_a_table_that_starts_again_the_first_pass_is_kept_and_rows_that_share_seconds_are_still_spread(tmp_path):
    passes = [f"{1_700_000_000 + i / 50:.2f},{i}\n" for i in range(150)] * 3
    seconds = [f"{1_700_000_000 + i // 5},{i}\n" for i in range(150)]
    seconds[70] = "1699999999,0\n"
    for name, rows, kept, kind in (("a", passes, 150, "time-jump"), ("b", seconds, 149, "out-of-order")):
        read = opened(tmp_path / f"{name}.csv", "time,speed\n" + "".join(rows))
        stamps = read.stamps_ns["csv"]
        (left_out,) = [loss for loss in read.lost if loss.kind != "clock"]
        assert (len(stamps), len({*stamps.tolist()})) == (kept, kept)
        assert (left_out.kind, left_out.count) == (kind, len(rows) - kept)
        assert (left_out.severity == "lost") == (kind == "time-jump")
