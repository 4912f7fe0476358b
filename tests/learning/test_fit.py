"""Training: it learns learnable targets, resumes bit for bit, and rejects unusable data."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.learning.network.train_command import (
    CHECKPOINT,
    FeatureSequence,
    Recipe,
    run_training,
    train,
)
from pdhef_logtool.records.errors import ModelError, OutputError, UsageError
from pdhef_logtool.residual_model.bundle import load_bundle
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.storage.documents import seal
from studies.defaults.train_baselines import SideslipSequence, fit_linear
from tests.command_line import called, pdhef

pytestmark = pytest.mark.slow

SMALL = Recipe(FEATURES[:8], hidden=12, layers=1, head=(8,), epochs=6, batch=4, learning_rate=2e-2)


class Stop(Exception):  # noqa: N818
    """Stops a training."""


def make_sequences(seed: int, count: int, steps: int = 400) -> list[FeatureSequence]:
    """Targets are a lagged, nonlinear function of two features: a network without memory cannot learn them."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        drive = np.cumsum(rng.normal(size=(steps, len(FEATURES))), axis=0) * 0.1
        lagged = np.zeros(steps)
        for k in range(1, steps):
            lagged[k] = 0.9 * lagged[k - 1] + 0.1 * np.tanh(drive[k, 1])
        target = np.stack([0.8 * lagged, -0.3 * lagged], axis=1)
        out.append(FeatureSequence(drive, target, np.ones(steps)))
    return out


def test_network_learns_a_residual_with_memory_and_serves_it(tmp_path):
    training, validation = make_sequences(0, 24), make_sequences(1, 4)
    bundle, history = train(training, validation, replace(SMALL, epochs=12), tmp_path)
    assert history[-1].validation_loss < 0.15 * history[0].validation_loss or history[-1].validation_loss < 0.05
    test = make_sequences(2, 1)[0]
    rates, _ = bundle.run(test.features, np.zeros(len(test.weight), dtype=np.bool_), None)
    error = np.sqrt(np.mean((rates - test.target) ** 2, axis=0))
    assert np.all(error < 0.35 * np.sqrt(np.mean(test.target**2, axis=0)))


def test_training_that_stopped_half_way_ends_as_if_it_had_not(tmp_path):
    training, validation = make_sequences(0, 6), make_sequences(1, 2)
    whole, history = train(training, validation, SMALL, tmp_path / "whole")

    def stop(text: str, _share: float) -> None:
        if text.startswith("epoch 3:"):
            raise Stop

    with pytest.raises(Stop):
        train(training, validation, SMALL, tmp_path / "cut", progress=stop)
    resumed, again = train(training, validation, SMALL, tmp_path / "cut")
    assert resumed.sha256 == whole.sha256 != train(training, validation, replace(SMALL, seed=1), tmp_path)[0].sha256
    assert [e.validation_loss for e in again] == [e.validation_loss for e in history]


def test_training_stops_when_patience_ends_and_keeps_the_best_epoch(tmp_path):
    """Validation targets have the other sign, so that their error grows while the network learns."""
    training = make_sequences(0, 6)
    validation = [replace(s, target=-s.target) for s in make_sequences(1, 2)]
    bundle, history = train(training, validation, replace(SMALL, epochs=20, patience=2), tmp_path, test=validation)
    losses = [e.validation_loss for e in history]
    best = losses.index(min(losses))
    assert len(losses) == best + 3 < 20
    assert (bundle.provenance["best_epoch"], bundle.provenance["validation_loss"]) == (best + 1, losses[best])
    assert bundle.provenance["test_loss"] == pytest.approx(losses[best])


def test_checkpoint_of_other_data_and_empty_splits_are_refused(tmp_path):
    training, validation = make_sequences(0, 4), make_sequences(1, 2)
    train(training, validation, replace(SMALL, epochs=1), tmp_path)
    with pytest.raises(ModelError, match="checkpoint"):
        train(training[:2], validation, replace(SMALL, epochs=1), tmp_path)
    with pytest.raises(ModelError, match="0 sequences"):
        train(training, [], SMALL, tmp_path / "none")
    sound = (tmp_path / CHECKPOINT).read_bytes()
    for at in (4, 20, 300, len(sound) // 2, len(sound) - 5):
        for damaged in (sound[:at], sound[:at] + bytes([sound[at] ^ 4]) + sound[at + 1 :]):
            (tmp_path / CHECKPOINT).write_bytes(damaged)
            with pytest.raises(ModelError, match=r"checkpoint.*remove it to train again"):
                train(training, validation, replace(SMALL, epochs=1), tmp_path)


@pytest.fixture(scope="module")
def dataset(sample_logs_dir, tmp_path_factory):
    return extracted(sample_logs_dir, tmp_path_factory.mktemp("sets") / "physics")


def extracted(sample_logs_dir: Path, folder: Path, *options: str) -> Path:
    """Three slices of one drive, for there are no other sample drives of this length; calls add up."""
    vehicle = sample_logs_dir / "vehicle.toml"
    for split, start, end in (("train", "30", "62"), ("validation", "115", "130"), ("test", "155", "170")):
        pdhef(
            "extract", sample_logs_dir / "road.mcap", "-o", folder, "--car", vehicle, "--split", split,
            "--set", f"start={start}", "--set", f"end={end}", *options,
        )  # fmt: skip
    return folder


def test_train_writes_a_model_that_runs(sample_logs_dir, dataset, tmp_path, capsys):
    joined = dataset
    done = called("train", str(joined), "-o", str(tmp_path / "model"), "--epochs", "2", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    bundle = load_bundle(tmp_path / "model")
    assert document["sha256"] == bundle.sha256
    assert len(document["history"]) == 2
    assert {p.name for p in (tmp_path / "model").iterdir()} == {
        "history.parquet", "model.json", "weights.safetensors",
    }  # fmt: skip
    assert pl.read_parquet(tmp_path / "model" / "history.parquet").height == 2
    assert bundle.provenance["dataset_sha256"]
    car, network = sample_logs_dir / "vehicle.toml", tmp_path / "model"
    config = RunConfig(car=car, network=network, estimators=("all",), annotate="none", end="5")
    result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / "out", config)
    assert {r.estimator for r in result.results[0].rows} >= {"pd-hef:fixed-r", "pd-hef"}
    rows = pl.read_parquet(tmp_path / "out/logs/dlc/estimates.parquet")
    physics, pd_hef = (rows.filter(estimator=e)["sideslip_rad"].to_numpy() for e in ("physics", "pd-hef"))
    assert np.nanmax(np.abs(physics - pd_hef)) > 1e-4, "the network is in use"
    again = run_training(joined, tmp_path / "again", epochs=2)
    assert again.bundle.sha256 == bundle.sha256
    assert again.bundle.provenance["fine_tuned_on"] is None
    with pytest.raises(UsageError, match="would replace the input"):
        run_training(joined, tmp_path / "model", init=tmp_path / "model", epochs=1)
    tuned = run_training(joined, tmp_path / "tuned", init=tmp_path / "model", epochs=1)
    assert tuned.bundle.provenance["fine_tuned_from"] == bundle.sha256
    assert tuned.bundle.provenance["fine_tuned_on"] == read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle.name
    with pytest.raises(OutputError, match="--filter phy-ukf"):
        run_training(joined, tmp_path / "paper", paper=True, epochs=1)


def test_wrong_calls_are_one_line(dataset, tmp_path):
    with pytest.raises(UsageError, match="epoch"):
        run_training(dataset, tmp_path / "m", epochs=0)
    with pytest.raises(OutputError, match="extract"):
        run_training(tmp_path, tmp_path / "m")
    alone = tmp_path / "alone"
    shutil.copytree(dataset, alone)
    document = json.loads((alone / "manifest.json").read_text())
    del document["digest"]
    document["drives"] = [d for d in document["drives"] if d["split"] == "train"]
    (alone / "manifest.json").write_text(json.dumps(seal(document)))
    done = called("train", str(alone), "-o", str(tmp_path / "m"), "--epochs", "1")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "validation" in done.stderr


NAMES = ("vx_m_s", "ay_m_s2", "steer_rad", "friction")


def smoothed(values: np.ndarray, dt: float, corner_hz: float) -> np.ndarray:
    """Return values behind a low-pass of first order that starts at the first one."""
    kept = math.exp(-2.0 * math.pi * corner_hz * dt)
    return lfilter([1.0 - kept], [1.0, -kept], values, zi=[kept * values[0]])[0]


def make_features(seed: int, steps: int = 600) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walks = rng.normal(size=(steps, 28))  # more than features: another number of them draws the same
    features = np.cumsum(walks[:, : len(FEATURES)], axis=0) * 0.1
    features[:, FEATURES.index("friction")] = 0.85  # one road: no information
    return features


def make_sequence(seed: int, noise: float = 0.0) -> SideslipSequence:
    features = make_features(seed)
    n = len(features)
    raw = 0.01 + 0.002 * features[:, 0] - 0.03 * features[:, 1] + 0.5 * features[:, 2]
    beta = smoothed(raw, 0.01, 2.0) + noise * np.random.default_rng(seed).standard_normal(n)
    beta[100:120] = np.nan  # no truth there
    return SideslipSequence(features, np.array([np.nan, *[0.01] * (n - 1)]), beta)


def test_regression_recovers_known_coefficients():
    model = fit_linear([make_sequence(s) for s in range(4)], NAMES)
    assert model.coefficients == pytest.approx((0.002, -0.03, 0.5, 0.0), abs=1e-10)
    assert model.intercept_rad == pytest.approx(0.01, abs=1e-10)
    noisy = fit_linear([make_sequence(s, 0.01) for s in range(8)], NAMES)
    assert noisy.coefficients[:3] == pytest.approx((0.002, -0.03, 0.5), abs=0.004)
    assert noisy.coefficients[3] == 0.0  # a constant feature gets no weight
