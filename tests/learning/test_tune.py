"""Stage noise: the search finds an optimum, is the same for all, and its scores are those of a run."""

from __future__ import annotations

import json
import math
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pdhef_logtool.car.car import Car
from pdhef_logtool.evaluation.metrics import score_track
from pdhef_logtool.learning.drives import LearnSettings, choose_drives
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.noise import bench
from pdhef_logtool.learning.noise.bench import choose_names
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
    local_steps,
    score_drives,
    search,
    sobol_points,
)
from pdhef_logtool.records.errors import EstimatorError, LogError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import called, said

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


def test_a_factor_is_a_share_of_its_logarithmic_range_in_four_digits() -> None:
    factor = Factor("p", "1", 0.002, 2.0)
    assert [factor.value(s) for s in (0.0, 0.5, 1.0)] == [0.002, 0.06325, 2.0]
    assert factor.share(0.2) == pytest.approx(2 / 3)


def test_steps_shrink_and_follow_the_first_half_of_the_trials() -> None:
    steps = local_steps(4, 2000, 3)
    widths = [float(np.std(part)) for part in np.array_split(steps, 20)]
    assert widths[0] == pytest.approx(0.146, rel=0.15) and widths[-1] == pytest.approx(0.0205, rel=0.15)
    assert local_steps(4, 0, 3).shape == (0, 4)
    assert not np.array_equal(local_steps(4, 9, 3), local_steps(4, 9, 4))
    assert sobol_points(4, 5, 0).shape == (5, 4) and sobol_points(4, 1, 0).shape == (1, 4)
    np.testing.assert_array_equal(sobol_points(4, 5, 0), sobol_points(4, 8, 0)[:5])
    told: list[int] = []
    found = search(_bowl, ("a",), trials=7, seed=0, progress=told.append)["a"]
    assert told == [1, 2, 3, 4, 5, 6, 7] == [t.number + 1 for t in found]
    assert [t.stage for t in found] == ["sobol"] * 4 + ["refine"] * 3
    tied = [Trial(n, "sobol", (), Score(1.0, 0.0, 0.0)) for n in (3, 1, 2)]
    assert best_trial(tied).number == 1


def test_a_refined_trial_is_a_step_from_the_best_so_far() -> None:
    found = search(_bowl, ("a",), trials=6, seed=2)["a"]
    steps = local_steps(len(FACTORS), 3, 2)
    for i, trial in enumerate(found[3:]):
        best = best_trial(found[: 3 + i])
        at = [np.clip(f.share(v) + s, 0, 1) for f, v, s in zip(FACTORS, best.values, steps[i], strict=True)]
        assert trial.values == tuple(f.value(float(x)) for f, x in zip(FACTORS, at, strict=True))


def test_a_best_value_at_an_end_is_named() -> None:
    factors = (Factor("p", "1", 0.1, 10.0), Factor("q", "1", 0.1, 10.0))
    trial = Trial(0, "sobol", (0.1, 1.0), Score(0.0, 0.0, 0.0))
    assert at_an_end(trial, factors) == ("p",)
    shares = (0.0199, 0.0201, 0.9799, 0.9801)
    ends = [at_an_end(replace(trial, values=(0.1 * 100**s, 1.0)), factors) for s in shares]
    assert ends == [("p",), (), (), ("p",)]


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


def _settings(sample_logs_dir: Path, *, names: tuple[str, ...] | None = None, **changes: object) -> LearnSettings:
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", network=Path("none"), estimators=names)
    settings = LearnSettings(config=config, stages=("noise",), trials=4, split="validation")
    return replace(settings, **changes)  # type: ignore[arg-type]


def _for(settings: LearnSettings, *names: str, **changes: object) -> LearnSettings:
    """Return the settings for estimators, with another configuration."""
    config = replace(settings.config, estimators=names or None, **changes)  # type: ignore[arg-type]
    return replace(settings, config=config)


def test_what_is_written_runs_with_the_scores_that_are_recorded(
    sample_logs_dir: Path, drives: Path, tmp_path: Path
) -> None:
    _bundle().save(tmp_path / "model")
    settings = _settings(sample_logs_dir)
    settings = replace(settings, config=replace(settings.config, network=tmp_path / "model"))
    result = learn([str(drives)], tmp_path / "mycar", settings)
    assert result.exit_code == 0
    assert [d.name for d in result.drives] == ["dlc", "step"]

    before, after = Car.load(sample_logs_dir / "vehicle.toml"), Car.load(tmp_path / "mycar", network=tmp_path / "model")
    assert (after.vehicle, after.trust, after.learnt_on) == (before.vehicle, before.trust, before.learnt_on)
    record = json.loads((tmp_path / "mycar/noise.record.json").read_text())
    part = tomllib.loads((tmp_path / "mycar/noise.toml").read_text())
    assert part["search"]["drives_sha256"] == record["drives_sha256"]
    assert part["search"]["trials"] == record["search"]["trials"] == 4

    names = choose_names(None, before)
    assert set(names) == {"phy-ukf:tuned", "physics"}
    assert set(record["estimators"]) == set(names)
    explored = {n: [t["values"] for t in e["trials"] if t["stage"] == "sobol"] for n, e in record["estimators"].items()}
    assert all(len(record["estimators"][n]["trials"]) == 4 and explored[n] == explored["physics"] for n in names)
    for name in names:
        best = record["estimators"][name]["trials"][record["estimators"][name]["best_trial"]]
        assert best["objective_deg"] == min(t["objective_deg"] for t in record["estimators"][name]["trials"])
        told = {"score_deg": round(best["objective_deg"], 4), "trial": best["trial"]}
        told |= {"physics_sha256": after.physics_sha256}
        assert after.noise[name] == filter_tuning(tuple(best["values"].values())).model_copy(update=told)
        errors = record["estimators"][name]["rmse_deg"]
        assert best["objective_deg"] == pytest.approx(
            math.sqrt(math.hypot(errors["dlc"], 0.05) * math.hypot(errors["step"], 0.05)), rel=1e-9
        )

    config = RunConfig(car=tmp_path / "mycar", network=tmp_path / "model", estimators=names, annotate="none")
    rows = run_logs([str(drives / "dlc.mcap")], tmp_path / "out", config).results[0].rows
    rmse = {r.estimator: r.value for r in rows if (r.signal, r.segment, r.metric) == ("sideslip_rad", "all", "rmse")}
    for name in names:
        assert math.degrees(rmse[name]) == pytest.approx(record["estimators"][name]["rmse_deg"]["dlc"], rel=1e-12)


def test_the_command_prints_a_table_or_json(
    sample_logs_dir: Path, drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["learn", drives, "--stages", "noise", "--split", "validation", "-e", "phy-ukf:tuned", "--trials", 4,
             "--car", sample_logs_dir / "vehicle.toml", "--network", "none", "-o"]  # fmt: skip
    document = said(capsys, *words, tmp_path / "one")
    assert document["stages"][0]["figures"]["estimators"]["phy-ukf:tuned"]["trials"] == 4
    shown = called(*words, tmp_path / "two")
    assert shown.returncode == 0 and "4 trials of each estimator" in shown.stdout
    for name in ("noise.toml", "noise.record.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_held_out_drives_are_refused(sample_logs_dir: Path, drives: Path, tmp_path: Path) -> None:
    from pdhef_logtool.logs.discovery import find_logs

    with pytest.raises(UsageError, match=r"fishhook \(test\), sweep \(extrapolation\).*--any-split"):
        learn([str(drives)], tmp_path / "car", _settings(sample_logs_dir, split=None))
    assert not list(tmp_path.iterdir())
    logs = find_logs([str(drives)])
    with pytest.raises(UsageError, match=r"fishhook \(test\)"):
        choose_drives(logs, _settings(sample_logs_dir, split="test"))
    with pytest.raises(UsageError, match="expected drives of split train, got drives of extrapolation, test"):
        choose_drives(logs, _settings(sample_logs_dir, split="train"))
    chosen, splits = choose_drives(logs, _settings(sample_logs_dir, split=None, any_split=True))
    assert [c.stem for c in chosen] == ["dlc", "fishhook", "step", "sweep"]
    assert splits["fishhook"] == "test"


def test_a_drive_without_truth_is_left_out_and_told(sample_logs_dir: Path, tmp_path: Path) -> None:
    logs = [str(sample_logs_dir / "dlc.mcap"), str(sample_logs_dir / "no_truth.mcap")]
    told: list[str] = []
    result = learn(
        logs,
        tmp_path / "car",
        _settings(sample_logs_dir, split=None, names=("phy-ukf:tuned",)),
        reporter=Reporter(warn=told.append),
    )
    assert result.exit_code == 3
    assert [d.name for d in result.left_out] == ["no_truth"]
    assert [d["reason"] for d in result.to_dict()["left_out"]] == ["no true sideslip"]
    assert not any("reason" in d for d in result.to_dict()["drives"])
    assert any("no_truth is left out" in line for line in told)
    with pytest.raises(EstimatorError, match="at least one drive with a true sideslip"):
        learn(logs[1:], tmp_path / "none", _settings(sample_logs_dir, split=None))


def test_an_unreadable_log_stops_the_command(sample_logs_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    logs = [str(sample_logs_dir / "dlc.mcap"), str(tmp_path / "bad.mcap")]
    with pytest.raises(LogError, match=r"bad\.mcap"):
        learn(logs, tmp_path / "car", _settings(sample_logs_dir, split=None, names=("phy-ukf:tuned",)))
    assert not (tmp_path / "car").exists()


def test_drives_that_do_not_fit_are_refused(
    sample_logs_dir: Path, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = _settings(sample_logs_dir, names=("phy-ukf:tuned",))
    facts = learn([str(drives)], tmp_path / "car", settings).drives
    assert all(f.bytes_held > 100 * f.counts["scored_stamps"] for f in facts)
    monkeypatch.setattr(bench, "MAX_BYTES", sum(f.bytes_held for f in facts) - 1)
    with pytest.raises(EstimatorError, match="--start and --end"):
        learn([str(drives)], tmp_path / "again", settings)


def test_wrong_options_are_usage_errors(sample_logs_dir: Path, drives: Path, tmp_path: Path) -> None:
    settings = _settings(sample_logs_dir)
    wrong = [
        (replace(settings, config=RunConfig()), "a car"),
        (_for(settings, "zero"), "estimators out of"),
        (_for(settings, "pd-hef"), "estimators out of"),
    ]
    with pytest.raises(UsageError, match="at least 4 trials"):
        replace(settings, trials=3)
    with pytest.raises(UsageError, match="seed"):
        replace(settings, seed=-1)
    for one, message in wrong:
        with pytest.raises(UsageError, match=message):
            learn([str(drives)], tmp_path / "car", one)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("no car")
    with pytest.raises(UsageError, match="a car's folder"):
        learn([str(drives)], tmp_path / "other", settings)


def test_noise_of_an_earlier_search_stays_without_its_score(sample_logs_dir: Path, tmp_path: Path) -> None:
    log = [str(sample_logs_dir / "dlc.mcap")]
    settings = _settings(sample_logs_dir, split=None)
    learn(log, tmp_path / "mycar", _for(settings, "physics"))
    first = Car.load(tmp_path / "mycar").noise["physics"]
    assert first.score_deg is not None
    again = _for(settings, "phy-ukf:tuned", car=tmp_path / "mycar")
    learn(log, tmp_path / "mycar", again)
    noise = Car.load(tmp_path / "mycar").noise
    # It is as good as it was, but was not compared with the other on the same drives.
    assert noise["physics"] == first.model_copy(update={"score_deg": None})
    assert noise["phy-ukf:tuned"].score_deg is not None
    learn(log, tmp_path / "mycar", again)
    assert Car.load(tmp_path / "mycar").noise == noise


def test_the_vehicle_file_is_kept_byte_by_byte(sample_logs_dir: Path, tmp_path: Path) -> None:
    text = (sample_logs_dir / "vehicle.toml").read_text()
    (tmp_path / "guess.toml").write_text("# Written by hand.\n" + text.replace("1440.0", "1440.0  # weighed # twice"))
    settings = _for(_settings(sample_logs_dir, split=None), "phy-ukf:tuned", car=tmp_path / "guess.toml")
    learn([str(sample_logs_dir / "dlc.mcap")], tmp_path / "mycar", settings)
    assert (tmp_path / "mycar/vehicle.toml").read_bytes() == (tmp_path / "guess.toml").read_bytes()
