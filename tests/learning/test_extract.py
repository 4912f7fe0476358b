"""``pdhef extract``: from logs to a residual dataset on disk, and back."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch
from physics_oracle import Oracle, parts
from reference_car import FRICTION, START_NS, Drive, keep, with_noise
from residual_car import PULL_M_S2, truth_of, weaving

from pdhef_logtool import Car, Reporter, RunConfig
from pdhef_logtool.car.model import CarModel
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, nominal_filter
from pdhef_logtool.learning.network import train_command as training
from pdhef_logtool.learning.network.dataset import MANIFEST, SPLITS, read_dataset
from pdhef_logtool.learning.network.extract_command import ExtractResult, ExtractSettings, choose_split, extract
from pdhef_logtool.learning.network.residuals import ResidualRows, residual_rows
from pdhef_logtool.logs.discovery import hash_log
from pdhef_logtool.records.errors import LogError, ModelError, OutputError, UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.storage.documents import is_sealed, seal
from pdhef_logtool.storage.outputs import OutputFolder
from tests.run_report import follows
from tests.runs.test_inspection_report import write_log

MAPPING = "".join(
    f'[{place}]\ntopic = "/{topic}"\nfield = "{field}"\nstamp = "log_time"\n'
    for topic, fields in {
        "steer": {"signals.steer_rad": "angle"},
        "imu": {"signals.ax_m_s2": "ax", "signals.ay_m_s2": "ay", "signals.yaw_rate_rad_s": "r"},
        "speed": {"signals.speed_m_s": "v"},
        "ins": {"truth.vx_m_s": "vx", "truth.vy_m_s": "vy", "truth.yaw_rate_rad_s": "r"},
    }.items()
    for place, field in fields.items()
)
MAPPING += '[truth_quality]\ntopic = "/ins"\nfield = "fix"\nvalues = [4]\n'


def _extract(folder: Path, made: Drive, sigma: float = 0.0) -> ExtractResult:
    """Extract a drive of phy-ukf as recorded, its truth noisy, and bad for a second."""
    signals = made.signals
    stamps, s = signals.stamps_ns, np.stack([made.vx, made.vy, made.r], axis=1)
    noise = np.random.default_rng(2).normal(0.0, [sigma, sigma, 0.2 * sigma], s.shape)
    fix = np.full(len(stamps), 4.0)
    fix[1000:1100] = 1.0
    bad = np.where(fix == 4.0, 0.0, 3.0)
    rate = s[:, 2] + noise[:, 2] + (0.0 if sigma else 1e-5 * np.sin(np.arange(len(stamps))))
    topics = {
        "/steer": {"angle": signals.steer_rad},
        "/imu": {"ax": signals.ax_m_s2, "ay": signals.ay_m_s2, "r": s[:, 2]},
        "/speed": {"v": s[::2, 0]},
        "/ins": {"vx": s[:, 0] + noise[:, 0], "vy": s[:, 1] + noise[:, 1] + bad, "r": rate, "fix": fix},
    }
    log = write_log(folder / "drive.mcap", topics, dict.fromkeys(topics, stamps) | {"/speed": stamps[::2]})
    (folder / "m.toml").write_text(MAPPING)
    (folder / "v.toml").write_text(part_toml(default_vehicle()))
    config = RunConfig(car=folder / "v.toml", mapping=folder / "m.toml")
    return extract([str(log)], folder / "out", ExtractSettings(config, model="phy-ukf"))


@pytest.mark.slow
def test_noisy_truth_is_smoothed_and_unbiased(tmp_path):
    result = _extract(tmp_path, weaving(30.0), 0.01)
    (entry,) = result.manifest["drives"]
    assert entry["truth"]["smoothing_half_s"] == 0.15
    assert entry["truth"]["difference_noise"]["vy_dot_m_s2"] == pytest.approx(np.sqrt(2), rel=0.1)
    (found,) = (d.load() for d in read_dataset(result.output).drives)
    use = found.weight > 0
    # The second without a fix gives no target, nor do stamps whose window of smoothing reaches into it.
    assert not use[990:1110].any() and use.mean() > 0.9
    error = found.targets[use] / found.step_s[use, None] - [PULL_M_S2, 0.0]
    assert np.abs(error.mean(axis=0)).max() < 0.02
    smoothed = np.sqrt(np.mean(error**2, axis=0))
    assert smoothed[0] < 0.12, "the noise of one-step differences is above 1"


def test_a_drive_below_the_low_speed_limit_gives_rows_and_is_told(tmp_path):
    result = _extract(tmp_path, weaving(4.0, speed=2.0))
    (one,) = result.results
    assert one.entry is not None and one.entry["rows"] == 401 and one.entry["usable_rows"] == 0
    assert "not one usable target: no ground truth above the low-speed limit" in one.record.notes
    assert one.record.seconds == pytest.approx(4.0) and result.exit_code == 0


# ---- files ----


@pytest.fixture(scope="module")
def dataset(sample_logs_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("dataset")
    logs = [str(sample_logs_dir / name) for name in ("dlc.mcap", "sweep.mcap")]
    return extract(logs, out, ExtractSettings(RunConfig()))


def test_manifest_follows_its_schema(dataset, sample_logs_dir):
    document = json.loads((dataset.output / MANIFEST).read_text(encoding="utf-8"))
    follows(document, "dataset.schema.json")
    assert is_sealed(document) and {k: v for k, v in document.items() if k != "digest"} == dataset.manifest
    assert document["features"] == list(FEATURES)
    by_log = {d["log"]: d for d in document["drives"]}
    assert by_log["dlc"]["source"] == {"file": "dlc.mcap", "sha256": hash_log(sample_logs_dir / "dlc.mcap")}
    # The manifest of the sample logs names a vehicle file for each.
    names = {v["sha256"]: v["name"] for v in document["vehicles"]}
    assert len(names) == 2
    assert by_log["dlc"]["vehicle_sha256"] != by_log["sweep"]["vehicle_sha256"]


def test_rows_are_whole_and_in_order(dataset):
    (file,) = dataset.output.glob("split=*/car=truthsim-saloon-*/part-dlc.parquet")
    frame = pl.read_parquet(file, hive_partitioning=False)
    others = "target_dvy_m_s target_dyaw_rate_rad_s truth_vx_m_s truth_vy_m_s truth_std_rad truth_source weight segment"
    assert frame.columns == ["stamp_ns", *FEATURES, *others.split(), "chosen"]
    assert frame["stamp_ns"].diff().drop_nulls().min() > 0
    entry = next(d for d in dataset.manifest["drives"] if d["log"] == "dlc")
    assert (len(frame), int((frame["weight"] > 0).sum())) == (entry["rows"], entry["usable_rows"])
    usable = frame.filter(pl.col("weight") > 0)
    assert usable.null_count().sum_horizontal().item() == 0
    assert 0.9 < usable["weight"].min() <= usable["weight"].max() <= 1.0
    assert frame["chosen"].all()
    whole = pl.scan_parquet(dataset.output / "**/*.parquet", hive_partitioning=True)
    sums = whole.group_by("split").agg(pl.len()).collect()
    assert dict(sums.iter_rows()) == {
        name: s["rows"] for name, s in dataset.manifest["splits"].items() if s["drives"]
    }  # fmt: skip


def test_a_taught_car_is_calibrated_on_each_drive(sample_logs_dir, bare_vehicle, tmp_path):
    car = tmp_path / "car"
    car.mkdir()
    (car / "vehicle.toml").write_text(bare_vehicle)
    logs, settings = [str(sample_logs_dir / "dlc.mcap")], ExtractSettings(RunConfig(car=car))
    bare = extract(logs, tmp_path / "bare", settings).manifest
    model = CarModel(physics_sha256=Car.load(car, network="none").physics_sha256)
    (car / "model.toml").write_text(model.toml("Of a test."))
    taught_set = extract(logs, tmp_path / "taught", settings).manifest
    follows(taught_set, "dataset.schema.json")
    assert bare["drives"][0]["calibration"] == "" and "stiffness" in taught_set["drives"][0]["calibration"]


def test_damaged_dataset_is_told(dataset, sample_logs_dir, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(dataset.output, copy)
    files = {d.entry["name"]: d.path for d in read_dataset(copy).drives}
    files["dlc"].write_bytes(files["sweep"].read_bytes())
    broken = next(d for d in read_dataset(copy).drives if d.entry["name"] == "dlc")
    with pytest.raises(OutputError, match="another content"):
        broken.load()
    document = json.loads((copy / MANIFEST).read_text())
    (copy / MANIFEST).write_text(json.dumps({**document, "version": 99}))
    with pytest.raises(OutputError, match="not as it was written"):
        read_dataset(copy)
    del document["digest"]
    (copy / MANIFEST).write_text(json.dumps(seal({**document, "version": 99})))
    with pytest.raises(OutputError, match="creates it again"):
        read_dataset(copy)
    with pytest.raises(UsageError, match=r"got pdhef\.residual-dataset 99"):
        extract([str(sample_logs_dir / "dlc.mcap")], copy, ExtractSettings(RunConfig()))
    (copy / MANIFEST).unlink()
    with pytest.raises(OutputError, match="--resume"):
        read_dataset(copy)


@pytest.mark.slow
def test_processes_and_order_change_no_byte(dataset, sample_logs_dir, tmp_path):
    logs = [str(sample_logs_dir / name) for name in ("sweep.mcap", "dlc.mcap")]
    again = extract(logs, tmp_path / "out", ExtractSettings(RunConfig()), jobs=2)
    assert again.manifest == dataset.manifest
    for one in read_dataset(dataset.output).drives:
        again_there = tmp_path / "out" / one.path.relative_to(dataset.output)
        assert again_there.read_bytes() == one.path.read_bytes()


@pytest.mark.slow
def test_resume_keeps_what_is_as_it_was(dataset, sample_logs_dir, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(dataset.output, out)
    (out / MANIFEST).unlink()  # a killed command leaves none
    (torn,) = out.glob("split=*/car=*/part-sweep.parquet")
    torn.write_bytes(b"PAR1 torn")
    logs = [str(sample_logs_dir / name) for name in ("dlc.mcap", "sweep.mcap")]
    settings = ExtractSettings(RunConfig())
    resumed = extract(logs, out, settings, resume=True)
    assert [r.kept for r in resumed.results] == [True, False]
    assert resumed.manifest == dataset.manifest
    settings = replace(settings, where="vx_m_s > 1")
    assert not any(r.kept for r in extract(logs, out, settings, resume=True).results)
    afresh = extract(logs, out, settings)
    assert not any(r.kept for r in afresh.results)


def test_one_bad_log_stops_no_other(sample_logs_dir, tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    shutil.copy(sample_logs_dir / "dlc.mcap", logs / "good.mcap")
    (logs / "bad.mcap").write_bytes(b"this is no log")
    told: list[str] = []
    result = extract([str(logs)], tmp_path / "out", ExtractSettings(RunConfig()), reporter=Reporter(warn=told.append))
    assert result.exit_code == 3
    follows(result.manifest, "dataset.schema.json")
    assert [f["log"] for f in result.manifest["failed"]] == ["bad"]
    assert any(t.startswith("bad is left out: ") for t in told)
    assert [d.entry["name"] for d in read_dataset(tmp_path / "out").drives] == ["good"]
    with pytest.raises(LogError):
        extract([str(logs / "bad.mcap")], tmp_path / "alone", ExtractSettings(RunConfig()))


@pytest.mark.slow
def test_extract_chooses_rows_and_leaves_copies_out(sample_logs_dir, tmp_path):
    out = tmp_path / "out"
    for name in ("a", "b"):
        shutil.copy(sample_logs_dir / "dlc.mcap", tmp_path / f"{name}.mcap")
    told: list[str] = []
    asked = ExtractSettings(
        RunConfig(), split="train", where="abs(ay_m_s2) > 0.5 and not vx_km_h < 60 or truth_vx_m_s < 0"
    )
    logs = [str(tmp_path / f"{name}.mcap") for name in ("a", "b")]
    result = extract(logs, out, asked, reporter=Reporter(warn=told.append))
    assert "b is left out: it contains the same signals as a" in told and result.exit_code == 0
    assert result.manifest["duplicates"] == [{"log": "b", "file": "b.mcap", "of": "a"}]
    assert [p.name for p in out.rglob("*.parquet")] == ["part-a.parquet"]
    (made,) = read_dataset(out).drives
    rows = made.load()
    vx, ay = (rows.features[:, FEATURES.index(n)] for n in ("vx_m_s", "ay_m_s2"))
    assert rows.chosen is not None and 0.1 < rows.chosen.mean() < 0.9
    np.testing.assert_array_equal(rows.chosen, (np.abs(ay) > 0.5) & ~(vx * 3.6 < 60.0))
    assert made.entry["usable_rows"] == np.count_nonzero(rows.chosen & (rows.weight > 0.0))
    # The same signals under another name, in another call, replace the existing ones.
    extract(logs[1:], out, replace(asked, split="validation"))
    (other,) = read_dataset(out).drives
    assert (other.entry["name"], other.entry["split"]) == ("b", "validation")


# ---- split ----


def test_hash_split_is_stable_and_about_70_15_15():
    names = [f"{i:064x}" for i in range(4000)]
    splits = [choose_split(n)[0] for n in names]
    shares = [splits.count(s) / len(splits) for s in SPLITS]
    np.testing.assert_allclose(shares, [0.70, 0.15, 0.15], atol=0.02)
    assert splits == [choose_split(n)[0] for n in reversed(names)][::-1]
    # Written down: a split that changed between versions would leak test drives into training.
    assert " ".join(choose_split(n)[0] for n in names[:8]) == "train train train validation train train train train"


@pytest.mark.slow
def test_manifest_beside_the_logs_decides_and_the_option_wins(sample_logs_dir, tmp_path):
    shutil.copy(sample_logs_dir / "dlc.mcap", tmp_path / "a.mcap")
    shutil.copy(sample_logs_dir / "sweep.mcap", tmp_path / "b.mcap")
    suite = {"format": 1, "drives": [{"file": "a.mcap", "split": "extrapolation"}, {"file": "c.mcap", "split": "test"}]}
    (tmp_path / "manifest.json").write_text(json.dumps(suite))
    logs = [str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")]
    result = extract(logs, tmp_path / "out", ExtractSettings(RunConfig()))
    found = {d["log"]: (d["split"], d["split_from"]) for d in result.manifest["drives"]}
    assert found["a"] == ("extrapolation", "manifest")
    assert found["b"] == choose_split(hash_log(tmp_path / "b.mcap"))
    follows(result.manifest, "dataset.schema.json")
    chosen = extract(logs, tmp_path / "out", ExtractSettings(RunConfig(), split="validation"))
    assert {(d["split"], d["split_from"]) for d in chosen.manifest["drives"]} == {("validation", "option")}
    # Files in another split's folder are deleted, as they would be read with the rest.
    assert {p.parent.parent.name for p in (tmp_path / "out").rglob("*.parquet")} == {"split=validation"}


@pytest.mark.parametrize(
    "wrong",
    [{"split": "other"}, {"model": "other"}]
    + [
        {"where": text}
        for text in ("sideslip_rad > 1", "truth.vx_m_s > 1", "vx_m_s > 1 and (select 1)", "vx_m_s", "friction > 1 and")
    ],
)
def test_wrong_settings_are_told_before_any_log_is_read(tmp_path, wrong):
    with pytest.raises(UsageError):
        extract([str(tmp_path / "none.mcap")], tmp_path / "out", ExtractSettings(RunConfig(), **wrong))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_calls_add_up_by_log_and_slice(sample_logs_dir, tmp_path):
    out, log = tmp_path / "out", str(sample_logs_dir / "road.mcap")
    first = ExtractSettings(RunConfig(end=8.0), split="train")
    second = ExtractSettings(RunConfig(start=10.0, end=14.0), split="validation")
    extract([log], out, first)
    both = extract([log], out, second).manifest
    follows(both, "dataset.schema.json")
    parts = {"road.0-8.0": "train", "road.10.0-14.0": "validation"}
    assert {d["name"]: d["split"] for d in both["drives"]} == parts
    assert [d.entry["name"] for d in read_dataset(out).drives if len(d.load().stamps_ns)] == list(parts)
    again = extract([log], out, second).manifest
    assert again["sha256"] == both["sha256"], "what is extracted again takes its own place"
    other = extract([str(sample_logs_dir / "dlc.mcap")], out, ExtractSettings(RunConfig(), split="train")).manifest
    assert [d["name"] for d in other["drives"]] == ["dlc", "road.0-8.0", "road.10.0-14.0"]
    with pytest.raises(UsageError, match="do not overlap"):
        extract([log], out, ExtractSettings(RunConfig(start=7.0, end=9.0), split="test"))
    with pytest.raises(UsageError, match="for phy-ukf"):
        extract([log], out, replace(first, model="phy-ukf"))
    assert read_dataset(out).sha256 == other["sha256"], "a call that is refused leaves what was there"


@pytest.mark.slow
def test_logs_of_one_name_in_several_calls_are_several_drives(sample_logs_dir, tmp_path):
    told: list[str] = []
    for name in ("dlc", "sweep", "sweep"):
        (tmp_path / name).mkdir(exist_ok=True)
        log = shutil.copy(sample_logs_dir / f"{name}.mcap", tmp_path / name / "run.mcap")
        result = extract([log], tmp_path / "out", ExtractSettings(RunConfig()), reporter=Reporter(warn=told.append))
    names = [d["name"] for d in result.manifest["drives"]]
    assert len(names) == 2 and names[0] == "run" and names[1].startswith("run-")
    assert sum("another log of this name" in text for text in told) == 2


# ---- command line ----


def test_a_dataset_never_replaces_what_it_is_made_from(sample_logs_dir, tmp_path):
    log = tmp_path / "dlc.mcap"
    shutil.copy(sample_logs_dir / "dlc.mcap", log)
    file = tmp_path / "manifest.json"
    file.symlink_to(log)
    with pytest.raises(UsageError, match=r"replace the input|a new folder"):
        extract([str(log)], tmp_path, ExtractSettings(RunConfig()))
    assert log.read_bytes() == (sample_logs_dir / "dlc.mcap").read_bytes()
    file.unlink()
    file.write_text('{"format": 1, "drives": []}')
    with pytest.raises(UsageError, match="a new folder, or a residual dataset"):
        extract([str(log)], tmp_path, ExtractSettings(RunConfig()))
    assert file.read_text() == '{"format": 1, "drives": []}'


def test_a_dataset_is_written_by_one_command_at_a_time(sample_logs_dir, tmp_path):
    with OutputFolder(tmp_path), pytest.raises(OutputError, match="another command is writing to"):
        extract([str(sample_logs_dir / "dlc.mcap")], tmp_path, ExtractSettings(RunConfig()))
    assert list(tmp_path.iterdir()) == []


# ---- Residuals of drives with a residual in closed form ----


def state_of(made: Drive) -> np.ndarray:
    return np.stack([made.vx, made.vy, made.r], axis=1)


@pytest.fixture(scope="module")
def made():
    return weaving()


@pytest.fixture(scope="module")
def noisy(made):
    """With noise, a lost stretch of 0.8 s, single lost stamps, and truth and steering that fail for a while."""
    signals, state = with_noise(made.signals, 3, 0.5), state_of(made)
    signals.steer_rad[900:905] = np.nan
    state[700:720] = np.nan
    kept = np.ones(len(signals), dtype=bool)
    kept[300:380] = kept[500] = kept[1203] = False
    return keep(signals, kept), truth_of(signals.stamps_ns[kept], state[kept])


def rows_of(signals: Signals, truth: StateTrack) -> ResidualRows:
    return residual_rows(signals, truth, nominal_filter(default_vehicle()), period_s=0.01)


def rates(rows: ResidualRows) -> np.ndarray:
    return rows.targets / rows.step_s[:, None]


def test_residual_is_taken_at_the_true_state_not_at_the_estimate(made):
    signals, truth = made.signals, truth_of(made.signals.stamps_ns, state_of(made))
    lost = replace(signals, ay_m_s2=signals.ay_m_s2 + 3.0, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.1)
    good, bad = rows_of(signals, truth), rows_of(lost, truth)
    assert np.abs(bad.features[:, 6] - good.features[:, 6]).max() > 0.3  # the filter is far off
    np.testing.assert_array_equal(bad.targets, good.targets)


def test_no_target_across_gaps_or_without_truth_or_steering(noisy):
    rows = rows_of(*noisy)
    index = np.round((rows.stamps_ns - START_NS) / 1e7).astype(int)
    gone = set(index[np.isnan(rows.targets).any(axis=1)].tolist())
    expected = {299, 499, 1202, *range(699, 720), *range(899, 905), int(index[-1])}
    assert gone == expected
    assert not rows.weight[np.isin(index, list(expected))].any()


def test_features_do_not_see_the_truth(noisy):
    signals, truth = noisy
    state = np.stack([truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s], axis=1)
    a, b = rows_of(*noisy), rows_of(signals, truth_of(truth.stamps_ns, np.random.default_rng(1).permutation(state)))
    np.testing.assert_array_equal(a.features, b.features)
    np.testing.assert_array_equal(a.segment, b.segment)
    assert not np.array_equal(a.targets, b.targets, equal_nan=True)


# --- missing residual of physics -------------------------------------------------------------------------------------


def oracle_window(made: Drive, **signals: np.ndarray) -> tuple[Signals, StateTrack]:
    whole = replace(made.signals, friction=np.full(len(made.signals), FRICTION), **signals)
    return whole, truth_of(whole.stamps_ns, state_of(made))


@pytest.mark.slow
@pytest.mark.parametrize("names", [("lag",), ("lag", "roll", "load_transfer")], ids="+".join)
def test_physics_of_the_car_lacks_nothing_and_a_force_that_it_does_not_know_comes_out(names):
    """Drive the oracle's car by its equations; with 10 % less grip, the model lacks a force in proportion to a_y."""
    oracle = Oracle(parts(*names))
    made = oracle.drive(lambda t: 0.03 * np.sin(3.0 * t), 6.0)
    physics = VehicleUkf(oracle.as_vehicle())
    signals, truth = oracle_window(made)
    right = rates(residual_rows(signals, truth, physics, period_s=0.01))
    late = slice(100, -1)
    assert np.abs(right[late]).max() < 0.02
    told = replace(signals, friction=np.full(len(signals), 0.9 * FRICTION))
    lacks = rates(residual_rows(told, truth, physics, period_s=0.01))[late, 0]
    slope = float(made.ay[late] @ lacks / (made.ay[late] @ made.ay[late]))
    assert 0.04 < slope < 0.15


@pytest.mark.slow
def test_an_offset_of_the_steering_angle_is_no_residual():
    """The effect of the offset is removed before training; an alternating residual is not."""
    oracle = Oracle(parts("lag"))
    made = oracle.drive(lambda t: 0.02 * np.sin(3.0 * t), 12.0)
    off = made.signals.steer_rad + 0.002
    rows = residual_rows(*oracle_window(made, steer_rad=off), VehicleUkf(oracle.as_vehicle()), period_s=0.01)
    use = rows.weight > 0
    arrays = ResidualRows(**{name: getattr(rows, name)[use] for name in ResidualRows.__slots__})
    mean = (arrays.targets / arrays.step_s[:, None]).mean(axis=0)
    assert np.abs(mean).min() > 0.05
    assert np.abs(mean - training.steering_offset(arrays, oracle.as_vehicle())).max() < 0.2 * np.abs(mean).max()


def arrays(count: int = 200, **changes: Any) -> ResidualRows:
    """Return the rows of a drive at 100 Hz with random features, all usable."""
    columns: dict[str, Any] = {
        "stamps_ns": START_NS + np.arange(count) * 10_000_000,
        "features": np.random.default_rng(count).normal(size=(count, len(FEATURES))).astype(np.float32),
        "targets": np.full((count, 2), 0.02, dtype=np.float32),
        "step_s": np.full(count, 0.01),
        "weight": np.ones(count, dtype=np.float32),
        "segment": np.zeros(count, dtype=np.int64),
        "truth_velocity": np.tile(np.float32([20.0, 0.1]), (count, 1)),
        "chosen": np.ones(count, dtype=np.bool_),
    }
    return ResidualRows(**{**columns, **changes})


def sequence(count: int, value: float = 1.0) -> training.FeatureSequence:
    features = np.zeros((count, len(FEATURES)))
    features[:, 0] = np.arange(count) % 5
    features[:, 1] = value
    return training.FeatureSequence(features, np.tile([value, -2.0 * value], (count, 1)), np.ones(count))


def test_normalisation_is_by_weight_and_keeps_the_targets_zero():
    one = sequence(4, 3.0)
    one.weight[3] = 0.0
    found = training.normalisation_of([one, sequence(1, 1.0)], FEATURES[:2])
    assert found.feature_mean == pytest.approx(((0 + 1 + 2 + 0) / 4, (3 + 3 + 3 + 1) / 4))
    assert found.feature_std == pytest.approx((np.std([0, 1, 2, 0]), np.std([3, 3, 3, 1])))
    assert found.target_std == pytest.approx((math.sqrt(28 / 4), math.sqrt(4 * 28 / 4)))
    flat = training.normalisation_of([sequence(3, 0.0)], FEATURES[1:2])
    assert (flat.feature_std, flat.target_std) == ((1e-6,), (1e-6, 1e-6))
    with pytest.raises(ModelError, match="none"):
        training.normalisation_of([replace(one, weight=np.zeros(4))], FEATURES[:2])


def test_runs_end_at_new_segments_and_short_or_worthless_ones_are_left_out():
    segment = np.repeat([0, 1, 2, 3], [50, 49, 51, 50])
    weight = np.ones(200, dtype=np.float32)
    weight[150:] = 0.0
    drive = arrays(segment=segment, weight=weight)
    assert list(training.gap_free_runs(drive)) == [slice(0, 50), slice(99, 150)]
    drive.features[120, 3] = np.nan
    assert list(training.gap_free_runs(drive)) == [slice(0, 50)]


def test_a_recipe_is_the_papers_or_methods_with_the_callers_seed_and_epochs():
    own, paper = (training.make_recipe(paper=p, seed=5, epochs=None, device="cpu") for p in (False, True))
    assert own == training.Recipe(seed=5) and (paper.hidden, paper.seed, paper.epochs) == (128, 5, 200)
    assert training.make_recipe(paper=False, seed=0, epochs=1, device="cpu").epochs == 1
    with pytest.raises(UsageError, match="epoch"):
        training.make_recipe(paper=False, seed=0, epochs=0, device="cpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="--device"):
            training.make_recipe(paper=False, seed=0, epochs=None, device="cuda")


def test_what_is_not_chosen_teaches_nothing_and_only_what_leads_to_the_chosen_is_run():
    chosen = np.zeros(2000, dtype=np.bool_)
    chosen[[700, 740]] = True
    chosen[1500] = True
    weight = np.ones(2000, dtype=np.float32)
    weight[1500] = 0.0  # chosen, but of no use
    rows = arrays(2000, chosen=chosen, weight=weight)
    (run,) = training.gap_free_runs(rows)
    assert run == slice(700 - training.LEAD_STEPS, 741)
    assert rows.training_weight[run].sum() == 2.0
    cut = replace(rows, segment=np.where(np.arange(2000) < 720, 0, 1))
    assert list(training.gap_free_runs(cut)) == [slice(700 - training.LEAD_STEPS, 720)], (
        "what is left behind the cut is too short"
    )
