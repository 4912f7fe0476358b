"""Stage gain: the rule on errors with a known answer, and its output."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_models import random_network

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import LearntOn
from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.vehicle_ukf import of_car
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import LearnSettings, choose_drives, load_drive
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.evidence.trust import (
    MIN_BLOCKS,
    MIN_EXCITED_S,
    TRUSTS,
    UNCONFIRMED_CAP,
    BlockErrors,
    block_errors,
    decide_cap,
    join_blocks,
)
from pdhef_logtool.learning.stages.gain import errors_by_trust, seen_by_identification
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.runs.config import RunConfig
from tests.command_line import called

pytestmark = pytest.mark.slow

PERIOD_NS = 10_000_000


def _errors(rmse_deg: list[float], *, spread: float = 0.3, blocks: int = 30, seed: int = 0) -> BlockErrors:
    """Blocks of 1000 stamps; the mean square at each gain scatters independently about the given RMSE."""
    rng = np.random.default_rng(seed)
    scatter = np.exp(rng.normal(0.0, spread, (len(TRUSTS), blocks)))
    squares = 1000.0 * np.radians(rmse_deg)[:, None] ** 2 * scatter
    return BlockErrors(squares, np.full(blocks, 1000.0), 10.0 * blocks, 4.0 * blocks)


# ---- the rule ----


def test_a_network_that_does_nothing_is_rarely_confirmed() -> None:
    caps = [decide_cap(_errors([0.3] * 5, spread=0.5, seed=s)).cap for s in range(200)]
    # One side of a 95 % interval is 2.5 %; a percentile interval of 30 blocks is a little narrow.
    assert sum(cap > UNCONFIRMED_CAP for cap in caps) <= 14


def test_one_block_cannot_confirm_a_gain() -> None:
    # All of the gain is in a single block of thirty, which a third of the resamples lack.
    errors = _errors([0.3] * 5, spread=0.0)
    squares = errors.squares.copy()
    squares[0, 7] *= 100.0
    decision = decide_cap(replace(errors, squares=squares))
    assert decision.against_zero[-1].value_deg2 < 0.0
    assert decision.cap == 0.5
    assert "not confirmed" in decision.reason


def test_too_little_driving_decides_nothing() -> None:
    helps = _errors([0.5, 0.4, 0.3, 0.2, 0.1])
    decision = decide_cap(replace(helps, excited_s=MIN_EXCITED_S - 0.1))
    assert decision.cap == 0.0
    assert "19.9 s above 2 m/s²" in decision.reason
    few = decide_cap(replace(_errors([0.5, 0.4, 0.3, 0.2, 0.1], blocks=MIN_BLOCKS - 1), excited_s=99.0))
    assert few.cap == 0.5
    assert math.isnan(few.against_zero[-1].high_deg2)
    assert "too few to confirm" in few.reason
    nothing = decide_cap(BlockErrors(np.zeros((5, 0)), np.zeros(0), 0.0, 0.0))
    assert nothing.cap == 0.0


def test_the_limits_of_the_rule_belong_to_what_they_allow() -> None:
    helps = _errors([0.5, 0.4, 0.3, 0.2, 0.1], spread=0.0, blocks=MIN_BLOCKS)
    assert decide_cap(replace(helps, excited_s=MIN_EXCITED_S)).cap == 1.0
    # 5 % above the best lower trust is no worse, 6 % may be.
    assert decide_cap(_errors([0.5, 0.4, 0.3, 0.2, 0.2099], spread=0.0)).cap == 1.0
    worse = decide_cap(_errors([0.5, 0.4, 0.3, 0.2, 0.2101], spread=0.0))
    assert worse.cap == 0.75
    assert "0.75 is confirmed" in worse.reason and "more than 5% worse than residual gain 0.75" in worse.reason
    assert [b.value_deg2 for b in worse.against_zero[:2]] == pytest.approx([0.0, 0.4**2 - 0.5**2])
    assert (worse.blocks, worse.scored_s, worse.excited_s) == (30, 300.0, 120.0)
    same = decide_cap(_errors([0.3] * 5, spread=0.0))
    assert (same.cap, same.reason) == (0.0, "no improvement over physics alone")
    # Blocks count by their stamps.
    uneven = replace(helps, squares=np.tile([[4.0, 1.0]] + [[1.0, 0.25]] * 4, (1, 4)), counts=np.tile([4.0, 1.0], 4))
    assert decide_cap(uneven).rmse_deg[:2] == pytest.approx([math.degrees(1.0), math.degrees(0.5)])


def test_blocks_are_of_equal_time_and_a_lost_stamp_counts_once() -> None:
    count = 2500
    stamps = 10**18 + np.arange(count, dtype=np.int64) * PERIOD_NS
    errors = np.full((len(TRUSTS), count), 0.01)
    errors[2:4, 7] = np.nan
    blocks = block_errors(errors, np.zeros(count), stamps, np.arange(count) < 100)
    assert blocks.counts.tolist() == [1250.0, 1250.0]  # 24.99 s: two, not three
    assert (blocks.lost, blocks.scored_s, blocks.excited_s) == (1, pytest.approx(25.0), pytest.approx(1.0))
    assert block_errors(errors, np.zeros(count), stamps, np.arange(count) < 100, block_s=5.0).counts.shape == (4,)
    one = block_errors(errors[:, :1], np.zeros(1), stamps[:1], np.ones(1, dtype=np.bool_))
    assert one.counts.tolist() == [1.0] and one.scored_s == 0.0
    nothing = block_errors(np.full((5, 9), np.nan), np.zeros(9), stamps[:9], np.ones(9, dtype=np.bool_))
    assert nothing.squares.shape == (5, 0) and nothing.counts.shape == (0,)
    assert (nothing.scored_s, nothing.excited_s, nothing.lost) == (0.0, 0.0, 0)
    both = join_blocks([blocks, replace(blocks, lost=4)])
    assert (both.lost, both.excited_s) == (5, pytest.approx(2.0))


@settings(deadline=None, max_examples=150)
@given(
    st.lists(st.floats(0.01, 5.0), min_size=5, max_size=5),
    st.floats(0.0, 1.5),
    st.integers(1, 40),
    st.floats(0.0, 400.0),
    st.integers(0, 1000),
)
def test_no_trust_without_a_gain(
    rmse_deg: list[float], spread: float, blocks: int, excited_s: float, seed: int
) -> None:
    errors = replace(_errors(rmse_deg, spread=spread, blocks=blocks, seed=seed), excited_s=excited_s)
    decision = decide_cap(errors, seed=seed)
    assert decision.cap in TRUSTS
    at = TRUSTS.index(decision.cap)
    total = errors.squares.sum(axis=1)
    if decision.cap > 0.0:
        assert excited_s >= MIN_EXCITED_S
        assert total[at] < total[0]
    if decision.cap > UNCONFIRMED_CAP:
        assert blocks >= MIN_BLOCKS
        assert math.sqrt(total[at]) <= 1.05 * math.sqrt(total[:at].min()) * (1 + 1e-9)
    # Units and order of the blocks are of no account, up to the draws.
    assert decide_cap(errors, seed=seed) == decision
    worse = replace(errors, squares=np.concatenate([errors.squares[:1], errors.squares[1:] + errors.squares[:1]]))
    assert decide_cap(worse, seed=seed).cap == 0.0


def test_leaving_hard_stamps_out_gains_nothing() -> None:
    count = 2000
    stamps = 10**18 + np.arange(count, dtype=np.int64) * PERIOD_NS
    errors = np.full((len(TRUSTS), count), 0.01)
    errors[0, :100] = 0.05
    truth = np.full(count, 0.03)
    errors[-1, :200] = np.nan
    blocks = block_errors(errors, truth, stamps, np.ones(count, dtype=np.bool_))
    assert blocks.lost == 200
    assert blocks.squares[-1].sum() == pytest.approx(100 * 0.05**2 + 100 * 0.03**2 + 1800 * 0.01**2)
    # Samples without an estimate of physics alone are not compared.
    errors[0, -500:] = np.nan
    assert block_errors(errors, truth, stamps, np.ones(count, dtype=np.bool_)).counts.sum() == 1500


# ---- the command ----


def _settings(sample_logs_dir: Path, folder: Path, **changes: object) -> LearnSettings:
    random_network().save(folder / "model")
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", network=folder / "model")
    return replace(LearnSettings(config=config, stage="gain"), **changes)  # type: ignore[arg-type]


def test_the_errors_are_those_of_pd_hef_at_each_trust(sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, bundle = read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle, random_network()
    car = Car.of(vehicle, network=bundle)
    drive = load_drive(find_logs([str(sample_logs_dir / "dlc.mcap")])[0], car, None, ReadOptions())[1]
    assert drive is not None and drive.truth is not None
    signals, truth = drive.signals, drive.truth
    passes = []
    run = NetworkService.run
    monkeypatch.setattr(NetworkService, "run", lambda *a: passes.append(1) or run(*a))
    blocks = errors_by_trust(car, drive, use_speed=True)
    assert len(passes) == 1
    for row, share in zip(blocks.squares, TRUSTS, strict=True):
        estimator = AdaptivePhysics(of_car(car), NetworkService(bundle), share)
        track = run_window(estimator, signals)[0]
        error = signal_error(track, truth, "sideslip_rad", vehicle.low_speed_blend_m_s)
        assert row.sum() == pytest.approx(np.nansum(error**2), rel=1e-12)
    assert len({float(row.sum()) for row in blocks.squares}) == len(TRUSTS)
    assert 0.0 < blocks.excited_s < blocks.scored_s


def test_the_file_is_the_one_that_was_given_but_for_the_network(sample_logs_dir: Path, tmp_path: Path) -> None:
    source = tmp_path / "car.toml"
    text = (sample_logs_dir / "vehicle.toml").read_text()
    source.write_text("# A head.\n" + text.replace("track_m = 1.57", "track_m = 1.57  # measured"))
    assert "# measured" in source.read_text()
    options = _settings(sample_logs_dir, tmp_path)
    options = replace(options, config=replace(options.config, car=source))
    logs = [str(sample_logs_dir / f"{n}.mcap") for n in ("dlc", "step", "no_truth")]
    told: list[str] = []
    result = learn(logs, tmp_path / "trusted", options, reporter=Reporter(warn=told.append))
    assert result.exit_code == 3
    assert any(line.startswith("no_truth is left out") for line in told)
    before, after = Car.load(source), Car.load(tmp_path / "trusted", network=tmp_path / "model")
    assert (after.vehicle, after.noise, after.learnt_on) == (before.vehicle, before.noise, before.learnt_on)
    found, part = result.figures, after.trust
    assert part is not None
    assert (part.trust_cap, part.evidence) == (found["trust_cap"], found["evidence"])
    assert part.network_sha256 == found["network_sha256"] == random_network().sha256
    assert after.allowed_trust.cap == found["trust_cap"]
    assert part.has_evidence
    for figure in (f"{found['rmse_deg'][0]:.3f}°", f"{found['rmse_deg'][4]:.3f}°", "2 drives"):
        assert figure in part.evidence
    assert (tmp_path / "trusted/vehicle.toml").read_bytes() == source.read_bytes()
    record = json.loads((tmp_path / "trusted/network.record.json").read_text())
    assert record["trust_cap"] == found["trust_cap"]
    assert [d["name"] for d in record["drives"]] == ["dlc", "step"]
    assert record["drives"][0]["sha256"]
    assert record["network_sha256"] == random_network().sha256
    # Once more, onto itself: the old evidence is replaced.
    again = replace(options, config=replace(options.config, car=tmp_path / "trusted"))
    learn(logs[:2], tmp_path / "trusted", again)
    assert Car.load(tmp_path / "trusted").trust == part


def test_a_folder_gets_a_copy_of_the_network_that_was_tried(sample_logs_dir: Path, tmp_path: Path) -> None:
    options = _settings(sample_logs_dir, tmp_path)
    result = learn([str(sample_logs_dir / "dlc.mcap")], tmp_path / "mycar", options)
    shutil.rmtree(tmp_path / "model")
    car = Car.load(tmp_path / "mycar")
    assert car.network is not None and car.network.sha256 == random_network().sha256
    assert car.trust is not None and car.trust.evidence == result.figures["evidence"]
    assert car.trust.physics_sha256 == car.physics_sha256
    assert car.allowed_trust.reason == car.trust.evidence
    # Another network may be taken, but not on this evidence.
    other = Car.load(tmp_path / "mycar", network="default")
    assert other.allowed_trust.cap == 0.0 and "pdhef learn --stages gain tries it" in other.allowed_trust.reason


def test_drives_that_a_network_was_trained_on_are_refused(sample_logs_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    entries = []
    for name, split in (("dlc", "train"), ("step", "test")):
        shutil.copy(sample_logs_dir / f"{name}.mcap", tmp_path / "set")
        entries.append({"file": f"{name}.mcap", "split": split})
    (tmp_path / "set" / "manifest.json").write_text(json.dumps({"drives": entries}))
    logs = find_logs([str(tmp_path / "set")])
    options = LearnSettings(config=RunConfig(), stage="gain")
    with pytest.raises(UsageError, match=r"dlc \(train\).*--split test"):
        choose_drives(logs, options)
    with pytest.raises(UsageError, match="drives of split extrapolation, got drives of test, train"):
        choose_drives(logs, replace(options, split="extrapolation"))
    assert [i.stem for i in choose_drives(logs, replace(options, split="test"))[0]] == ["step"]
    assert [i.stem for i in choose_drives(logs, replace(options, split="any"))[0]] == ["dlc", "step"]


def test_a_drive_of_the_identification_is_told(sample_logs_dir: Path) -> None:
    car = Car.load(sample_logs_dir / "vehicle.toml")
    log = find_logs([str(sample_logs_dir / "dlc.mcap")])[0]
    facts, _ = load_drive(log, car, None, ReadOptions())
    assert seen_by_identification(car, [facts]) == []
    # The content identifies a drive if it is known, the name in older files.
    same = LearntOn(name="dlc", end_s=7.0)
    renamed = LearntOn(name="renamed", sha256=facts.sha256, end_s=7.0)
    others = (LearntOn(name="dlc_2", end_s=7.0), LearntOn(name="dlc", sha256="0" * 64, end_s=7.0))
    for seen in (same, renamed):
        identified = replace(car, learnt_on=(seen, *others))
        told = seen_by_identification(identified, [facts])
        assert len(told) == 1
        assert f"{seen.name}, 0.00 to 7.00 s" in told[0]
    later, _ = load_drive(log, car, None, ReadOptions(start="6.9"))
    assert len(seen_by_identification(identified, [later])) == 1
    after, _ = load_drive(log, car, None, ReadOptions(start="7.0"))
    assert seen_by_identification(identified, [after]) == []


def test_wrong_options_are_usage_errors(sample_logs_dir: Path, tmp_path: Path) -> None:
    options = _settings(sample_logs_dir, tmp_path)
    log = [str(sample_logs_dir / "dlc.mcap")]
    wrong = [
        (replace(options, config=replace(options.config, car=None)), "a car"),
        (replace(options, config=replace(options.config, network=Path("none"))), "a network"),
    ]
    with pytest.raises(UsageError, match="seed"):
        replace(options, seed=-1)
    for one, message in wrong:
        with pytest.raises(UsageError, match=message):
            learn(log, tmp_path / "out", one)
    (tmp_path / "notes").write_text("no folder")
    with pytest.raises(UsageError, match="a car's folder"):
        learn(log, tmp_path / "notes", options)
    with pytest.raises(EstimatorError, match="at least one drive with a true sideslip"):
        learn([str(sample_logs_dir / "no_truth.mcap")], tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_the_command_prints_a_table_or_json(sample_logs_dir: Path, tmp_path: Path) -> None:
    random_network().save(tmp_path / "model")
    words = ["learn", sample_logs_dir / "dlc.mcap", "--stages", "gain", "--car", sample_logs_dir / "vehicle.toml",
             "--network", tmp_path / "model", "-o", tmp_path / "car"]  # fmt: skip
    shown = called(*words)
    assert shown.returncode == 0, shown.stderr
    # A double lane change is over too soon to decide on.
    assert "residual gain limit 0: too little to decide on" in shown.stdout
    (stage,) = json.loads(called(*words, "--json").stdout)["stages"]
    figures = stage["figures"]
    assert (stage["name"], figures["trust_cap"]) == ("gain", 0.0)
    assert figures["trusts"] == list(TRUSTS)
    assert figures["against_trust_0"][4]["low_deg2"] is None
    found = Car.load(tmp_path / "car").trust
    assert found is not None and found.evidence == figures["evidence"]
