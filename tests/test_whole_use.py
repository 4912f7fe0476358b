"""The way of a user, command by command: from a recording of each kind to a network that is held against before."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path

import polars as pl
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore

from tests.command_line import pdhef, said

pytestmark = pytest.mark.slow

SAMPLE = Path(__file__).resolve().parents[1] / "sample_logs/step_rosbag2"
ESTIMATORS = ("pd-hef", "physics", "zero")
CAR = ("--car", "saloon")


def _log(folder: Path, kind: str) -> Path:
    if kind == "rosbag2":
        return Path(shutil.copytree(SAMPLE, folder / "drive"))
    topics = ["/imu/data", "/vehicle/wheel_speeds", "/vehicle/status/steering_status", "/truth/perfect/odometry"]
    store = get_typestore(Stores.ROS1_NOETIC)
    convert([SAMPLE], folder / "drive.bag", "sqlite3", 8, "lz4", "file", None, store, [], topics, [], [])
    return folder / "drive.bag"


@pytest.mark.parametrize("kind", ["rosbag1", pytest.param("rosbag2", marks=pytest.mark.fleet)])
def test_from_a_recording_to_a_network_and_back(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, before, after = _log(tmp_path, kind), tmp_path / "before", tmp_path / "after"
    pdhef("run", log, "-o", before, *CAR, "-e", ",".join(ESTIMATORS))
    run = json.loads((before / "run.json").read_text())
    assert [(one["log"], one["outcome"]) for one in run["logs"]] == [("drive", "ok")]
    drive = before / "logs/drive"
    stamps = Counter(pl.read_parquet(drive / "estimates.parquet")["estimator"])
    assert set(stamps) >= set(ESTIMATORS)
    _look_at_recordings(drive, stamps)

    (drive / "report.html").unlink()
    pdhef("report", before)
    assert "drive" in (drive / "report.html").read_text()
    events = said(capsys, "events", before, "--where", "abs(ay_m_s2) > 2", "--for", "0.5s", "--clip")
    assert len(events["events"]) == 1
    (clip,) = before.rglob("*clip*/*.mcap")
    with clip.open("rb") as file:
        assert "/pdhef/pd_hef/state" in {c.topic for _, c, _ in make_reader(file).iter_messages()}

    dataset, network = tmp_path / "dataset", tmp_path / "network"
    for split, start, end in (("train", 0, 3.5), ("validation", 3.5, 6)):
        pdhef("extract", log, *CAR, "-o", dataset, "--split", split, "--start", start, "--end", end)
    pdhef("train", dataset, "-o", network, "--epochs", 1)
    pdhef("run", log, "-o", after, *CAR, "-e", ",".join(ESTIMATORS), "--network", network, "--annotate", "none")
    compared = said(capsys, "compare", before, after, "--html", tmp_path / "compared.html")
    assert compared["pairs"] == {"signals": 1}
    assert (tmp_path / "compared.html").stat().st_size > 10_000


def _look_at_recordings(drive: Path, stamps: Counter[str]) -> None:
    """Read the recordings as other tools do: every stamp of every estimator is there."""
    with (drive / "annotated.mcap").open("rb") as file:
        counts = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    assert counts["/imu/data"] == counts["/truth/perfect/odometry"] == stamps["pd-hef"]
    assert counts["/pdhef/pd_hef/state"] == stamps["pd-hef"]
    recording, rows = RrdReader(drive / "recording.rrd"), Counter[str]()
    for chunk in recording.stream(store=recording.recordings()[0]):
        rows[str(chunk.entity_path)] += 0 if chunk.is_static else chunk.num_rows
    assert {rows["/main"], rows["/truth"], rows["/inputs"]} == {stamps["pd-hef"]}
