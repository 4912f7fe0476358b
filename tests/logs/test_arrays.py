"""Parquet and MAT files: types, budgets, and files that ask for more than they contain or for other files."""

import io
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings, strategies as st
from scipy.io import savemat
from scipy.sparse import eye_array

from pdhef_logtool.logs.mat_log import open_mat
from pdhef_logtool.logs.parquet_log import open_parquet
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits
from pdhef_logtool.logs.table_file import TableFile
from pdhef_logtool.records.errors import LogError
from tests.table_contents import Contents, opened, parsed

N = 200
TIME_S = np.arange(N) * 0.02
AY = np.round(np.sin(TIME_S), 4)


read_mat = partial(parsed, open_mat)


def test_columns_of_a_matrix_have_the_titles_and_units_beside_it():
    out = io.BytesIO()
    cells = {"names": np.array(["t", "v"], object), "units": np.array(["s", "km/h"], object)}
    savemat(out, {"data": np.stack([TIME_S, AY], axis=1), **cells})
    assert read_mat(out.getvalue()).units == {"v": "km per h"}


# ------------------------------------------------------------------------------------------------ Parquet


def _parquet(columns: Any, limits: ResourceLimits = DEFAULT_LIMITS) -> Contents:
    out = io.BytesIO()
    pq.write_table(columns if isinstance(columns, pa.Table) else pa.table(columns), out)
    return parsed(open_parquet, out.getvalue(), limits)


def test_decimals_texts_and_integers_with_nulls_are_numbers_and_other_types_are_named():
    imu = pa.StructArray.from_arrays([pa.array(AY), pa.array([b"x"] * N)], ["ay", "raw"])
    read = _parquet({
        "t": TIME_S,
        "decimal": pa.array([Decimal(str(a)) for a in AY], pa.decimal128(12, 5)),
        "text": [f"{a}" if i else "ERR" for i, a in enumerate(AY)],
        "count": pa.array([None, *range(N - 1)], pa.uint8()),
        "flag": AY > 0.0,
        "imu": imu,
        "list": [[1.0, 2.0]] * N,
        "driver": pa.array(["me"] * N).dictionary_encode(),
        "date": pa.array([0] * N, pa.date32()),
    })  # fmt: skip
    np.testing.assert_allclose(read.columns["decimal"], AY, rtol=1e-15)
    np.testing.assert_array_equal(read.columns["text"], [np.nan, *AY[1:]])
    np.testing.assert_array_equal(read.columns["count"], [np.nan, *range(N - 1)])
    np.testing.assert_array_equal(read.columns["flag"], AY > 0.0)
    np.testing.assert_array_equal(read.columns["imu_ay"], AY)
    unusable, cells, texts = read.lost
    assert "imu.raw (binary)" in unusable.what
    assert "list (list<" in unusable.what
    assert (cells.kind, cells.count, cells.severity) == ("bad-cell", 1, "lost")
    assert texts.what == "columns without numbers are left out: driver, date"


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_dates_of_each_unit_and_those_outside_of_int64(unit, zone):
    per_s = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    values = [(1_714_521_600 + i) * per_s for i in range(N)]
    values[3] = 10**12 * per_s if unit != "ns" else values[3]
    of_g = pa.field("ay", pa.float64(), metadata={"unit": "g"})
    schema = pa.schema([pa.field("recorded", pa.timestamp(unit, zone)), of_g])
    read = _parquet(pa.table({"recorded": values, "ay": AY}, schema=schema))
    lost = 0 if unit == "ns" else 1
    assert read.units == {"ay": "g"}
    (stamps,) = read.stamps_ns.values()
    np.testing.assert_array_equal(np.delete(np.arange(N), [3] * lost), stamps // 10**9 - 1_714_521_600)
    assert read.counts == [("bad-stamp", 1)] * lost


def test_a_damaged_column_costs_its_rows_of_one_group():
    out = io.BytesIO()
    pq.write_table(pa.table({"t": TIME_S, **{f"c{i}": AY + i for i in range(5)}}), out, row_group_size=50)
    data = bytearray(out.getvalue())
    place = pq.ParquetFile(io.BytesIO(bytes(data))).metadata.row_group(1).column(3).data_page_offset
    data[place : place + 40] = b"\xff" * 40
    read = parsed(open_parquet, bytes(data))
    (loss,) = read.lost
    assert (loss.count, loss.what.partition(":")[0], loss.where) == (50, "c2", "a, row group 1")
    for i in range(5):
        is_lost = (np.arange(N) // 50 == 1) & (i == 2)
        np.testing.assert_array_equal(read.columns[f"c{i}"], np.where(is_lost, np.nan, AY + i))


def test_rows_and_texts_above_the_limits_are_refused_before_they_are_read():
    constant = {"t": np.zeros(1_000_000), "ay": np.zeros(1_000_000)}
    with pytest.raises(LogError, match="table bytes"):
        _parquet(constant, DEFAULT_LIMITS.times(0.01))
    indices = pa.array([0] * 5000, pa.int32())
    repeated = pa.DictionaryArray.from_arrays(indices, pa.array(["x" * 200_000]))
    read = _parquet({"t": np.arange(5000) * 0.02, "ay": np.zeros(5000), "repeated": repeated})
    assert {*read.columns} == {"ay"}
    assert "table bytes" in read.lost[0].what


# ------------------------------------------------------------------------------------------------ MAT 5


def _mat(variables: dict[str, Any], *, compressed: bool = False) -> bytes:
    out = io.BytesIO()
    savemat(out, variables, do_compression=compressed)
    return out.getvalue()


NUMBERS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "?"]


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(NUMBERS), st.integers(2, 60), st.integers(1, 16), st.booleans(), st.integers(0, 2**32 - 1))
def test_arrays_of_each_class_come_back(kind, rows, width, compressed, seed):
    rows += width
    values = np.random.default_rng(seed).integers(0, 100, (rows, width)).astype(kind)
    inner = {"time": np.arange(rows) * 0.02, "x": values, "deep": {"x": values[:, 0]}}
    read = read_mat(_mat({"d": inner, "note": "a drive", "gain": 3.0}, compressed=compressed))
    assert read.lost == ()
    for i in range(width):
        np.testing.assert_array_equal(read.columns[f"x_{i}" if width > 1 else "x"], values[:, i])
    assert [*read.topics] == ["d", "d_deep"]


@pytest.mark.parametrize("rows", [9, 200])
def test_a_matrix_of_unsigned_numbers_that_fall_has_no_times(rows):
    values = np.column_stack([np.arange(rows)[::-1] % 250, np.arange(rows) % 7]).astype("u1")
    read = read_mat(_mat({"d": {"time": np.arange(rows) * 0.02, "x": values}}))
    assert read.lost == ()
    np.testing.assert_array_equal(read.columns["x_0"], values[:, 0])


def test_what_is_no_array_of_numbers_is_named():
    deep: dict[str, Any] = {"x": AY}
    for _ in range(12):
        deep = {"d": deep}
    others = {
        "s": eye_array(N, format="csc"),
        "c": AY + 1j * AY,
        "cube": np.zeros((3, 4, 5)),
        "wide": np.zeros((40, 30)),
    }
    read = read_mat(_mat({"t": TIME_S, "ay": AY, "deep": deep, **others}))
    assert {*read.columns} == {"ay"}
    assert not read.what()
    assert all(
        part in read.what("note")
        for part in ("deep/d/d/d/d/d/d/d/d: too deep", "s: a sparse", "c: complex", "cube (3, 4, 5)", "wide (40, 30)")
    )


def test_a_compressed_variable_above_the_limits_costs_itself():
    data = _mat({"t": TIME_S, "ay": AY}) + _mat({"zeros": np.zeros(4_000_000)}, compressed=True)[128:]
    read = read_mat(data, DEFAULT_LIMITS.times(0.01))
    assert {*read.columns} == {"ay"}
    assert [loss.kind for loss in read.lost] == ["bad-variable"]


SEED = _mat(
    {"t": TIME_S[:20], "ay": AY[:20], "d": {"time": TIME_S[:9], "c": [1.0, "x"], "s": eye_array(3, format="csc")}}
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.integers(128, len(SEED) - 1), st.sampled_from([0, 1, 5, 14, 15, 127, 128, 255])), max_size=4)
)
def test_any_damage_of_a_mat_file_is_a_loss_or_one_line(changes):
    data = bytearray(SEED)
    for place, value in changes:
        data[place] = value
    try:
        tables = open_mat(TableFile(io.BytesIO(data), len(data), "a", DEFAULT_LIMITS)).tables
    except LogError as error:
        assert "\n" not in str(error)
        return
    assert all(len(table.stamps_ns) == len(table.load(f.path, slice(None))) for table in tables for f in table.fields)


def test_clocks_of_one_mat_file_share_a_unit_and_unlike_lengths_are_a_loss(tmp_path):
    slow = {"time": np.arange(4) * 10.0, "x": AY[:4]}
    one = read_mat(_mat({"imu": {"time": np.arange(1800) * 0.02, "x": np.ones(1800)}, "gnss": slow}))
    assert [int(np.ptp(stamps)) // 10**9 for stamps in one.stamps_ns.values()] == [35, 30]
    fast = {"time_ms": np.arange(100) * 0.01, "x": AY[:100]}
    two = _mat({"imu": {"time": np.arange(1800) * 0.02, "x": np.ones(1800)}, "gnss": fast})
    assert [loss.kind for loss in opened(tmp_path / "two.mat", two).lost] == ["clock-lengths"]


# ------------------------------------------------------------------------------------------------ MAT 7.3

SECRET = b"root:x:0:0:secret" * 20


def _mat73(path: Path, fill: Any) -> Contents:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        file["t"], file["ay"] = TIME_S[None], AY[None]
        fill(h5py, file)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file")
    return read_mat(path)


@pytest.mark.parametrize("kind", ["external", "virtual", "soft", "external link", "filter", "unwritten", "huge chunk"])
def test_a_dataset_that_is_not_in_the_file_is_a_loss_and_no_byte_of_others_is_read(kind, tmp_path):
    (tmp_path / "secret").write_bytes(SECRET)

    def fill(h5py: Any, file: Any) -> None:
        secret, other = str(tmp_path / "secret"), str(tmp_path / "other.h5")
        if kind == "external":
            file.create_dataset("leak", (N,), "u1", external=[(secret, 0, N)])
        elif kind == "soft":
            file["leak"] = h5py.SoftLink("/ay")
        elif kind == "filter":
            file.create_dataset("leak", data=AY, chunks=(N,), compression="lzf")
        elif kind == "unwritten":
            file.create_dataset("leak", (N,), "f8", chunks=(N,))
        elif kind == "huge chunk":
            file.create_dataset("leak", (N,), "f8", chunks=(1 << 28,), maxshape=(None,))
        else:
            with h5py.File(other, "w") as beside:
                beside["x"] = np.frombuffer(SECRET[:N], "u1")
            if kind == "virtual":
                layout = h5py.VirtualLayout((N,), "u1")
                layout[:] = h5py.VirtualSource(other, "x", (N,))
                file.create_virtual_dataset("leak", layout)
            else:
                file["leak"] = h5py.ExternalLink(other, "x")

    read = _mat73(tmp_path / "a.mat", fill)
    assert {*read.columns} == {"ay"}
    (loss,) = read.lost
    assert (loss.severity, loss.what.partition(":")[0]) == ("lost", "leak cannot be read")


def test_an_array_without_bytes_costs_itself_and_not_the_others(tmp_path):
    read = _mat73(tmp_path / "a.mat", lambda _, file: file.create_dataset("A", (2 * 10**9,), "f8", chunks=(10**6,)))
    assert {*read.columns} == {"ay"}
    assert "table bytes" in read.lost[0].what


def test_structs_texts_units_and_cells_of_version_7_3(tmp_path):
    def fill(h5py: Any, file: Any) -> None:
        group = file.create_group("signal")
        group["data"], group["time"] = AY[None], TIME_S[None]
        text = group.create_dataset("units", data=np.frombuffer("m/s^2".encode("utf-16-le"), "<u2")[:, None])
        text.attrs["MATLAB_class"] = np.bytes_("char")
        empty = file.create_dataset("empty", data=np.zeros(2, "u8"))
        empty.attrs["MATLAB_empty"] = 1
        file["loop"] = file["signal"]
        file.create_dataset("cell", (3,), h5py.ref_dtype)

    read = _mat73(tmp_path / "a.mat", fill)
    assert (read.topics, read.units) == ({"mat": N, "loop": N}, {"ay": "", "data": "m/s^2"})
    (loss,) = read.lost
    assert loss.severity == "note"
    assert ": cell: " in loss.what
