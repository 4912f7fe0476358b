import json

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal
from written import as_written

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.tracks import ESTIMATED_COLUMNS, SHARE_COLUMNS
from pdhef_logtool.results import parquet_sink
from pdhef_logtool.results.parquet_sink import list_estimators, load_schema, read_track, write_estimates
from pdhef_logtool.results.sink import BITS_OUT, STEPS, rounded
from pdhef_logtool.results.tables import write_metrics

KINDS = {
    "int64": pl.Int64, "int32": pl.Int32, "double": pl.Float64, "bool": pl.Boolean, "string": pl.String,
    "dictionary<int32, string>": pl.Categorical,
}  # fmt: skip
ESTIMATES, METRICS = (load_schema(f"{name}.parquet.json")["columns"] for name in ("estimates", "metrics"))
#: Those that only an adaptive filter has, and those that none of these tracks has.
ADAPTIVE = {"mixture_weight", "reason"}
OPTIONAL = {*ESTIMATED_COLUMNS, *SHARE_COLUMNS, "steer_rad", "causal"}
NAMES = ("phy-ukf", "zero", "truth")


def kinds(columns):
    return [(column["name"], KINDS[column["type"]]) for column in columns]


@pytest.fixture
def tracks(circle):
    """Return three tracks of 600 stamps by name, the first of an adaptive filter."""
    return {name: circle(name, 0, 600, adaptive=name == "phy-ukf") for name in NAMES}


@pytest.fixture
def path(tmp_path, tracks, monkeypatch):
    monkeypatch.setattr(parquet_sink, "ROWS_A_GROUP", 256)
    write_estimates(tmp_path / "estimates.parquet", list(tracks.values()))
    return tmp_path / "estimates.parquet"


def test_polars_reads_every_column_with_its_type_and_unit(tracks, path):
    frame = pl.read_parquet(path)
    assert list(frame.schema.items()) == kinds(ESTIMATES)
    assert frame.height == 3 * 3 * 200
    for name, whole in tracks.items():
        rows = frame.filter(pl.col("estimator") == name)
        unknown = OPTIONAL | (ADAPTIVE if name != "phy-ukf" else set())
        assert {column for column in frame.columns if rows[column].null_count() == rows.height} >= unknown
        assert_array_equal(rows["stamp_ns"].to_numpy(), whole.stamps_ns)
        for column in set(frame.columns) - {"stamp_ns", "estimator"} - unknown:
            assert_array_equal(rows[column].to_numpy(), as_written(getattr(whole, column), column), err_msg=column)
    metadata, units = pl.read_parquet_metadata(path), {column["name"]: column["unit"] for column in ESTIMATES}
    assert (metadata["format"], metadata["version"], json.loads(metadata["units"])) == ("pdhef.estimates", "1", units)
    assert {f.name: f.metadata[b"unit"].decode() for f in pq.read_schema(path)} == units


def test_file_is_zstd_with_dictionary_and_one_estimator_a_row_group(path):
    metadata = pq.ParquetFile(path).metadata
    assert metadata.num_row_groups == 9
    for g in range(metadata.num_row_groups):
        group = metadata.row_group(g)
        assert group.num_rows <= 256
        assert {group.column(c).compression for c in range(group.num_columns)} == {"ZSTD"}
        estimator = group.column(1)
        assert estimator.path_in_schema == "estimator"
        assert "RLE_DICTIONARY" in estimator.encodings
        assert estimator.statistics.min == estimator.statistics.max


@pytest.mark.parametrize("name", NAMES)
def test_one_track_comes_back(tracks, name, path):
    assert list_estimators(path) == NAMES
    track = read_track(path, name)
    whole = tracks[name]
    for column, values in whole.columns().items():
        got = track.columns()[column]
        assert got.dtype == values.dtype
        np.testing.assert_allclose(got, as_written(values, column), rtol=1e-15, err_msg=column)
    assert track.name == name and (len(track.reason) > 0) == (name == "phy-ukf")
    assert_array_equal(read_track(path, name, ["reason"]).reason, whole.reason)
    if name == "truth":
        assert track.covariance.shape == (0, 3, 3)
    else:
        assert np.isnan(track.covariance[:, 0, 1]).all()


def test_the_selected_estimate_is_written_twice_and_causal_rows_are_marked(tmp_path, circle, monkeypatch):
    monkeypatch.setattr(parquet_sink, "ROWS_A_GROUP", 250)
    path = tmp_path / "estimates.parquet"
    a, b = circle("phy-ukf", 0, 600, covariance=False), circle("zero", 0, 600, bias=0.1)
    causal_from_ns = {"phy-ukf": int(a.stamps_ns[100])}
    write_estimates(path, [a, b], selected="phy-ukf", causal_from_ns=causal_from_ns)
    frame = pl.read_parquet(path)
    groups = [g["estimator"][0] for g in frame.partition_by("estimator", maintain_order=True)]
    assert groups == ["phy-ukf", "selected", "zero"]
    copy = read_track(path, "selected")
    assert_array_equal(copy.stamps_ns, a.stamps_ns)
    assert_array_equal(copy.sideslip_rad, as_written(a.sideslip_rad, "sideslip_rad"))
    causal = frame.filter(pl.col("estimator") == "selected")["causal"].to_numpy()
    assert np.flatnonzero(causal).tolist() == [*range(100, 600)]
    assert list_estimators(path) == ("phy-ukf", "zero")


def test_what_is_not_there_is_said(tmp_path, path):
    with pytest.raises(OutputError, match=r"expected one of phy-ukf, zero, truth, got pd-hef"):
        read_track(path, "pd-hef")
    with pytest.raises(OutputError, match=r"readable Parquet"):
        read_track(tmp_path / "absent.parquet", "zero")
    (tmp_path / "text.parquet").write_text("no parquet")
    with pytest.raises(OutputError, match=r"readable Parquet"):
        read_track(tmp_path / "text.parquet", "zero")


ROWS = [
    MetricRow("drive", "phy-ukf", "sideslip_rad", "all", "rmse", 0.0123, "rad", 600, algorithm="0123456789ab"),
    MetricRow("drive", "phy-ukf", "sideslip_rad", "nonlinear", "rmse", float("nan"), "rad", 0),
]


def test_polars_reads_the_metrics(tmp_path):
    path = tmp_path / "metrics.parquet"
    write_metrics(path, ROWS)
    frame = pl.read_parquet(path)
    assert list(frame.schema.items()) == kinds(METRICS)
    assert frame.rows() == [
        ("drive", "phy-ukf", "sideslip_rad", "all", "rmse", 0.0123, "rad", 600, "0123456789ab", True),
        ("drive", "phy-ukf", "sideslip_rad", "nonlinear", "rmse", None, "rad", 0, "", True),
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.parquet"]


_COLUMNS = ("x_m", "yaw_rad", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "nis", "covariance", "friction")


@settings(derandomize=True, deadline=None)
@given(st.sampled_from(_COLUMNS), hnp.arrays(np.float64, 8, elements=st.floats(-1e6, 1e6)))
def test_no_number_moves_further_than_is_said_and_none_moves_twice(column, values):
    # Numbers below the smallest normal number of single precision have fewer bits; they are not tested here.
    values = np.where(np.abs(values) < np.finfo(np.float32).tiny, 0.0, values)
    once = rounded(column, values)
    step, share = (STEPS[column] / 2.0, 0.0) if column in STEPS else (0.0, 2.0 ** (BITS_OUT - 24))
    assert (np.abs(once - values) <= step + share * np.abs(values) * (1 + 1e-3) + 1e-37).all()
    np.testing.assert_array_equal(rounded(column, once), once)
    np.testing.assert_array_equal(once, as_written(values, column))
    assert not np.signbit(once[once == 0.0]).any() or column in ("nis", "covariance", "friction")


@pytest.mark.parametrize("column", _COLUMNS)
def test_what_is_no_number_stays_as_it_is(column):
    odd = np.array([0x7FFFFFFFFFFFFFFF, 0xFFF8000000000000, 0x7FF0000000000001], dtype=np.uint64).view(np.float64)
    assert np.isnan(rounded(column, odd)).all()
    infinite = np.array([np.inf, -np.inf])
    np.testing.assert_array_equal(rounded(column, infinite), infinite)
    assert rounded(column, np.empty((0, 3))).shape == (0, 3)
