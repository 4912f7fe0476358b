"""``pdhef tune``: the search finds an optimum, is the same for all, and its scores are those of a run."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pdhef_logtool.car.vehicle import Network, default_vehicle, load_vehicle, vehicle_to_toml
from pdhef_logtool.estimators.hybrid import hybrid_ukf
from pdhef_logtool.evaluation.metrics import score_track
from pdhef_logtool.learning.drives import choose_drives
from pdhef_logtool.learning.noise import tune_drives
from pdhef_logtool.learning.noise.search import (
    FACTORS,
    DriveError,
    Factor,
    Score,
    Trial,
    at_an_end,
    best_trial,
    drive_error,
    filter_tuning,
    score_drives,
    search,
    tuned_vehicle,
)
from pdhef_logtool.learning.noise.tune_command import REFUSED, TuneSettings, read_comments, run_tuning
from pdhef_logtool.learning.noise.tune_drives import Hybrid, TuneSetup, choose_names
from pdhef_logtool.records.errors import EstimatorError, LogError, UsageError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.run.pipeline import run_logs

pytestmark = pytest.mark.slow

OPTIMA = {"a": (0.3, 0.05, 1.5, 0.004), "b": (0.02, 0.4, 0.2, 0.02)}


def _bowl(points: Mapping[str, tuple[float, ...]]) -> dict[str, Score]:
    """Score by the distance from each estimator's own optimum in logarithms."""
    scores = {}
    for name, values in points.items():
        distance = sum(math.log(v / o) ** 2 for v, o in zip(values, OPTIMA[name], strict=True))
        scores[name] = Score(0.1 + distance, math.nan, math.nan)
    return scores


def _search(names: tuple[str, ...] = ("a", "b"), trials: int = 128, seed: int = 0) -> dict[str, tuple[Trial, ...]]:
    return search(_bowl, names, trials=trials, seed=seed)


@pytest.mark.parametrize("seed", range(5))
def test_the_optimum_is_found(seed: int) -> None:
    for name, trials in _search(seed=seed).items():
        for value, optimum in zip(best_trial(trials).values, OPTIMA[name], strict=True):
            assert abs(math.log(value / optimum)) < math.log(1.4)
        explored = min(t.score.objective_deg for t in trials if t.stage == "sobol")
        assert best_trial(trials).score.objective_deg < explored


def test_all_get_the_same_trials() -> None:
    found = _search()
    assert {len(t) for t in found.values()} == {128}
    explored = {n: [t.values for t in trials if t.stage == "sobol"] for n, trials in found.items()}
    assert len(explored["a"]) == 64
    assert explored["a"] == explored["b"]
    # Who else takes part changes nothing.
    assert _search(("b",))["b"] == found["b"]


def test_the_search_is_deterministic_and_stays_in_its_space() -> None:
    found = _search(trials=50, seed=3)
    assert found == _search(trials=50, seed=3)
    assert found["a"] != _search(trials=50, seed=4)["a"]
    for trial in found["a"] + found["b"]:
        for factor, value in zip(FACTORS, trial.values, strict=True):
            assert factor.low * (1 - 1e-3) <= value <= factor.high * (1 + 1e-3)


def test_exploration_is_spread_over_every_range() -> None:
    values = np.array([t.values for t in _search(trials=64)["a"] if t.stage == "sobol"])
    for i, factor in enumerate(FACTORS):
        quarter = np.floor([4 * factor.share(v) for v in values[:, i]]).clip(0, 3)
        assert np.bincount(quarter.astype(int), minlength=4).tolist() == [8, 8, 8, 8]


def test_a_best_value_at_an_end_is_named() -> None:
    factors = (Factor("p", "1", 0.1, 10.0), Factor("q", "1", 0.1, 10.0))
    trial = Trial(0, "sobol", (0.1, 1.0), Score(0.0, 0.0, 0.0))
    assert at_an_end(trial, factors) == ("p",)


def _error(rmse_deg: float, *, truth_deg: float = 5.0, scored: int = 1000, expected: int = 1000) -> DriveError:
    return DriveError(math.radians(rmse_deg), math.radians(truth_deg), scored, expected)


def test_the_objective_is_the_geometric_mean_over_drives() -> None:
    score = score_drives([_error(0.1), _error(0.4), _error(3.2, scored=4000, expected=4000)])
    floored = [math.hypot(rmse, 0.05) for rmse in (0.1, 0.4, 3.2)]
    assert score.objective_deg == pytest.approx(math.prod(floored) ** (1 / 3))
    assert score.median_deg == pytest.approx(0.4)
    assert score.pooled_deg == pytest.approx(math.sqrt((0.1**2 + 0.4**2 + 4 * 3.2**2) / 6))
    assert score_drives([_error(1e-6)]).objective_deg == pytest.approx(0.05)


def test_nothing_is_gained_by_leaving_the_hard_stamps_out() -> None:
    assert _error(0.1, scored=899).counted_rad == pytest.approx(math.radians(5.0))
    assert _error(0.1, scored=901).counted_rad == pytest.approx(math.radians(0.1))
    assert _error(9.0, scored=10).counted_rad == pytest.approx(math.radians(9.0))
    assert _error(math.nan, scored=0).counted_rad == pytest.approx(math.radians(5.0))


def _tracks(count: int = 400) -> tuple[StateTrack, StateTrack]:
    """An estimate and a truth with gaps on both sides and a slow part."""
    rng = np.random.default_rng(1)
    stamps = 10**18 + np.arange(count, dtype=np.int64) * 10_000_000
    vx = np.where(np.arange(count) < 100, 1.0, 20.0)
    truth = make_track("truth", stamps, vx_m_s=vx, vy_m_s=rng.normal(0, 0.5, count), valid=rng.random(count) > 0.1)
    estimate = make_track("e", stamps, vx_m_s=vx, vy_m_s=rng.normal(0, 0.5, count), valid=rng.random(count) > 0.2)
    return estimate, truth


def test_the_error_of_a_drive_is_that_of_a_run() -> None:
    estimate, truth = _tracks()
    rows = {(r.signal, r.metric): r for r in score_track(estimate, truth, {}, log="x", low_speed_m_s=3.0)}
    error = drive_error(estimate, truth, 3.0)
    assert error.rmse_rad == rows["sideslip_rad", "rmse"].value
    assert error.scored == rows["sideslip_rad", "rmse"].n
    assert error.expected == rows["sideslip_rad", "availability"].n
    zero = replace(truth, sideslip_rad=np.zeros(len(truth)))
    assert error.truth_rms_rad == pytest.approx(drive_error(zero, truth, 3.0).rmse_rad)


def _bundle() -> ModelBundle:
    torch.manual_seed(0)
    n = len(FEATURES)
    network = ResidualNetwork(Architecture(n, 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    return ModelBundle(FEATURES, 8, 1, (4,), 0.01, Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0)), weights)


def test_the_network_runs_once_and_the_hybrid_filter_is_the_same() -> None:
    count = 700
    rng = np.random.default_rng(0)
    stamps = 10**18 + np.arange(count, dtype=np.int64) * 10_000_000
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=stamps + 10_000_000,
        steer_rad=0.02 * np.sin(np.arange(count) / 60),
        ax_m_s2=rng.normal(0, 0.1, count),
        ay_m_s2=2.0 * np.sin(np.arange(count) / 60) + rng.normal(0, 0.1, count),
        yaw_rate_rad_s=0.08 * np.sin(np.arange(count) / 60) + rng.normal(0, 0.004, count),
        speed_m_s=25.0 + rng.normal(0, 0.05, count),
        friction=np.full(count, np.nan),
        wheel_speed_m_s=np.full((count, 4), np.nan),
        available=frozenset(ALIGNED_SIGNALS),
    )
    vehicle = default_vehicle()
    setup = TuneSetup(RunConfig(), vehicle, None, _bundle(), ("pd-hef",))
    hybrid = Hybrid("pd-hef")
    rate = hybrid.prepare(setup, signals)
    assert np.any(rate != 0.0)
    tracks = []
    for values in ((0.5, 0.05, 0.5, 0.01), (0.05, 0.5, 2.0, 0.001)):
        tuning = filter_tuning(values)
        tracks.append(hybrid.run(setup, tuning, signals, rate))
        whole = hybrid_ukf(tuned_vehicle(vehicle, "pd-hef", tuning), NetworkService(_bundle())).run(signals, None)[0]
        assert np.array_equal(tracks[-1].sideslip_rad, whole.sideslip_rad, equal_nan=True)
    assert not np.array_equal(tracks[0].sideslip_rad, tracks[1].sideslip_rad, equal_nan=True)


# ---- the command ----


@pytest.fixture(scope="module")
def drives(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set with one drive a split."""
    folder = tmp_path_factory.mktemp("set")
    entries = []
    for name, split in (
        ("dlc", "validation"),
        ("step", "validation"),
        ("fishhook", "test"),
        ("sweep", "extrapolation"),
    ):
        shutil.copy(sample_logs_dir / f"{name}.mcap", folder)
        entries.append({"file": f"{name}.mcap", "split": split})
    (folder / "manifest.json").write_text(json.dumps({"drives": entries}))
    return folder


def _settings(sample_logs_dir: Path, **changes: object) -> TuneSettings:
    config = RunConfig(vehicle=sample_logs_dir / "vehicle.toml")
    return replace(TuneSettings(config, trials=4, split="validation"), **changes)  # type: ignore[arg-type]


def test_what_is_written_runs_with_the_scores_that_are_recorded(
    sample_logs_dir: Path, drives: Path, tmp_path: Path
) -> None:
    _bundle().save(tmp_path / "model")
    settings = _settings(sample_logs_dir)
    settings = replace(settings, config=replace(settings.config, model=tmp_path / "model"))
    result = run_tuning([str(drives)], tmp_path / "car.toml", settings)
    assert result.exit_code == 0
    assert [d.name for d in result.drives] == ["dlc", "step"]

    before, after = load_vehicle(sample_logs_dir / "vehicle.toml"), load_vehicle(tmp_path / "car.toml")
    assert after.model_copy(update={"filter": before.filter, "identification": before.identification}) == before
    record = json.loads((tmp_path / "car.tuning.json").read_text())
    assert after.identification["tuning_drives_sha256"] == record["drives_sha256"]
    assert after.identification["tuning_trials"] == record["search"]["trials"] == 4
    assert (tmp_path / "car.tuning.png").read_bytes().startswith(b"\x89PNG")

    names = choose_names(None, _bundle())
    assert {"phy-ukf-tuned", "pd-hef"} <= set(names)
    assert set(record["estimators"]) == set(names)
    explored = {n: [t["values"] for t in e["trials"] if t["stage"] == "sobol"] for n, e in record["estimators"].items()}
    assert all(len(record["estimators"][n]["trials"]) == 4 and explored[n] == explored["pd-hef"] for n in names)
    for name in names:
        best = record["estimators"][name]["trials"][record["estimators"][name]["best_trial"]]
        assert best["objective_deg"] == min(t["objective_deg"] for t in record["estimators"][name]["trials"])
        assert after.filter[name] == filter_tuning(tuple(best["values"].values()))
        errors = record["estimators"][name]["rmse_deg"]
        assert best["objective_deg"] == pytest.approx(
            math.sqrt(math.hypot(errors["dlc"], 0.05) * math.hypot(errors["step"], 0.05)), rel=1e-9
        )

    runnable = {"phy-ukf-tuned": "phy-ukf-tuned", "physics-plus": "physics-plus", "pd-hef": "pd-hef-fixed-r"}
    shown = tuple(runnable[n] for n in names)
    config = RunConfig(vehicle=tmp_path / "car.toml", model=tmp_path / "model", estimators=shown, annotate="none")
    rows = run_logs([str(drives / "dlc.mcap")], tmp_path / "out", config).results[0].rows
    rmse = {r.estimator: r.value for r in rows if (r.signal, r.segment, r.metric) == ("sideslip_rad", "all", "rmse")}
    for name in names:
        assert math.degrees(rmse[runnable[name]]) == pytest.approx(
            record["estimators"][name]["rmse_deg"]["dlc"], rel=1e-12
        )


def test_the_smoother_is_tuned_only_when_it_is_named_and_by_its_own_error(
    sample_logs_dir: Path, drives: Path, tmp_path: Path
) -> None:
    bundle = _bundle()
    assert "pd-hef-smoothed" not in choose_names(None, bundle)
    with pytest.raises(UsageError, match="a model bundle"):
        choose_names(("pd-hef-smoothed",), None)
    bundle.save(tmp_path / "model")
    vehicle = load_vehicle(sample_logs_dir / "vehicle.toml")
    trusted = vehicle.model_copy(update={"network": Network(trust_cap=1.0, evidence="a test")})
    (tmp_path / "trusted.toml").write_text(vehicle_to_toml(trusted, {}))
    names = ("pd-hef", "pd-hef-smoothed")
    config = RunConfig(vehicle=tmp_path / "trusted.toml", model=tmp_path / "model")
    run_tuning([str(drives)], tmp_path / "car.toml", TuneSettings(config, names, trials=4, split="validation"))
    record = json.loads((tmp_path / "car.tuning.json").read_text())["estimators"]
    explored = {n: [t["values"] for t in record[n]["trials"] if t["stage"] == "sobol"] for n in names}
    assert explored["pd-hef"] == explored["pd-hef-smoothed"]
    assert [len(record[n]["trials"]) for n in names] == [4, 4]
    tuned = load_vehicle(tmp_path / "car.toml").filter
    best = record["pd-hef-smoothed"]["trials"][record["pd-hef-smoothed"]["best_trial"]]
    assert tuned["pd-hef-smoothed"] == filter_tuning(tuple(best["values"].values()))

    config = replace(config, vehicle=tmp_path / "car.toml", estimators=("pd-hef-smoothed",), annotate="none")
    rows = run_logs([str(drives / "dlc.mcap")], tmp_path / "out", config).results[0].rows
    (rmse,) = [r.value for r in rows if (r.signal, r.segment, r.metric) == ("sideslip_rad", "all", "rmse")]
    assert math.degrees(rmse) == pytest.approx(record["pd-hef-smoothed"]["rmse_deg"]["dlc"], rel=1e-12)
    assert record["pd-hef-smoothed"]["rmse_deg"] != record["pd-hef"]["rmse_deg"]


def test_processes_change_nothing_and_the_command_prints_json(
    sample_logs_dir: Path, drives: Path, tmp_path: Path
) -> None:
    vehicle = str(sample_logs_dir / "vehicle.toml")
    texts = []
    for jobs in ("1", "2"):
        output = tmp_path / jobs / "car.toml"
        done = subprocess.run(
            [sys.executable, "-m", "pdhef_logtool", "tune", str(drives), "--split", "validation", "--car", vehicle,
             "-o", str(output), "-e", "phy-ukf-tuned", "--trials", "4", "--jobs", jobs, "--json"],
            capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        document = json.loads(done.stdout)
        assert document["estimators"]["phy-ukf-tuned"]["trials"] == 4
        texts.append((output.read_text(), output.with_suffix(".tuning.json").read_text()))
    assert texts[0] == texts[1]


def test_held_out_drives_are_refused(sample_logs_dir: Path, drives: Path, tmp_path: Path) -> None:
    from pdhef_logtool.logs.discovery import find_logs

    with pytest.raises(UsageError, match=r"fishhook \(test\), sweep \(extrapolation\).*--any-split"):
        run_tuning([str(drives)], tmp_path / "car.toml", _settings(sample_logs_dir, split=None))
    assert not list(tmp_path.iterdir())
    logs = find_logs([str(drives)])
    with pytest.raises(UsageError, match=r"fishhook \(test\)"):
        choose_drives(logs, _settings(sample_logs_dir, split="test"), REFUSED)
    with pytest.raises(UsageError, match="expected drives of split train, got drives of extrapolation, test"):
        choose_drives(logs, _settings(sample_logs_dir, split="train"), REFUSED)
    chosen, splits = choose_drives(logs, _settings(sample_logs_dir, split=None, any_split=True), REFUSED)
    assert [c.stem for c in chosen] == ["dlc", "fishhook", "step", "sweep"]
    assert splits["fishhook"] == "test"


def test_a_drive_without_truth_is_left_out_and_told(sample_logs_dir: Path, tmp_path: Path) -> None:
    logs = [str(sample_logs_dir / "dlc.mcap"), str(sample_logs_dir / "no_truth.mcap")]
    told: list[str] = []
    result = run_tuning(
        logs, tmp_path / "car.toml", _settings(sample_logs_dir, split=None, names=("phy-ukf-tuned",)), warn=told.append
    )
    assert result.exit_code == 3
    assert [d.name for d in result.left_out] == ["no_truth"]
    assert any("no_truth is left out" in line for line in told)
    with pytest.raises(EstimatorError, match="at least one drive with a true sideslip"):
        run_tuning(logs[1:], tmp_path / "none.toml", _settings(sample_logs_dir, split=None))


def test_an_unreadable_log_stops_the_command_from_any_process(sample_logs_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    logs = [str(sample_logs_dir / "dlc.mcap"), str(tmp_path / "bad.mcap")]
    settings = _settings(sample_logs_dir, split=None, names=("phy-ukf-tuned",))
    for jobs in (1, 2):
        with pytest.raises(LogError, match=r"bad\.mcap"):
            run_tuning(logs, tmp_path / "car.toml", settings, jobs=jobs)
    assert not (tmp_path / "car.toml").exists()


def test_drives_that_do_not_fit_are_refused(
    sample_logs_dir: Path, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = _settings(sample_logs_dir, names=("phy-ukf-tuned",))
    facts = run_tuning([str(drives)], tmp_path / "car.toml", settings).drives
    assert all(f.bytes_held > 100 * f.counts["scored_stamps"] for f in facts)
    monkeypatch.setattr(tune_drives, "MAX_BYTES", sum(f.bytes_held for f in facts) - 1)
    with pytest.raises(EstimatorError, match="--start and --end"):
        run_tuning([str(drives)], tmp_path / "again.toml", settings)


def test_wrong_options_are_usage_errors(sample_logs_dir: Path, drives: Path, tmp_path: Path) -> None:
    settings = _settings(sample_logs_dir)
    wrong = [
        (replace(settings, trials=3), "at least 4 trials"),
        (replace(settings, seed=-1), "seed"),
        (replace(settings, config=RunConfig()), "a vehicle file"),
        (replace(settings, names=("zero",)), "estimators out of"),
        (replace(settings, names=("pd-hef",)), "a model bundle"),
    ]
    for one, message in wrong:
        with pytest.raises(UsageError, match=message):
            run_tuning([str(drives)], tmp_path / "car.toml", one)
    with pytest.raises(UsageError, match=r"ends in \.toml"):
        run_tuning([str(drives)], tmp_path / "car", settings)
    with pytest.raises(UsageError, match="at least one process"):
        run_tuning([str(drives)], tmp_path / "car.toml", settings, jobs=0)


def test_comments_of_the_vehicle_file_are_kept() -> None:
    comments = {
        "": "Written by hand.\nUnderstood by few.",
        "mass_kg": "weighed # twice",
        "tyres.front.B": "95 %: 1 to 2",
        "sensors.ay_std_m_s2": "data sheet",
    }
    vehicle = default_vehicle().model_copy(update={"name": "a # b"})
    assert read_comments(vehicle_to_toml(vehicle, comments)) == comments
