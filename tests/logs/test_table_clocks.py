"""Clocks of tables: times in every unit are recovered, assumptions are noted, and no row is moved."""

import datetime as dt
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import assume, given, settings, strategies as st

from pdhef_logtool.logs import table_clocks
from pdhef_logtool.logs.table_clocks import NO_TIME, RELATIVE_NS, ascending_rows, week_clock
from pdhef_logtool.logs.table_columns import Sheet, find_clock, split_unit, tables_of
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import IntArray, Loss
from tests.table_contents import opened

MAY_1_NS = 1_714_521_600 * 10**9  # 2024-05-01
UNIX_TO_GPS_S = 315_964_800 - 18


def _clock(unit: str = "", name: str = "time", **columns: object):
    return find_clock(Sheet("csv", columns, {name: unit} if unit else {}), "a.csv")


def _times(rate_hz: float, n: int) -> IntArray:
    return np.round(np.arange(n) / rate_hz * 1e9).astype(np.int64)


@settings(max_examples=150, deadline=None)
@given(
    unit=st.sampled_from(sorted(table_clocks.TIME_UNITS_NS)),
    rate_hz=st.sampled_from([0.2, 1.0, 5.0, 10.0, 50.0, 100.0, 1000.0, 5000.0]),
    n=st.integers(5, 3000),
    start_s=st.sampled_from([0.0, 3.7, 52_000.0]),
    in_name=st.booleans(),
)
def test_times_since_a_start_come_back_in_each_stated_unit(unit, rate_hz, n, start_s, in_name):
    expected = _times(rate_hz, n)
    values = (expected + round(start_s * 1e9)) / table_clocks.TIME_UNITS_NS[unit]
    name = f"time_{unit.replace('μ', 'u').replace('µ', 'u')}" if in_name else "time"
    clock = _clock("" if in_name else f"[{unit}]", name, **{name: values})
    assert clock.notes == ()
    np.testing.assert_allclose(clock.stamps_ns - RELATIVE_NS - start_s * 1e9, expected, atol=2000)


@settings(max_examples=100, deadline=None)
@given(
    factor=st.sampled_from([10**9, 10**6, 10**3, 1]),
    rate_hz=st.sampled_from([0.2, 1.0, 10.0, 50.0, 2000.0]),
    start_s=st.integers(946_684_801, 2_840_000_000),
    n=st.integers(5, 3000),
    stated=st.sampled_from(["", "s"]),
)
def test_dates_come_back_whatever_their_unit(factor, rate_hz, start_s, n, stated):
    expected = start_s * 10**9 + _times(rate_hz, n)
    values = expected // factor if factor < 10**6 else expected / factor
    clock = _clock(stated, time=values)
    assert np.abs(clock.stamps_ns - expected).max() <= max(factor, 2000) * 0.6
    assert all("GPS" in note or (stated and factor < 10**9) for note in clock.notes)


@settings(max_examples=30, deadline=None)
@given(
    rate_hz=st.sampled_from([1.0, 20.0, 100.0, 500.0]),
    start=st.datetimes(dt.datetime(2001, 1, 1), dt.datetime(2030, 1, 1)),
    n=st.integers(20, 2000),
    form=st.sampled_from(
        ["excel", "matlab", "%Y-%m-%dT%H:%M:%S.%fZ", "%d.%m.%Y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p", "week"]
    ),
)
def test_dates_of_tables_and_texts_come_back(rate_hz, start, n, form):
    start = start.replace(microsecond=0)
    expected = round(start.replace(tzinfo=dt.UTC).timestamp()) * 10**9 + _times(rate_hz, n)
    if form in ("excel", "matlab"):
        assume(rate_hz * 4e-5 < 1.0)
        clock = _clock(time=expected / 86_400e9 + {"excel": 25_569, "matlab": 719_529}[form])
        assert f"days of {form}" in clock.notes[0].lower()
    elif form == "week":
        assume(start.year >= 2017)
        week, second = np.divmod(expected * 1e-9 - UNIX_TO_GPS_S, 604_800)
        clock = _clock(gps_week=week, gps_tow=second)
    else:
        texts = [dt.datetime.fromtimestamp(0, dt.UTC) + dt.timedelta(microseconds=t // 1000) for t in expected.tolist()]
        clock = _clock(time=pl.Series([t.strftime(form) for t in texts]))
    if "/" in form and start.day <= 12:
        assert len(clock.notes) <= 1
    np.testing.assert_allclose((clock.stamps_ns - expected) * 1e-9, 0.0, atol=3e-5)


@pytest.mark.parametrize(
    ("values", "length_s", "note"),
    [
        (np.arange(1500.0), 1499.0, "seconds; rate_hz"),
        (np.arange(900) * 2.0, 1798.0, "seconds; rate_hz"),
        (np.arange(2000) * 10.0, 19.99, "milliseconds"),
        (np.arange(60_000.0), 59.999, "milliseconds"),
        (np.arange(5000) * 0.004, 19.996, ""),
        (np.arange(3000) * 20_000, 59.98, "microseconds"),
        (40_000.0 + np.arange(9000) * 0.5e-3, 4.4995, ""),
    ],
)
def test_a_clock_without_a_unit_is_one_of_a_usual_recording(values, length_s, note):
    clock = _clock(time=values)
    assert (clock.stamps_ns[-1] - clock.stamps_ns[0]) * 1e-9 == pytest.approx(length_s, abs=1e-6)
    assert [note in text for text in clock.notes] == [True] * bool(note)


@pytest.mark.parametrize(
    ("name", "beside", "year"),
    [("gps_time", {}, 2024), ("time", {}, 2014), ("time", {"utc_time": MAY_1_NS * 1e-9}, 2024)],
)
def test_gps_time_is_recognised_by_its_name_or_another_clock(name, beside, year):
    gps_s = MAY_1_NS * 1e-9 - UNIX_TO_GPS_S + np.arange(100) * 0.02
    clock = _clock("s", name, **{name: gps_s}, **{n: v + np.arange(100) * 0.02 for n, v in beside.items()})
    assert clock.stamps_ns.astype("datetime64[ns]").astype("datetime64[Y]").astype(int)[0] + 1970 == year
    assert "GPS time" in clock.notes[0]
    if year == 2024:
        assert abs(int(clock.stamps_ns[0]) - MAY_1_NS) < 1000


def test_weeks_of_ten_bits_and_values_that_are_no_weeks():
    week, second = np.array([264.0, np.nan, 264.0, 264.0]), np.array([300_000.0, 1.0, np.inf, 300_001.0])
    clock = week_clock(week, second)
    assert clock.stamps_ns.tolist() == [1_714_562_382 * 10**9, NO_TIME, NO_TIME, 1_714_562_383 * 10**9]
    assert "2048 weeks" in clock.notes[0]
    assert week_clock(np.array([1773.0]), np.array([0.0])).stamps_ns.tolist() == [1_388_275_184 * 10**9]
    assert week_clock(np.array([1e15]), np.array([0.0])).stamps_ns.tolist() == [NO_TIME]
    assert week_clock(np.array([2312.0]), np.array([302_418_000.0])).stamps_ns.tolist() == [1_714_564_800 * 10**9]


@pytest.mark.parametrize(
    ("texts", "seconds", "note"),
    [
        (["12/03/2024 23:59:59.98", "13/03/2024 00:00:00.00"], (1_710_287_999.98, 1_710_288_000.0), False),
        (["11/03/2024 23:59:59", "12/03/2024 00:00:01"], (1_710_201_599.0, 1_710_201_601.0), False),
        (["3/30/2024 11:59:59 PM", "3/31/2024 12:00:01 AM"], (1_711_843_199.0, 1_711_843_201.0), False),
        (["5/1/2024 1:00 PM", "5/1/2024 1:01 PM"], (1_714_568_400.0, 1_714_568_460.0), True),
        (["2024-05-01T12:00:00.000000001+02:00", "2024-05-01 10:00:01Z"], (1_714_557_600.0, 1_714_557_601.0), False),
        (["01.05.24 12:00:00,5", "01.05.24 12:00:01,0"], (1_714_564_800.5, 1_714_564_801.0), False),
        (["23:59:59.5", "00:00:00.5"], (172_799.5, 172_800.5), False),
        (["11:59:59 p.m.", "12:00:01 a.m."], (172_799.0, 172_801.0), False),
        (["59:59.0", "00:01.0"], (89_999.0, 90_001.0), False),
    ],
)
def test_texts_have_one_order_of_day_and_month(texts, seconds, note):
    clock = table_clocks.text_clock(pl.Series(texts))
    np.testing.assert_allclose(clock.stamps_ns * 1e-9, seconds, atol=1e-6)
    assert bool(clock.notes) == note


def test_times_that_do_not_fit_are_none_and_never_wrap():
    texts = pl.Series(["9999-01-01 00:00:00", "2024-02-30", "x", None, "2024-05-01"])
    assert table_clocks.text_clock(texts).stamps_ns.tolist() == [NO_TIME] * 4 + [MAY_1_NS]
    assert table_clocks.number_clock(np.array([0.0, 1e12, -1e300, np.inf, np.nan, 0.02]), "s").stamps_ns.tolist() == [
        RELATIVE_NS, NO_TIME, NO_TIME, NO_TIME, NO_TIME, RELATIVE_NS + 20_000_000,
    ]  # fmt: skip
    years = np.array(["2024-05-01", "3000-01-01", "NaT"], "M8[us]")
    assert _clock(time=years).stamps_ns.tolist() == [MAY_1_NS, NO_TIME, NO_TIME]


def test_a_clock_without_values_is_not_chosen():
    nan, good = np.full(50, np.nan), np.arange(50) * 0.02
    assert _clock(time=nan, t=good).columns == {"t"}
    assert _clock(timestamp=np.where(np.arange(50) < 5, good, np.nan), t=good).columns == {"t"}
    with pytest.raises(LogError, match="a column of times"):
        _clock(time=nan, ay=good[::-1])
    both = _clock(t=good, time=good * 3.0)
    assert both.columns == {"t"}
    assert "another length" in both.notes[0]


def _losses(losses: list[Loss]) -> list[tuple[str, int | None, str]]:
    return [(loss.kind, loss.count, loss.severity) for loss in losses]


def test_of_a_clock_that_starts_again_the_first_pass_is_kept():
    one = RELATIVE_NS + _times(50.0, 1000)
    rows, losses = ascending_rows(np.concatenate([one, one + 5_000_000]), "a")
    np.testing.assert_array_equal(rows, np.arange(1000))
    assert _losses(losses) == [("time-jump", 1000, "lost")]
    longer = RELATIVE_NS + _times(50.0, 2000)
    rows, losses = ascending_rows(np.concatenate([one, longer]), "a")
    assert _losses(losses) == [("time-jump", 1050, "lost")]  # and 1 s behind the end of the first pass
    np.testing.assert_array_equal(rows, [*range(1000), *range(2050, 3000)])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 199), max_size=8, unique=True), st.integers(-900, 900))
def test_rows_out_of_order_are_left_out_and_none_is_moved(wrong, by_ms):
    stamps = RELATIVE_NS + _times(50.0, 200)
    stamps[wrong] += by_ms * 10**6
    rows, losses = ascending_rows(stamps, "a")
    assert (np.diff(rows) > 0).all()
    assert (np.diff(stamps[rows]) >= 0).all()
    assert len(rows) >= 200 - len(wrong)
    assert sum(count or 0 for _, count, _ in _losses(losses)) == 200 - len(rows)


def test_rows_without_a_time_or_of_another_day_are_counted():
    stamps = RELATIVE_NS + _times(50.0, 2000)
    stamps[:10] += 400 * RELATIVE_NS
    stamps[500], stamps[900] = NO_TIME, 2 * 10**18
    rows, losses = ascending_rows(stamps, "a")
    assert len(rows) == 1988
    assert {kind: count for kind, count, _ in _losses(losses)} == {"bad-stamp": 1, "other-epoch": 10, "outlier": 1}


ROW, RANDOM = np.arange(1000), np.random.default_rng(1).random(1000)


@pytest.mark.parametrize(
    ("there", "own_rows"),
    [
        ((ROW < 300) | (ROW > 550), 0),
        (RANDOM > 0.33, 0),
        (RANDOM > 0.67, 0),
        (ROW % 10 > 0, 0),
        (ROW % 2 == 0, 500),
        (ROW % 50 == 0, 20),
        ((ROW % 50 == 0) & (ROW >= 500), 10),
        (np.isin(ROW % 5, (0, 2)), 400),
    ],
    ids=["dropout", "a third", "two thirds", "every tenth", "each second", "1 Hz", "1 Hz from the middle", "20 Hz"],
)
def test_a_column_has_its_own_table_if_its_clock_is_slower(there, own_rows):
    columns: dict[str, Any] = {"t": ROW * 0.02, "ay": ROW * 1.0, "gnss": np.where(there, ROW, np.nan)}
    losses: list[Loss] = []
    tables = list(tables_of(Sheet("csv", columns | {"driver": pl.Series(["me"] * 1000)}, {}), "a.csv", losses))
    assert [(t.name, len(t.stamps_ns)) for t in tables] == [("csv", 1000)] + [("csv_2", own_rows)] * (own_rows > 0)
    gnss = tables[-1].load("gnss", slice(None))
    stamps = (tables[-1].stamps_ns - RELATIVE_NS) / 20_000_000
    np.testing.assert_allclose(gnss[np.isfinite(gnss)], stamps[np.isfinite(gnss)], atol=1e-6)
    assert np.isfinite(gnss).sum() == there.sum()
    assert [loss.what for loss in losses] == ["columns without numbers are left out: driver"]


# ---- shared cases of clocks, Parquet and MAT files: duration, start and samples of each ----


ROWS = range(20)
NMEA = "".join(
    f"$GPRMC,1200{i:02d}.00,A,3330.{i:04d},S,15112.{i:04d},E,10.0,{i},010126,,,A*6A\r\n" for i in ROWS
)  # fmt: skip
BLOCKS = "Version\t2\n\n{Block}\nTime\tvCar[kph]\n" + "".join(f"{i}\t{i}\n" for i in ROWS)
BLOCKS += "\n{Block}\nTime\taSteer[deg]\n" + "".join(f"{i}\t{2 * i}\n" for i in ROWS)
RATED = "# Sampling frequency: 50 Hz\nSample,Speed\n" + "".join(f"{i},{i * i}\n" for i in ROWS)


@pytest.mark.parametrize(
    ("name", "text", "topic", "field", "values"),
    [
        ("a.nmea", NMEA, "GPRMC", "latitude", -33.5 - np.arange(20) / 6e5),
        ("a.txt", BLOCKS, "csv", "vCar", np.arange(20)),
        ("a.txt", BLOCKS, "csv_2", "aSteer", 2 * np.arange(20)),
        ("a.csv", RATED, "csv", "Speed", np.arange(20) ** 2),
    ],
)
def test_layouts(name, text, topic, field, values, tmp_path):
    read = opened(tmp_path / name, text)
    assert topic in read.topics
    np.testing.assert_allclose(read.columns[field], values, atol=1e-9)


@pytest.mark.parametrize(
    ("title", "name", "unit"),
    [
        ("v / (km/h)", "v", "km/h"),
        ("Gierrate in °/s", "Gierrate", "°/s"),
        ("Скорость, км/ч", "Скорость", "км/ч"),
        ("Speed [km|h]", "Speed", "km|h"),
        ("Brake in use", "Brake in use", ""),
        ("a, b", "a, b", ""),
    ],
)
def test_units_in_titles(title, name, unit):
    assert split_unit(title) == (name, unit)
