"""The sideslip reference in place of ground truth: on request only, if it is independent, and stated everywhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import ESTIMATED, read_model
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.drive import reading
from pdhef_logtool.learning import learn as learning
from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.learn import learn
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.learning.truth import weight_of
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.runs.config import RunConfig
from tests.fake_drive_log import FakeLog, FakeTopic

SIGNALS = ("steer_rad", "yaw_rate_rad_s", "ax_m_s2", "ay_m_s2", "speed_m_s")
MAPPING = "".join(
    f'[signals.{name}]\ntopic = "{topic}"\nfield = "{name}"\nstamp = "stamp"\n'
    for topic, names in (("/drive", SIGNALS), ("/gnss", ("gnss_velocity_east_m_s", "gnss_velocity_north_m_s")))
    for name in names
)


@pytest.fixture(scope="module")
def recorded(sample_logs_dir: Path) -> tuple[FakeLog, IntArray, FloatArray]:
    """Return a fishhook with a GNSS velocity at 10 Hz in place of its ground truth, and the true sideslip at stamps."""
    car = Car.load(sample_logs_dir / "vehicle.toml", network="none")
    with reading.read_drive(sample_logs_dir / "fishhook.mcap", car) as drive:
        whole = drive.whole()
    signals, truth = whole.signals, whole.truth
    assert truth is not None
    stamps, heading = signals.stamps_ns, np.cumsum(np.nan_to_num(truth.yaw_rate_rad_s)) * 0.01
    velocity = (truth.vx_m_s + 1j * truth.vy_m_s) * np.exp(1j * (heading + 0.7))
    known = np.flatnonzero(np.isfinite(velocity))[::10]
    noise = 0.02 * np.random.default_rng(1).standard_normal((2, len(known)))
    gnss = {
        "gnss_velocity_east_m_s": velocity[known].real + noise[0],
        "gnss_velocity_north_m_s": velocity[known].imag + noise[1],
    }
    columns = {name: getattr(signals, name) for name in SIGNALS}
    topics = {"/drive": (stamps, columns), "/gnss": (stamps[known], gnss)}
    log = {name: FakeTopic("vendor/msg/Any", at + 5_000_000, {"stamp": at, **of}) for name, (at, of) in topics.items()}
    return FakeLog(log), stamps, truth.sideslip_rad


@pytest.fixture
def config(
    recorded: tuple[FakeLog, IntArray, FloatArray], bare_vehicle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> RunConfig:
    monkeypatch.setattr(reading, "open_log", lambda *_, **__: recorded[0])
    monkeypatch.setattr(reading, "identity_of", lambda _: "0" * 64)
    monkeypatch.setattr(reading, "check_unchanged", lambda *_: None)
    (tmp_path / "drive.mcap").write_bytes(b"in memory")
    (tmp_path / "m.toml").write_text(MAPPING)
    (tmp_path / "vehicle.toml").write_text(bare_vehicle)
    return RunConfig(car=tmp_path / "vehicle.toml", mapping=tmp_path / "m.toml", reference="on")


def test_the_weight_is_one_over_the_variance_of_sideslip_and_model() -> None:
    std = np.radians([0.0, 0.3, 0.6])
    assert weight_of(std) == pytest.approx([1.0, 0.5, 0.2])


def test_extract_takes_it_where_it_is_independent_and_says_so(
    config: RunConfig, recorded: tuple[FakeLog, IntArray, FloatArray], tmp_path: Path
) -> None:
    log = [str(tmp_path / "drive.mcap")]
    with pytest.raises(EstimatorError, match="expected ground truth"):
        extract(log, tmp_path / "off", ExtractSettings(RunConfig(car=config.car, mapping=config.mapping)))
    result = extract(log, tmp_path / "on", ExtractSettings(config, split="train"))
    (entry,) = result.manifest["drives"]
    assert entry["truth"]["kind"] == ESTIMATED and result.manifest["settings"]["reference"] == "on"
    rows = pl.read_parquet(tmp_path / "on" / entry["file"])
    assert rows["truth_source"].unique().to_list() == [ESTIMATED]
    used = rows.filter(pl.col("weight") > 0.0)
    assert 0.3 < len(used) / len(rows) < 0.8  # straight before the manoeuvre the axle law prevails
    assert used["weight"].to_numpy() == pytest.approx(weight_of(used["truth_std_rad"].to_numpy()), rel=1e-5)
    sideslip = np.arctan2(used["truth_vy_m_s"].to_numpy(), used["truth_vx_m_s"].to_numpy())
    error = sideslip - np.interp(used["stamp_ns"].to_numpy(), recorded[1], recorded[2])
    assert np.degrees(np.sqrt(np.mean(error**2))) < 0.3
    assert np.mean(np.abs(error) < 1.96 * used["truth_std_rad"].to_numpy()) > 0.8


def test_learn_is_taught_by_it_on_request_alone(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "LEAST_S", 3.0)
    log = [str(tmp_path / "drive.mcap")]
    off = learn(log, tmp_path / "off", LearnSettings(config=RunConfig(car=config.car, mapping=config.mapping)))
    assert off.records[0].truth == () and read_model(off.car / MODEL_FILE).truth == ""
    result = learn(log, tmp_path / "car", LearnSettings(config=config))
    assert result.records[0].truth == (ESTIMATED,) and f"taught by {ESTIMATED}" in result.text
    assert read_model(tmp_path / "car" / MODEL_FILE).truth == ESTIMATED == result.figures["truth"]
    assert any(f"taught by {ESTIMATED}" in note for note in Car.load(tmp_path / "car").notes)


def test_ground_truth_has_priority(config: RunConfig, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    car = Car.load(config.car, network="none")
    with reading.read_drive(sample_logs_dir / "step.mcap", car) as drive:
        record, opened = learning.open_drive(drive, config)
    assert opened is not None and opened.truth.name != "reference" and record.truth != (ESTIMATED,)
