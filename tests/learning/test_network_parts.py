"""Extraction and training step by step: rows, splits, batches, rates, epochs, on numbers worked out by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
import torch
from matplotlib.figure import Figure
from residual_car import CAR, START_NS, drive, window

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.learning.network import baselines, extract_command, fit, train_command
from pdhef_logtool.learning.network.baselines import SideslipSequence, fit_dataset, run_baselines
from pdhef_logtool.learning.network.cells import EVERYTHING, Picked
from pdhef_logtool.learning.network.dataset import (
    DriveArrays,
    drive_file,
    read_dataset,
    read_entry,
    vehicle_entry,
    write_drive,
    write_manifest,
)
from pdhef_logtool.learning.network.extract_command import ExtractSettings
from pdhef_logtool.learning.network.fit import CHECKPOINT, Epoch, FeatureSequence, Recipe, normalisation_of, train
from pdhef_logtool.learning.network.residuals import (
    ResidualRows,
    difference_noise,
    residual_rows,
    smooth_increments,
)
from pdhef_logtool.learning.network.train_command import gap_free_runs, make_recipe, mean_square, train_on
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping.recognition import PERFECT_PREFIX
from pdhef_logtool.records.errors import EstimatorError, ModelError, OutputError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.residual_model.bundle import LATERAL_VELOCITY, ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES, NOMINAL_FEATURES
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.storage.documents import seal
from pdhef_logtool.workers.supervisor import Ended, Failure

TINY = Recipe(FEATURES[:2], hidden=3, layers=1, head=(2,), epochs=9, batch=2, patience=3, learning_rate=1e-2)


# ---- residuals ----


def test_without_truth_there_are_features_and_no_targets() -> None:
    whole = window(drive(2.0))
    rows = residual_rows(whole.signals, None, PhysicsFilter(CAR), period_s=0.01)
    with_truth = residual_rows(whole.signals, whole.truth, PhysicsFilter(CAR), period_s=0.01)
    np.testing.assert_array_equal(rows.features, with_truth.features)
    assert np.isnan(rows.targets).all() and np.isnan(rows.truth_velocity).all() and not rows.weight.any()
    np.testing.assert_allclose(rows.step_s[:-1], 0.01)
    assert math.isnan(rows.step_s[-1])


def test_noise_of_differences_needs_eight_stamps_without_gaps() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 0.01, 4000)
    stamps = START_NS + np.arange(4000) * 10_000_000
    assert math.isnan(difference_noise(stamps[:7], values[:7]))
    assert difference_noise(stamps[:8], values[:8]) > 0.0
    # Third differences of ± 1 are ± 8, whose size is taken for the 80 % point of a normal one.
    sign = np.where(np.arange(40) % 2, -1.0, 1.0)
    expected = math.sqrt(2.0) * 8.0 / (1.2815515655446004 * math.sqrt(20.0)) / 0.01
    assert difference_noise(stamps[:40], sign) == pytest.approx(expected)
    assert math.isnan(difference_noise(stamps[:8], np.where(np.arange(8) == 3, np.nan, values[:8])))
    jumped = stamps[:40] + np.where(np.arange(40) >= 20, 6_000_000, 0)  # a step of 1.6 periods
    assert difference_noise(jumped, np.where(np.arange(40) >= 20, 1e3, 0.0) + sign) == pytest.approx(expected)


def test_a_window_as_long_as_the_data_still_gives_its_middle() -> None:
    stamps = START_NS + np.arange(6) * 10_000_000
    increments = np.arange(10.0).reshape(5, 2)
    out = smooth_increments(stamps, increments, 2)
    assert np.isfinite(out).all(axis=1).tolist() == [False, False, True, False, False]
    np.testing.assert_allclose(out[2], increments[2])
    assert np.isnan(smooth_increments(stamps[:5], increments[:4], 2)).all()


# ---- the dataset ----


def made_rows(count: int = 120, **changes: Any) -> ResidualRows:
    rng = np.random.default_rng(count)
    stamps = START_NS + np.cumsum(np.full(count, 10_000_000))
    weight = np.ones(count)
    weight[-1] = 0.0
    columns: dict[str, Any] = {
        "stamps_ns": stamps,
        "features": rng.normal(size=(count, len(FEATURES))),
        "targets": rng.normal(size=(count, 2)),
        "step_s": np.append(np.diff(stamps) * 1e-9, np.nan),
        "weight": weight,
        "segment": np.zeros(count, dtype=np.int64),
        "truth_velocity": np.stack([np.full(count, 20.0), rng.normal(0.0, 0.3, count)], axis=1),
        "truth_std_rad": np.full(count, 0.001),
        "region": np.ones(count),
    }
    return ResidualRows(**{**columns, **changes})


def entry_of(log: str, split: str, rows: ResidualRows, period_s: float = 0.01) -> dict[str, Any]:
    return {
        "name": log, "log": log, "split": split, "rows": len(rows), "usable_rows": int(rows.weight.sum()),
        "period_s": period_s, "signals_sha256": None, "cells": {"3": 10}, "car": "test car",
        "vehicle_sha256": "f" * 64, "source": {"file": log, "sha256": log}, "start_s": 0.0, "end_s": 1.0,
    }  # fmt: skip


SETTINGS = {"a": 1, "model": "physics"}


def write_dataset(folder: Path, **drives: tuple[str, ResidualRows]) -> None:
    entries = []
    for log, (split, rows) in drives.items():
        entries.append(entry_of(log, split, rows, 0.02 if log == "z" else 0.01))
        write_drive(drive_file(folder, entries[-1]), rows, EVERYTHING.of(rows), entries[-1], rows_a_group=50)
    write_manifest(
        folder,
        entries,
        [],
        settings=SETTINGS,
        seed=3,
        vehicles={"f" * 64: vehicle_entry("f" * 64, CAR)},
    )


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    rows = made_rows()
    features, targets, weight = rows.features.copy(), rows.targets.copy(), rows.weight.copy()
    features[5] = np.nan  # the filter has no state
    targets[9] = np.nan
    weight[[5, 9]] = 0.0
    segment = np.where(np.arange(120) < 60, 0, 1)
    rows = replace(rows, features=features, targets=targets, weight=weight, segment=segment)
    other = made_rows(40)
    write_dataset(tmp_path, z=("train", rows), b=("train", other), c=("extra", other))
    document = json.loads((tmp_path / "manifest.json").read_text())
    assert len(document.pop("digest")) == 64
    assert [d["log"] for d in document["drives"]] == ["b", "c", "z"]
    assert document["splits"] == {
        "train": {"drives": 2, "rows": 160, "usable_rows": 156},
        "validation": {"drives": 0, "rows": 0, "usable_rows": 0},
        "test": {"drives": 0, "rows": 0, "usable_rows": 0},
        "extra": {"drives": 1, "rows": 40, "usable_rows": 39},
    }
    assert (document["period_s"], document["seed"], document["settings"]) == (0.01, 3, SETTINGS)
    file = "split=train/car=test-car-ffffffff/part-z.parquet"
    assert document["drives"][2]["file"] == file
    assert read_entry(tmp_path / file) == entry_of("z", "train", rows, 0.02)
    assert document["cells"]["usable_s"]["train"][3] == pytest.approx(0.3) and document["choice"] is None
    data = read_dataset(tmp_path)
    assert data.vehicle_name == "test car" and data.vehicle(data.drives[0]) == CAR
    found = data.drives[2].load()
    kept = np.delete(np.arange(120), 5)
    np.testing.assert_array_equal(found.stamps_ns, rows.stamps_ns[kept])
    np.testing.assert_array_equal(found.features, rows.features[kept].astype(np.float32))
    np.testing.assert_array_equal(found.segment, segment[kept])
    np.testing.assert_array_equal(found.weight, weight[kept])
    np.testing.assert_array_equal(found.truth_velocity, rows.truth_velocity[kept].astype(np.float32))
    used = weight[kept] > 0
    np.testing.assert_array_equal(found.targets[used], rows.targets[kept][used].astype(np.float32))
    assert not found.targets[~used].any()
    np.testing.assert_allclose(found.step_s, [*[0.01] * 118, 0.02])  # the period at the last row
    for wrong in ({"features": document["features"][::-1]}, {"version": 1}, {"drives": [{}]}):
        (tmp_path / "manifest.json").write_text(json.dumps({**document, **wrong}))
        with pytest.raises(OutputError, match="extract"):
            read_dataset(tmp_path)
    frame = pl.read_parquet(tmp_path / file, hive_partitioning=False)
    assert frame["target_dvy_m_s"].null_count() == 1 and frame[FEATURES[0]].null_count() == 1
    groups = pl.read_parquet_metadata(tmp_path / file)
    assert groups["pdhef.drive"] == json.dumps(seal(entry_of("z", "train", rows, 0.02)), sort_keys=True)
    sound = (tmp_path / file).read_bytes()
    table = pq.read_table(tmp_path / file, partitioning=None)
    for at in range(200, len(sound), len(sound) // 40):
        (tmp_path / file).write_bytes(sound[:at] + bytes([sound[at] ^ 4]) + sound[at + 1 :])
        if (entry := read_entry(tmp_path / file)) is not None:
            assert entry == entry_of("z", "train", rows, 0.02)
            assert pq.read_table(tmp_path / file, partitioning=None).equals(table)
        with pytest.raises(OutputError, match="another content"):
            data.drives[2].load()
    with pytest.raises(OutputError, match="another content"):  # adding drives does not make a damaged one sound
        write_manifest(tmp_path, document["drives"], [], settings=SETTINGS, seed=3, vehicles={})


def test_a_drives_file_has_groups_of_rows_and_a_damaged_or_absent_one_has_no_entry(tmp_path: Path) -> None:
    rows = made_rows(170)
    for name in ("a.parquet", "b.parquet"):
        write_drive(tmp_path / name, rows, EVERYTHING.of(rows), {}, rows_a_group=50)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    metadata = pq.read_metadata(tmp_path / "a.parquet")
    assert [metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)] == [50, 50, 50, 20]
    assert read_entry(tmp_path / "gone.parquet") is None
    (tmp_path / "text.parquet").write_text("text")
    assert read_entry(tmp_path / "text.parquet") is None
    with pytest.raises(OutputError, match="extract it again"):
        write_manifest(tmp_path, [entry_of("x", "train", rows)], [], settings=SETTINGS, seed=0, vehicles={})


# ---- extract ----


def test_settings_say_what_decides_a_dataset() -> None:
    plain = ExtractSettings(RunConfig(car=Path("a/b.toml"), end="5"))
    assert plain.to_dict() == {
        "car": "b.toml", "mapping": None, "start": None, "end": "5", "sensors": "full", "prefer_truth": "perfect",
        "truth_smoothing": "auto", "split": None, "model": "physics", "where": None, "per_cell_s": None,
    }  # fmt: skip
    varied = ExtractSettings(RunConfig(friction=0.5), vary=0.1, seed=7).to_dict()
    assert (varied["friction"], varied["vary"], varied["vary_seed"]) == (0.5, 0.1, 7)
    half = [ExtractSettings(RunConfig(), truth_smoothing=t).smoothing_half_s() for t in ("auto", "none", "0.2", "1")]
    assert half == [None, 0.0, 0.2, 1.0]
    for wrong in ("0", "1.01", "-0.1", "nan", "x"):
        with pytest.raises(UsageError, match="--truth-smoothing"):
            ExtractSettings(RunConfig(), truth_smoothing=wrong).smoothing_half_s()


def test_a_manifest_gives_split_and_vehicle_file(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text("")
    log = LogInput(tmp_path / "a.mcap", "a")
    listed = extract_command._listed(log, {"a.mcap": {"split": "test", "vehicle_file": "car.toml", "vehicle": "x"}})
    assert (listed.split, listed.vehicle) == ("test", tmp_path / "car.toml")
    assert extract_command._listed(log, {"a.mcap": {"vehicle": "car.toml"}}).vehicle == tmp_path / "car.toml"
    for entry in ({}, {"split": "", "vehicle": "gone.toml"}, {"split": 3, "vehicle": "car"}):
        found = extract_command._listed(log, {"a.mcap": entry})
        assert (found.split, found.vehicle) == (None, None)


def test_a_plan_needs_three_true_states_and_the_filters_signals() -> None:
    needed = {"vx_m_s": "x", "vy_m_s": "x", "yaw_rate_rad_s": "x"}
    available = frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})
    plan: Any = SimpleNamespace(truth=object(), derivation=needed, alignment=SimpleNamespace(available=available))
    job: Any = SimpleNamespace(log_input=LogInput(Path("a.mcap"), "a"))
    extract_command._check_plan(plan, job)
    for changes in ({"truth": None}, {"derivation": {"vx_m_s": "x", "ay_m_s2": "x"}}):
        without = SimpleNamespace(**{**plan.__dict__, **changes})
        with pytest.raises(EstimatorError, match="ground truth from which"):
            extract_command._check_plan(without, job)
        extract_command._check_plan(without, job, estimated=True)
    plan.alignment.available = available - {"ay_m_s2"}
    with pytest.raises(EstimatorError, match="no ay_m_s2"):
        extract_command._check_plan(plan, job)


def test_a_truth_within_the_limits_is_not_smoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = {"vy": 0.05, "r": 0.05}
    track = SimpleNamespace(stamps_ns=None, vy_m_s="vy", yaw_rate_rad_s="r")
    monkeypatch.setattr(extract_command, "derive_truth", lambda *_, **__: SimpleNamespace(track=track))
    monkeypatch.setattr(extract_command, "difference_noise", lambda _stamps, column: noise[column])
    plan: Any = SimpleNamespace(survey_truth=None, truth=None)

    def half_s(asked: str = "auto") -> tuple[float, tuple[float, float]]:
        found = extract_command._choose_smoothing(plan, ExtractSettings(RunConfig(), truth_smoothing=asked))
        return found.half_s, found.noise

    assert half_s() == (0.0, (0.05, 0.05))
    noise["r"] = 0.051
    assert half_s() == (0.15, (0.05, 0.051))
    assert half_s("none")[0] == 0.0 and half_s("0.3")[0] == 0.3
    noise.update(vy=math.nan, r=0.0)
    assert half_s()[0] == 0.15


def test_perfect_truth_is_called_so_only_when_all_of_it_is() -> None:
    def facts(*topics: str) -> dict[str, Any]:
        truth = {str(i): SimpleNamespace(topic=t) for i, t in enumerate(topics)}
        plan: Any = SimpleNamespace(
            mapping=SimpleNamespace(truth=truth), derivation={"vy_m_s": "x"}, truth_latency_s=0.1, dependent={"a": "b"}
        )
        return extract_command._truth_facts(plan, extract_command._Smoothing(0.15, "why", (0.5, math.nan)))

    perfect = f"{PERFECT_PREFIX}x"
    kinds = [facts(*t)["kind"] for t in ((perfect, perfect), (perfect, "/ins"), ("/ins",), ())]
    assert kinds == ["perfect", "recorded", "recorded", "recorded"]
    assert facts("/ins") == {
        "kind": "recorded", "quantities": {"vy_m_s": "x"}, "latency_s": 0.1, "smoothing_half_s": 0.15,
        "smoothing_reason": "why", "not_independent": {"a": "b"},
        "difference_noise": {"vy_dot_m_s2": 0.5, "yaw_acceleration_rad_s2": None},
    }  # fmt: skip


def test_counts_are_sums_over_the_usable_rows() -> None:
    picked = Picked(np.arange(8) % 4 != 2, np.full(8, 2, dtype=np.int16), np.zeros(8, "f4"))
    rows = made_rows(
        8,
        stamps_ns=START_NS + np.arange(8) * 10_000_000,
        targets=np.stack([np.repeat([0.03, 0.04], 4), np.full(8, 0.01)], axis=1),
        step_s=np.full(8, 0.01),
        weight=np.tile([1.0, 1.0, 1.0, 0.0], 2),
        segment=np.repeat([0, 8, 4, 8], [3, 1, 3, 1]),
    )
    found = extract_command._counts(rows, picked, START_NS - 10**9)
    rms = found.pop("residual_rms")
    cells = {"2": 4}  # of those that the condition chooses
    span = {"start_s": pytest.approx(1.0), "end_s": pytest.approx(1.07), "duration_s": pytest.approx(0.07)}
    assert found == {**span, "rows": 8, "usable_rows": 6, "segments": 2, "cells": cells}
    assert rms == {"vy_dot_m_s2": pytest.approx(math.sqrt(12.5)), "yaw_acceleration_rad_s2": pytest.approx(1.0)}
    unused = extract_command._counts(replace(rows, weight=np.zeros(8)), picked, START_NS)
    assert (unused["usable_rows"], unused["cells"], set(unused["residual_rms"].values())) == (0, {}, {None})


def _job(name: str, **changes: Any) -> Any:
    values = {"settings": ExtractSettings(RunConfig()), "car": Car.of(CAR), "mapping": None, "listed_split": None}
    job = extract_command._Job(LogInput(Path(f"{name}.mcap"), name), Path("out"), resume=False, **values)
    return replace(job, **changes)


def test_a_fingerprint_follows_all_that_decides_a_file_and_nothing_else(tmp_path: Path) -> None:
    mapping = tmp_path / "m.toml"
    mapping.write_text("a = 1")
    job = _job("a", settings=ExtractSettings(RunConfig(mapping=mapping)))
    same = extract_command._fingerprint(job, "train")
    copy = tmp_path / "n.toml"
    copy.write_text("a = 1")
    renamed = replace(job, settings=ExtractSettings(RunConfig(mapping=copy, car=Path("x.toml")), split="train"))
    assert extract_command._fingerprint(renamed, "train") == same
    others = [
        (job, "test"),
        (replace(job, car=Car.of(CAR.model_copy(update={"mass_kg": 1501.0}))), "train"),
        (replace(job, settings=ExtractSettings(RunConfig(mapping=mapping), truth_smoothing="none")), "train"),
        (replace(job, settings=ExtractSettings(RunConfig())), "train"),
        (replace(job, settings=replace(job.settings, where="vx_m_s > 1")), "train"),
        (replace(job, settings=replace(job.settings, seed=1)), "train"),
    ]
    # What is chosen of the cells is said by the manifest alone.
    assert extract_command._fingerprint(replace(job, settings=replace(job.settings, per_cell_s=9.0)), "train") == same
    copy.write_text("a = 2")
    others.append((renamed, "train"))
    assert len({same, *(extract_command._fingerprint(*o) for o in others)}) == 8


def test_a_process_that_dies_costs_its_own_drive_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def supervise_(_work: Any, items: Any, *, jobs: int, **_: Any) -> Iterator[Ended[Any, Any]]:
        assert jobs == 2
        for number, item in enumerate(items):
            lost = Failure("the worker was killed (signal 9)", "", 2) if number == 1 else None
            yield Ended(number, item, None if lost else extract_command._failure(item, "fine"), lost)

    monkeypatch.setattr(extract_command, "supervise", supervise_)
    found = extract_command._run_jobs([_job(name) for name in "abc"], 2, Reporter(warn=print))
    assert sorted((r.record.name, r.record.left_out) for r in found) == [
        ("a", "fine"), ("b", "the worker was killed (signal 9)"), ("c", "fine"),
    ]  # fmt: skip


def test_progress_of_several_drives_at_once_adds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def extract(job: Any, progress: Any) -> Any:
        progress(0.5)
        return extract_command._failure(job, "fine")

    monkeypatch.setattr(extract_command, "_extract", extract)
    told: list[tuple[str, float]] = []
    list(extract_command._run_jobs([_job("a"), _job("b")], 1, Reporter(lambda *what: told.append(what), print)))
    assert told == [("a", 0.25), ("b", 0.75)]


def test_an_error_of_one_log_is_a_reason_and_of_the_only_log_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(job: Any, _progress: Any) -> Any:
        name = job.log_input.stem
        raise ModelError(expected="x", got="y", where=name) if name == "a" else KeyError("k")

    monkeypatch.setattr(extract_command, "_extract", fail)
    found = list(extract_command._run_jobs([_job("a"), _job("b")], 1, Reporter(warn=print)))
    assert "expected x" in found[0].record.left_out
    assert found[1].record.left_out == "internal error, KeyError: 'k'"
    assert (found[0].record.file, found[0].entry, found[0].kept) == ("a.mcap", None, False)
    with pytest.raises(ModelError):
        list(extract_command._run_jobs([_job("a")], 4, Reporter(warn=print)))


def test_an_empty_split_is_told_and_a_default_car_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "ab":
        (tmp_path / f"{name}.mcap").write_bytes(b"")

    def one(job: Any, _progress: Any) -> Any:
        assert not (job.output / "manifest.json").exists()  # while drives are written, the old one is not true
        rows, split = made_rows(60), "train" if job.log_input.stem == "a" else "test"
        entry = {**entry_of(job.log_input.stem, split, rows), "vehicle_sha256": job.physics[0]}
        write_drive(drive_file(job.output, entry), rows, EVERYTHING.of(rows), entry)
        return replace(extract_command._failure(job, ""), entry=entry)

    monkeypatch.setattr(extract_command, "_extract", one)
    warned: list[str] = []
    settings = ExtractSettings(RunConfig())
    result = extract_command.extract([str(tmp_path)], tmp_path / "out", settings, reporter=Reporter(warn=warned.append))
    assert warned == [
        "no --car: residuals refer to the default sedan",
        "no drive is in validation: with few drives choose with --split, or another --seed",
    ]
    assert result.exit_code == 0
    assert [v["name"] for v in result.manifest["vehicles"]] == ["sedan"]
    warned.clear()
    chosen = replace(settings, split="train", config=RunConfig(car=Path("saloon")))
    extract_command.extract([str(tmp_path)], tmp_path / "out", chosen, reporter=Reporter(warn=warned.append))
    assert warned == []
    with pytest.raises(UsageError, match="--jobs"):
        extract_command.extract([str(tmp_path)], tmp_path / "new", settings, jobs=0)
    (tmp_path / "new").mkdir()
    (tmp_path / "new/manifest.json").write_text("no json")
    with pytest.raises(UsageError, match="another manifest"):
        extract_command.extract([str(tmp_path)], tmp_path / "new", settings)


# ---- training ----


def sequence(count: int, value: float = 1.0, drive: str = "a") -> FeatureSequence:
    features = np.zeros((count, len(FEATURES)))
    features[:, 0] = np.arange(count) % 5
    features[:, 1] = value
    return FeatureSequence(drive, features, np.tile([value, -2.0 * value], (count, 1)), np.ones(count))


def test_normalisation_is_by_weight_and_keeps_the_targets_zero() -> None:
    one = sequence(4, 3.0)
    one.weight[3] = 0.0
    found = normalisation_of([one, sequence(1, 1.0)], FEATURES[:2])
    assert found.feature_mean == pytest.approx(((0 + 1 + 2 + 0) / 4, (3 + 3 + 3 + 1) / 4))
    assert found.feature_std == pytest.approx((np.std([0, 1, 2, 0]), np.std([3, 3, 3, 1])))
    assert found.target_std == pytest.approx((math.sqrt(28 / 4), math.sqrt(4 * 28 / 4)))
    flat = normalisation_of([sequence(3, 0.0)], FEATURES[1:2])
    assert (flat.feature_std, flat.target_std) == ((1e-6,), (1e-6, 1e-6))
    with pytest.raises(ModelError, match="none"):
        normalisation_of([replace(one, weight=np.zeros(4))], FEATURES[:2])


def test_long_sequences_are_cut_and_what_teaches_nothing_is_left_out() -> None:
    long = sequence(3100, 2.0)
    long.weight[1500:3000] = 0.0
    n = Normalisation((1.0, 0.0), (2.0, 1.0), (4.0, 8.0))
    first, last = fit._pieces(long, TINY, n)
    assert (len(first.features), len(last.features)) == (1500, 100)
    assert first.features[:2].tolist() == [[-0.5, 2.0], [0.0, 2.0]]
    assert first.target[0].tolist() == [0.5, -0.5]
    assert first.target.dtype == torch.float32
    # A mean square of 0.25 and the floor.
    assert (float(first.weight[0]), float(last.weight.sum())) == pytest.approx((1 / 0.35, 100 / 0.35))
    padded = fit._padded([first, last], "cpu")
    assert padded.features.shape == (2, 1500, 2) and not padded.weight[1, 100:].any()


class Constant(torch.nn.Module):
    """Says ``level`` for both targets, and remembers the states that it was given."""

    def __init__(self, level: float) -> None:
        super().__init__()
        self.level = torch.nn.Parameter(torch.tensor(level))
        self.states: list[Any] = []

    def forward(self, features: torch.Tensor, state: Any) -> Any:
        self.states.append(state)
        after = self.level * torch.ones(1) * len(self.states)
        return self.level.expand(*features.shape[:2], 2), (after, after)


def _piece(target: list[float], weight: list[float]) -> Any:
    column = torch.tensor(target)[:, None].repeat(1, 2)
    return fit._Piece(torch.zeros(len(target), 1), column, torch.tensor(weight))


@pytest.mark.slow  # loads what optimisers need
def test_a_batch_runs_in_chunks_with_the_state_carried_but_not_its_gradient() -> None:
    network: Any = Constant(0.0)
    still = torch.optim.SGD(network.parameters(), lr=0.0)
    piece = _piece([1.0, 2.0, 3.0, 4.0, 9.0, 5.0], [1.0, 1.0, 1.0, 0.5, 0.0, 0.0])
    loss = fit._train_batch(network, still, [piece], 2, "cpu")
    # (1 + 4)/2 and (9 + 16/2)/1.5; the last chunk weighs nothing.
    assert loss == pytest.approx((2.5 + 17.0 / 1.5) / 2)
    assert network.states[0] is None and [s[0].item() for s in network.states[1:]] == [0.0, 0.0]
    assert not any(s[i].requires_grad for s in network.states[1:] for i in (0, 1))
    # The gradient of both chunks is far beyond 1: each moves the parameter by the rate.
    moving = torch.optim.SGD(network.parameters(), lr=0.1)
    fit._train_batch(network, moving, [_piece([50.0] * 4, [1.0] * 4)], 2, "cpu")
    assert network.level.item() == pytest.approx(0.2, rel=1e-4)
    assert fit._train_batch(network, moving, [_piece([1.0], [0.0])], 2, "cpu") == 0.0


def test_validation_is_the_weighted_mean_over_all_drives() -> None:
    network: Any = Constant(1.0).train()
    pieces = [_piece([1.0, 3.0], [1.0, 1.0]), _piece([4.0, 9.0], [2.0, 0.0])]
    assert fit._validate(network, pieces, "cpu", None) == pytest.approx((0 + 4 + 2 * 9) / 4)
    assert not network.training
    assert fit._validate(network, [_piece([4.0], [0.0])], "cpu", None) == math.inf
    # What says the same to left and right says nothing, made odd.
    assert fit._validate(network, pieces, "cpu", -torch.ones(1)) == pytest.approx((1 + 9 + 2 * 16) / 4)


def test_the_rate_goes_up_for_three_tenths_and_down_to_nothing_or_decays() -> None:
    recipe = replace(TINY, learning_rate=2.0)
    rates = [fit._learning_rate(recipe, s) for s in (0.0, 0.15, 0.2999999, 0.3, 0.5, 0.65, 1.0)]
    half = 2.0 * (1e-4 + 0.9999 * (0.5 + 0.5 * math.cos(math.pi * 2.0 / 7.0)))
    assert rates == pytest.approx([0.08, 1.04, 2.0, 2.0, half, 1.0001, 2e-4], rel=1e-6)
    slow = replace(recipe, schedule="exponential")
    assert [fit._learning_rate(slow, s) for s in (0.0, 1.0)] == pytest.approx([2.0, 2.0 * math.exp(-3.0)])


def _scripted(monkeypatch: pytest.MonkeyPatch, losses: list[float]) -> list[list[Any]]:
    """Train with given validation losses; every batch adds 1 to the first bias. Return the batches by epoch."""
    batches: list[list[Any]] = [[]]
    left = list(losses)

    def batch(network: Any, optimiser: Any, pieces: Any, chunk_steps: int, _device: str) -> float:
        assert chunk_steps == 50 and network.training
        batches[-1].append((optimiser.param_groups[0]["lr"], [int(p.weight[0]) for p in pieces]))
        with torch.no_grad():
            network.head[0].bias += 1.0
        return float(len(batches[-1]))

    def validate(*_: Any) -> float:
        batches.append([])
        return left.pop(0)

    monkeypatch.setattr(fit, "_train_batch", batch)
    monkeypatch.setattr(fit, "_validate", validate)
    monkeypatch.setattr(fit, "_balanced", lambda piece: piece)  # a piece is known by its weight
    return batches


def _numbered(count: int) -> list[FeatureSequence]:
    return [replace(sequence(60, i + 1.0, f"d{i}"), weight=np.full(60, i + 1.0)) for i in range(count)]


@pytest.mark.slow  # loads what optimisers need
def test_training_stops_when_patience_ends_and_keeps_the_best_epoch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = _scripted(monkeypatch, [3.0, 2.0, 1.0, 1.0, 4.0, 5.0, 0.1])
    told: list[tuple[int, int]] = []
    training = _numbered(5)
    bundle, history = train(training, training[:2], TINY, tmp_path, progress=lambda e, of: told.append((e.epoch, of)))
    assert told == [(i, 9) for i in range(1, 7)]
    assert [e.epoch for e in history] == [1, 2, 3, 4, 5, 6]
    assert [e.validation_loss for e in history] == [3.0, 2.0, 1.0, 1.0, 4.0, 5.0]
    assert [e.train_loss for e in history] == [2.0] * 6
    p = bundle.provenance
    assert (p["epochs"], p["best_epoch"], p["validation_loss"]) == (6, 3, 1.0)
    assert (p["training_sequences"], p["validation_sequences"]) == (5, 2)
    assert p["training_hours"] == pytest.approx(300 * 0.01 / 3600.0, abs=5e-4)
    # Each epoch sees every piece once, in three batches of at most two, in an order of its own.
    orders = [[i for _, chosen in epoch for i in chosen] for epoch in batches[:6]]
    assert all(sorted(o) == [1, 2, 3, 4, 5] for o in orders) and len({tuple(o) for o in orders}) > 1
    assert [len(chosen) for _, chosen in batches[0]] == [2, 2, 1]
    rates = [rate for epoch in batches[:6] for rate, _ in epoch]
    assert rates == pytest.approx([fit._learning_rate(TINY, k / 3 / 9) for k in range(18)])
    assert [e.learning_rate for e in history] == pytest.approx(rates[2::3])
    fresh = fit._weights(fit._new_network(TINY, None))
    np.testing.assert_allclose(bundle.weights["head.0.bias"] - fresh["head.0.bias"], 9.0, rtol=1e-6)
    assert (bundle.feature_names, bundle.hidden, bundle.period_s) == (FEATURES[:2], 3, 0.01)
    assert bundle.normalisation == normalisation_of(training, FEATURES[:2], odd=True)
    assert bundle.odd and bundle.normalisation.feature_mean[1] == 0.0
    # What is found done is not done again.
    again, same = train(training, training[:2], TINY, tmp_path)
    assert (again.sha256, same) == (bundle.sha256, history)


@pytest.mark.slow  # loads what optimisers need
def test_an_interrupted_training_goes_on_with_its_weights_and_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = _numbered(2)
    seeds: list[int] = []
    monkeypatch.setattr(torch, "randperm", lambda n: (seeds.append(torch.initial_seed()), torch.arange(n))[1])

    def stop(epoch: Epoch, _of: int) -> None:
        if epoch.epoch == 2:
            raise KeyboardInterrupt

    _scripted(monkeypatch, [1.0, 2.0])
    with pytest.raises(KeyboardInterrupt):
        train(training, training, replace(TINY, seed=2), tmp_path, progress=stop)
    _scripted(monkeypatch, [3.0, 0.5, 4.0, 4.0, 4.0])
    bundle, history = train(training, training, replace(TINY, seed=2), tmp_path)
    assert [e.validation_loss for e in history] == [1.0, 2.0, 3.0, 0.5, 4.0, 4.0, 4.0]
    assert seeds == [2 * 1_000_003 + k for k in range(7)]
    fresh = fit._weights(fit._new_network(replace(TINY, seed=2), None))
    np.testing.assert_allclose(bundle.weights["head.0.bias"] - fresh["head.0.bias"], 4.0, rtol=1e-6)
    _scripted(monkeypatch, [])
    for other in (replace(TINY, seed=3), replace(TINY, seed=2, epochs=8)):
        with pytest.raises(ModelError, match="another folder"):
            train(training, training, other, tmp_path)


@pytest.mark.slow  # loads what optimisers need
def test_fine_tuning_takes_shape_weights_and_normalisation_of_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _scripted(monkeypatch, [1.0])
    training = _numbered(2)
    first, _ = train(training, training, replace(TINY, epochs=1), tmp_path / "a")
    _scripted(monkeypatch, [1.0])
    other = replace(TINY, feature_names=FEATURES[:4], hidden=5, epochs=1)
    tuned, _ = train(_numbered(1), training, other, tmp_path / "b", init=first)
    assert (tuned.feature_names, tuned.hidden, tuned.normalisation) == (FEATURES[:2], 3, first.normalisation)
    np.testing.assert_allclose(tuned.weights["head.0.bias"] - first.weights["head.0.bias"], 1.0, rtol=1e-6)
    _scripted(monkeypatch, [1.0])
    with pytest.raises(ModelError, match="another folder"):
        train(_numbered(1), training, other, tmp_path / "b")
    for a, b in (([], training), (training, [])):
        with pytest.raises(ModelError, match="sequences"):
            train(a, b, TINY, tmp_path / "c")


# ---- pdhef train ----


def arrays(count: int = 200, **changes: Any) -> DriveArrays:
    rows = made_rows(count)
    columns: dict[str, Any] = {
        "stamps_ns": rows.stamps_ns,
        "features": rows.features.astype(np.float32),
        "targets": np.full((count, 2), 0.02, dtype=np.float32),
        "step_s": np.full(count, 0.01),
        "weight": np.ones(count, dtype=np.float32),
        "segment": np.zeros(count, dtype=np.int64),
        "truth_velocity": rows.truth_velocity.astype(np.float32),
    }
    return DriveArrays(**{**columns, **changes})


def dataset(**drives: tuple[str, DriveArrays]) -> Any:
    held = tuple(SimpleNamespace(name=n, split=s, load=lambda a=a: a) for n, (s, a) in drives.items())
    about: dict[str, Any] = {"model": "physics", "physics_sha256": "e" * 64, "vehicle_name": "a car"}
    return SimpleNamespace(drives=held, sha256="d" * 64, vehicle=lambda _drive: CAR, **about)


def test_runs_end_at_new_segments_and_short_or_worthless_ones_are_left_out() -> None:
    segment = np.repeat([0, 1, 2, 3], [50, 49, 51, 50])
    weight = np.ones(200, dtype=np.float32)
    weight[150:] = 0.0
    drive = arrays(segment=segment, weight=weight)
    assert list(gap_free_runs(drive)) == [slice(0, 50), slice(99, 150)]
    drive.features[120, 3] = np.nan
    assert list(gap_free_runs(drive)) == [slice(0, 50)]


def test_targets_are_rates_by_the_true_step_or_the_true_velocity() -> None:
    step = np.full(200, 0.01)
    step[7] = 0.02
    weight = np.ones(200, dtype=np.float32)
    weight[9] = 0.0
    drive = arrays(step_s=step, weight=weight)
    (one,) = train_command._sequences(dataset(a=("train", drive)).drives)
    assert (one.drive, one.target[7, 0], one.target[8, 0]) == ("a", pytest.approx(1.0), pytest.approx(2.0))
    assert one.target[9].tolist() == [0.0, 0.0] and one.weight[9] == 0.0
    truth = drive.truth_velocity.copy()
    truth[20, 1] = np.nan
    drive = replace(drive, truth_velocity=truth)
    (one,) = train_command._sequences(dataset(a=("train", drive)).drives, LATERAL_VELOCITY)
    np.testing.assert_array_equal(one.target[:9, 0], truth[:9, 1].astype(np.float64))
    assert one.weight[[9, 20]].tolist() == [0.0, 0.0] and one.weight.sum() == 198 and one.target[20, 0] == 0.0
    unknown = replace(drive, truth_velocity=np.full((200, 2), np.nan, dtype=np.float32))
    assert list(train_command._sequences(dataset(a=("train", unknown)).drives, LATERAL_VELOCITY)) == []


BUNDLE = ModelBundle(FEATURES[:2], 3, 1, (2,), 0.01, Normalisation((0.0,) * 2, (1.0,) * 2, (2.0, 4.0)), {})


def test_the_test_loss_is_the_weighted_mean_square_of_normalised_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    from pdhef_logtool.residual_model import service

    class Zero:
        def __init__(self, bundle: ModelBundle) -> None:
            assert bundle is BUNDLE

        def run(self, features: Any, starts: Any, carry: Any) -> Any:
            assert not starts.any() and carry is None
            return np.ones((len(features), 2)), None

    monkeypatch.setattr(service, "NetworkService", Zero)
    one, other = sequence(3, 2.0), sequence(2, 4.0)
    other.weight[:] = [3.0, 0.0]
    # (1 - 2, 1 + 4) over (2, 4), and (1 - 4, 1 + 8).
    squares = [(0.5**2 + 1.25**2) / 2, (1.5**2 + 2.25**2) / 2]
    assert mean_square(BUNDLE, [one, other]) == pytest.approx((3 * squares[0] + 3 * squares[1]) / 6)
    with pytest.raises(ModelError, match="usable samples"):
        mean_square(BUNDLE, [])


def test_a_training_tells_epochs_and_writes_history_plot_and_where_it_is_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: (figures.append(self), file.write(b"png")))
    history = [Epoch(1, 0.5, 0.25, 1e-3, 2.0), Epoch(2, 0.4, 0.125, 1e-4, 2.0)]
    asked: list[Any] = []

    def fake(training: Any, validation: Any, recipe: Recipe, work: Path, *, progress: Any, **named: Any) -> Any:
        asked.append((len([*training]), len([*validation]), recipe.target, work, named["init"], named["device"]))
        (work / CHECKPOINT).write_bytes(b"")
        for epoch in history:
            progress(epoch, 4)
        return replace(BUNDLE, provenance={"epochs": 2}), history

    monkeypatch.setattr(train_command, "train", fake)
    monkeypatch.setattr(train_command, "mean_square", lambda bundle, sequences: len([*sequences]) / 2)
    saved: list[Path] = []
    monkeypatch.setattr(ModelBundle, "save", lambda self, folder: saved.append(folder))
    data = dataset(a=("train", arrays(430)), b=("validation", arrays()), c=("test", arrays()), d=("train", arrays(430)))
    told: list[tuple[str, float]] = []
    found = train_on(data, tmp_path, TINY, init=BUNDLE, device="cuda", progress=lambda *x: told.append(x))
    assert told == [
        ("epoch 1: train 0.5000, validation 0.2500", 0.25),
        ("epoch 2: train 0.4000, validation 0.1250", 0.5),
    ]
    assert asked == [(2, 1, "residual_rates", tmp_path, BUNDLE, "cuda")]
    assert found.test_loss == 0.5 and saved == [tmp_path]
    assert found.bundle.provenance == {
        "epochs": 2, "dataset_sha256": "d" * 64, "vehicle": "a car",
        "fine_tuned_from": BUNDLE.sha256,
        "fine_tuned_on": "a car", "test_loss": 0.5,
    }  # fmt: skip
    assert not (tmp_path / CHECKPOINT).exists()
    rows = pl.read_parquet(tmp_path / "history.parquet")
    assert rows["validation_loss"].to_list() == [0.25, 0.125]
    training, validation = figures[0].axes[0].get_lines()
    assert training.get_xydata().tolist() == [[1, 0.5], [2, 0.4]]
    assert validation.get_ydata().tolist() == [0.25, 0.125]
    assert found.to_dict()["history"][1]["learning_rate"] == 1e-4
    del data.drives[2].split
    data.drives[2].split = "other"
    plain = train_on(data, tmp_path, TINY)
    assert plain.test_loss is None and plain.bundle.provenance["fine_tuned_on"] is None
    assert asked[-1][4:] == (None, "cpu")


def test_a_recipe_is_the_papers_or_methods_with_the_callers_seed_and_epochs() -> None:
    own, paper = (make_recipe(paper=p, seed=5, epochs=None, device="cpu") for p in (False, True))
    assert own == Recipe(seed=5) and (paper.hidden, paper.seed, paper.epochs) == (128, 5, 200)
    assert make_recipe(paper=False, seed=0, epochs=1, device="cpu").epochs == 1
    with pytest.raises(UsageError, match="epoch"):
        make_recipe(paper=False, seed=0, epochs=0, device="cpu")
    if not torch.cuda.is_available():
        with pytest.raises(UsageError, match="--device"):
            make_recipe(paper=False, seed=0, epochs=None, device="cuda")


# ---- baselines ----


def test_a_regression_is_of_the_training_drives_and_judged_on_all() -> None:
    names = ("vx_m_s", "steer_rad")
    columns = [FEATURES.index(n) for n in names]

    def part(count: int, offset: float = 0.0) -> DriveArrays:
        made = arrays(count)
        features = made.features.copy()
        features[:, columns[1]] = 0.02 * np.sin(np.arange(count) / 90)
        beta = 0.01 + 0.5 * features[:, columns[1]].astype(np.float64) + offset
        truth = np.stack([np.full(count, 20.0), 20.0 * np.tan(beta)], axis=1).astype(np.float32)
        truth[:10, 0] = 2.9  # slower than the low-speed blend
        weight = made.weight.copy()
        weight[20:30] = 0.0
        truth[20:30, 1] = 9.0
        return replace(made, features=features, truth_velocity=truth, weight=weight)

    data = dataset(a=("train", part(900)), b=("validation", part(400, 0.01)), c=("train", part(600)))
    (used,) = baselines._sequences(dataset(a=("train", part(100))), "train")
    assert np.flatnonzero(np.isnan(used.sideslip_rad)).tolist() == [*range(10), *range(20, 30)]
    assert math.isnan(used.dt_s[0])
    np.testing.assert_allclose(used.dt_s[1:], 0.01)
    model = fit_dataset(data, names)
    assert model.coefficients[1] == pytest.approx(0.5, abs=0.08)  # the low pass takes the rest
    p = model.provenance
    assert (p["dataset_sha256"], p["vehicle"], p["training_sequences"]) == ("d" * 64, "a car", 2)
    errors = p["sideslip_rmse_deg"]
    assert errors["test"] is None and errors["train"] < 0.1
    assert errors["validation"] == pytest.approx(math.degrees(0.01), rel=0.15)


def test_what_hardly_varies_beside_its_size_is_a_constant() -> None:
    rng = np.random.default_rng(0)
    features = np.zeros((400, len(FEATURES)))
    features[:, 0] = 20.0 + 1e-4 * rng.standard_normal(400)
    features[:, 1] = 1e-9 * rng.standard_normal(400)
    features[:, 2] = 0.02 * rng.standard_normal(400)
    dt = np.array([np.nan, *[0.01] * 399])
    model = baselines.fit_linear([SideslipSequence(features, dt, rng.standard_normal(400))], FEATURES[:3])
    assert model.coefficients[:2] == (0.0, 0.0) and model.coefficients[2] != 0.0


def test_the_error_of_a_regression_is_over_all_known_rows() -> None:
    model = LinearModel(("vx_m_s",), (0.0,), 0.01, 2.0)
    dt = np.array([np.nan, *[0.01] * 3])
    rows = [
        SideslipSequence(np.zeros((4, len(FEATURES))), dt, np.array([0.01, 0.02, np.nan, 0.01])),
        SideslipSequence(np.zeros((4, len(FEATURES))), dt, np.array([0.04, np.nan, np.nan, np.nan])),
    ]
    assert baselines._rmse_deg(model, rows) == pytest.approx(math.degrees(math.sqrt((0.01**2 + 0.03**2) / 4)))
    assert baselines._rmse_deg(model, []) is None


def test_both_baselines_are_made_by_one_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    model = LinearModel(("vx_m_s",), (0.5,), 0.01, 2.0, {"vehicle": "a car"})
    monkeypatch.setattr(baselines, "dataset_for", lambda folder, model: ("data", folder, model))
    monkeypatch.setattr(baselines, "fit_dataset", lambda data, names: (asked.append((data, names)), model)[1])
    network = SimpleNamespace(to_dict=lambda: {"sha256": "x"})

    def trained(data: Any, folder: Path, recipe: Recipe, **named: Any) -> Any:
        asked.append((data, folder, recipe, named))
        return network

    monkeypatch.setattr(baselines, "train_on", trained)
    progress = print
    found = run_baselines(tmp_path / "d", tmp_path / "m", seed=3, epochs=2, progress=progress)
    recipe = Recipe(seed=3, epochs=2, feature_names=NOMINAL_FEATURES, odd=False)
    data = ("data", tmp_path / "d", "phy-ukf")
    lstm = tmp_path / "m/baselines/pure-lstm"
    assert asked[0] == (data, recipe.feature_names)
    assert asked[1][:3] == (data, lstm, replace(recipe, target=LATERAL_VELOCITY))
    assert asked[1][3] == {"device": "cpu", "progress": progress}
    document = found.to_dict()
    assert document["pure_lstm"] == {"sha256": "x"}
    assert document["linear_regression"]["provenance"] == {"vehicle": "a car"}
    assert json.loads(found.regression_file.read_text())["coefficients"] == [0.5]
