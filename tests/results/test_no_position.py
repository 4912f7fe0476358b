"""``--no-position``: no output of a run contains a place, copied topics included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader

from pdhef_logtool.results.no_position import topics_with_position
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.fake_drive_log import FakeLog, FakeTopic

PLACES = {"/rtk/odometry", "/rtk/fix", "/truth/perfect/odometry"}


def test_tables_and_copy_of_a_run_contain_no_place(sample_logs_dir, tmp_path):
    config = RunConfig(
        car=sample_logs_dir / "vehicle.toml",
        estimators=("kinematic",),
        keep="estimates",
        annotate="full",
        no_position=True,
        end="2",
    )
    run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / "out", config, report=False)
    (folder,) = (tmp_path / "out" / "logs").iterdir()
    estimates = pl.read_parquet(folder / "estimates.parquet")
    assert {"kinematic", "truth"} <= set(estimates["estimator"])
    for name in ("x_m", "y_m", "yaw_rad"):
        assert estimates[name].drop_nulls().drop_nans().is_empty()
    assert not estimates["vx_m_s"].drop_nulls().drop_nans().is_empty()
    copied = _topics(folder / "annotated.mcap")
    assert {"/imu/data", "/pdhef/kinematic/state"} <= copied
    assert not PLACES & copied
    assert sample_logs_dir.joinpath("dlc.mcap").exists()
    assert _topics(sample_logs_dir / "dlc.mcap") >= PLACES


def _topics(path: Path) -> set[str]:
    with path.open("rb") as file:
        return {channel.topic for _, channel, _ in make_reader(file).iter_messages()}


@pytest.mark.parametrize(
    ("type_name", "field", "left_out"),
    [
        ("vendor/msg/State", "gps.Latitude", True),
        ("vendor/msg/State", "gps.longitudeDeg", True),
        ("vendor/msg/Pedals", "brake_pedal_position", False),
        ("vendor/msg/Imu", "angular_velocity.z", False),
        ("tf2_msgs/msg/TFMessage", "n", True),
        ("nmea_msgs/msg/Sentence", "n", True),
        ("geometry_msgs/msg/PoseStamped", "pose.position.x", True),
    ],
)
def test_topics_are_left_out_by_fields_and_types(type_name, field, left_out):
    stamps = np.arange(3, dtype=np.int64)
    log = FakeLog({"/a": FakeTopic(type_name, stamps, {field: np.zeros(3)})})
    assert topics_with_position(log, ()) == (frozenset({"/a"}) if left_out else frozenset())


def test_mapped_places_are_left_out_and_topics_that_are_not_decoded():
    stamps = np.arange(3, dtype=np.int64)
    log = FakeLog(
        {"/a": FakeTopic("v/msg/A", stamps, {"n": np.zeros(3)}), "/b": FakeTopic("v/msg/B", stamps, {})},
    )
    assert topics_with_position(log, {"/a"}) == {"/a", "/b"}
