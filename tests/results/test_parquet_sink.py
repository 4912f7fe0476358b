from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_array_equal
from written import as_written

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.tracks import ESTIMATED_COLUMNS, SHARE_COLUMNS
from pdhef_logtool.results.parquet_sink import list_estimators, read_track, write_estimates, write_metrics

#: Type and unit of each column.
COLUMNS = {
    "stamp_ns": (pl.Int64, "ns"),
    "estimator": (pl.Categorical, ""),
    "vx_m_s": (pl.Float64, "m/s"),
    "vy_m_s": (pl.Float64, "m/s"),
    "yaw_rate_rad_s": (pl.Float64, "rad/s"),
    "sideslip_rad": (pl.Float64, "rad"),
    "ay_m_s2": (pl.Float64, "m/s^2"),
    "x_m": (pl.Float64, "m"),
    "y_m": (pl.Float64, "m"),
    "yaw_rad": (pl.Float64, "rad"),
    "vx_std_m_s": (pl.Float64, "m/s"),
    "vy_std_m_s": (pl.Float64, "m/s"),
    "yaw_rate_std_rad_s": (pl.Float64, "rad/s"),
    "sideslip_std_rad": (pl.Float64, "rad"),
    "network_trust": (pl.Float64, "1"),
    "r_scale": (pl.Float64, "1"),
    "nis": (pl.Float64, "1"),
    "friction": (pl.Float64, "1"),
    "valid": (pl.Boolean, ""),
    "diverged": (pl.Boolean, ""),
    "mixture_weight": (pl.Float64, "1"),
    "reason": (pl.Int32, ""),
    "roll_rad": (pl.Float64, "rad"),
    "bank_rad": (pl.Float64, "rad"),
    "force_scale": (pl.Float64, "1"),
    "steer_bias_rad": (pl.Float64, "rad"),
    "ay_bias_m_s2": (pl.Float64, "m/s^2"),
    "yaw_rate_bias_rad_s": (pl.Float64, "rad/s"),
    **dict.fromkeys(("share_law", "share_kinematics", "share_gnss", "independent"), (pl.Float64, "1")),
    "steer_rad": (pl.Float64, "rad"),
    "causal": (pl.Boolean, ""),
}
ESTIMATE_COLUMNS = {name: kind for name, (kind, _) in COLUMNS.items()}
#: Those that none of these tracks has.
OPTIONAL = {"mixture_weight", "reason", *ESTIMATED_COLUMNS, *SHARE_COLUMNS, "steer_rad"}
UNITS = {name: unit for name, (_, unit) in COLUMNS.items()}
METRIC_COLUMNS = ["log", "estimator", "signal", "segment", "metric", "value", "unit", "n", "algorithm", "independent"]
NAMES = ("phy-ukf", "zero", "truth")


@pytest.fixture
def path(tmp_path, circle) -> Path:
    """The file of three tracks of 600 stamps."""
    write_estimates(tmp_path / "estimates.parquet", [circle(name, 0, 600) for name in NAMES], rows_a_group=256)
    return tmp_path / "estimates.parquet"


def test_polars_reads_every_column_with_its_type(circle, path):
    frame = pl.read_parquet(path)
    assert list(frame.schema.items()) == list(ESTIMATE_COLUMNS.items())
    assert frame.height == 3 * 3 * 200
    for name in NAMES:
        rows = frame.filter(pl.col("estimator") == name)
        whole = circle(name, 0, 600)
        assert_array_equal(rows["stamp_ns"].to_numpy(), whole.stamps_ns)
        for column in set(ESTIMATE_COLUMNS) - {"stamp_ns", "estimator", "causal"} - OPTIONAL:
            assert_array_equal(rows[column].to_numpy(), as_written(getattr(whole, column), column), err_msg=column)
        assert all(rows[column].null_count() == rows.height for column in OPTIONAL)


def test_units_stand_in_the_file(path):
    metadata = pl.read_parquet_metadata(path)
    assert metadata["format"] == "pdhef.estimates"
    assert metadata["version"] == "1"
    assert json.loads(metadata["units"]) == UNITS
    assert {f.name: f.metadata[b"unit"].decode() for f in pq.read_schema(path)} == UNITS


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
def test_one_track_comes_back(circle, name, path):
    assert list_estimators(path) == NAMES
    track = read_track(path, name)
    whole = circle(name, 0, 600)
    for column, values in whole.columns().items():
        got = track.columns()[column]
        assert got.dtype == values.dtype
        np.testing.assert_allclose(got, as_written(values, column), rtol=1e-15, err_msg=column)
    assert track.name == name
    if name == "truth":
        assert track.covariance.shape == (0, 3, 3)
    else:
        assert np.isnan(track.covariance[:, 0, 1]).all()


def test_weights_and_reasons_come_back_where_there_are_some(tmp_path, circle):
    path = tmp_path / "estimates.parquet"
    whole = circle("pd-hef", 0, 600, adaptive=True)
    write_estimates(path, [circle("zero", 0, 600), whole])
    track = read_track(path, "pd-hef")
    assert_array_equal(track.mixture_weight, as_written(whole.mixture_weight))
    assert_array_equal(track.reason, whole.reason)
    assert track.reason.dtype == np.int64 and set(track.reason.tolist()) == {0, 4, 32}
    assert_array_equal(read_track(path, "pd-hef", ["reason"]).reason, whole.reason)
    other = read_track(path, "zero")
    assert (len(other), len(other.mixture_weight), len(other.reason)) == (600, 0, 0)
    rows = pl.read_parquet(path).filter(pl.col("estimator") == "zero")
    assert rows["mixture_weight"].null_count() == rows["reason"].null_count() == 600


def test_the_selected_estimate_is_written_twice_and_causal_rows_are_marked(tmp_path, circle):
    path = tmp_path / "estimates.parquet"
    a, b = circle("phy-ukf", 0, 600, covariance=False), circle("zero", 0, 600, bias=0.1)
    causal_from_ns = {"phy-ukf": int(a.stamps_ns[100])}
    write_estimates(path, [a, b], selected="phy-ukf", causal_from_ns=causal_from_ns, rows_a_group=250)
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
    kinds = {"value": pl.Float64, "n": pl.Int64, "independent": pl.Boolean}
    assert list(frame.schema.items()) == [(name, kinds.get(name, pl.String)) for name in METRIC_COLUMNS]
    assert frame.rows() == [
        ("drive", "phy-ukf", "sideslip_rad", "all", "rmse", 0.0123, "rad", 600, "0123456789ab", True),
        ("drive", "phy-ukf", "sideslip_rad", "nonlinear", "rmse", None, "rad", 0, "", True),
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.parquet"]
