"""``pdhef train`` from a dataset on disk to a model that runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.learning.network.train_command import run_training
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.residual_model.bundle import load_bundle
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.storage.documents import seal
from tests.command_line import called, pdhef

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def dataset(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_train_writes_a_model_that_runs(
    sample_logs_dir: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_wrong_calls_are_one_line(dataset: Path, tmp_path: Path) -> None:
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
