"""What the learning commands do around their fits, on drives in memory: progress, records, words, figures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from reference_car import drive, slalom

from pdhef_logtool.car.car import HISTORY_FILE, Car
from pdhef_logtool.car.parts import FilterNoise, Inflation, LearntOn, SideslipCoefficients, YawRateCoefficients
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.learning import drives as learning_drives
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnSettings,
    choose_drives,
    exit_code,
    load_drive,
    no_true_sideslip,
    set_manifest,
    tell_drive,
)
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.evidence.calibrate import Coverage, Fitted, Samples
from pdhef_logtool.learning.evidence.trust import BlockErrors, Bound, TrustDecision
from pdhef_logtool.learning.network import extract_command
from pdhef_logtool.learning.noise import bench
from pdhef_logtool.learning.noise.bench import choose_names
from pdhef_logtool.learning.noise.search import DriveError, Score, Trial
from pdhef_logtool.learning.split import Split
from pdhef_logtool.learning.stages import gain, intervals, noise
from pdhef_logtool.learning.stages.intervals import drive_samples, made_wrong
from pdhef_logtool.learning.stages.noise import Tuned
from pdhef_logtool.learning.stages.task import Task
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.runs.config import RunConfig

SALOON = RunConfig(car=Path("saloon"))
VEHICLE = default_vehicle()


def whole_drive(seconds: float = 6.0, name: str = "made") -> WholeDrive:
    """A slalom with its truth."""
    made = drive(slalom(), seconds)
    stamps = made.signals.stamps_ns
    truth = make_track("truth", stamps, vx_m_s=made.vx, vy_m_s=made.vy, yaw_rate_rad_s=made.r, ay_m_s2=made.ay)
    available = frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})
    plan: Any = SimpleNamespace(
        vehicle=VEHICLE,
        mapping=SimpleNamespace(signals={}),
        alignment=SimpleNamespace(available=available),
        truth=object(),
        derivation={"sideslip_rad": "from v_x and v_y"},
        dependent={},
        has_truth_pose=False,
    )
    return WholeDrive(name, Path(f"{name}.mcap"), plan, made.signals, truth, int(stamps[0]) - 1_500_000_000)


WHOLE = whole_drive()


def record(name: str, **changes: Any) -> DriveRecord:
    return replace(DriveRecord(name, f"{name}.mcap", sha256=name * 64, seconds=6.0, span_s=(1.5, 7.5)), **changes)


def logs(folder: Path, names: str) -> list[str]:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / f"{name}.mcap").write_bytes(b"")
    return [str(folder / f"{name}.mcap") for name in names]


# ---- drives ----


def test_a_record_in_json_and_as_a_car_remembers_it() -> None:
    full = record("a", seconds=1.23456, span_s=(0.12345, 9.87654), counts={"runs": 3}, bytes_held=99, split="test")
    document = full.to_dict()
    assert (document["seconds"], document["span_s"], document["runs"]) == (1.235, [0.123, 9.877], 3)
    assert not {"counts", "bytes_held", "left_out", "reason"} & document.keys()
    assert full.learnt_on == LearntOn(name="a", sha256="a" * 64, start_s=0.12, end_s=9.88)
    without = record("b", span_s=None, left_out="no ground truth")
    assert without.to_dict()["span_s"] is None and without.to_dict()["reason"] == "no ground truth"
    assert (without.learnt_on.start_s, without.learnt_on.end_s) == (0.0, 0.0)


def test_what_a_user_must_know_of_a_drive_is_told_in_order_and_decides_the_exit_code() -> None:
    lost = Loss("gap", "2 s are gone", "/imu")
    note = Loss("late", "late", "/imu", severity="note")
    told: list[str] = []
    tell_drive(record("a", notes=("perfect ground truth",), losses=(lost, note), left_out="it is short"), told.append)
    assert told == ["a: perfect ground truth", "a: 2 s are gone (/imu)", "a is left out: it is short"]
    good, bad = record("a", losses=(note,)), record("b", left_out="x")
    assert [exit_code(r) for r in ([good], [good, bad], [good, record("c", losses=(lost,))], [bad])] == [0, 3, 3, 1]


def test_a_truth_is_missing_underived_or_no_truth() -> None:
    plan: Any = SimpleNamespace(truth=None, derivation={"sideslip_rad": "x"}, dependent={})
    assert no_true_sideslip(plan) == "no true sideslip"
    plan.truth, plan.derivation = object(), {}
    assert no_true_sideslip(plan) == "no true sideslip"
    plan.derivation = {"sideslip_rad": "x"}
    assert no_true_sideslip(plan) == ""
    plan.dependent = {"sideslip_rad": "it is an estimate"}
    assert no_true_sideslip(plan) == "its ground truth is invalid: it is an estimate"


class ReadDrive:
    """What ``read_drive`` gives, of :data:`WHOLE`."""

    def __init__(self, whole: WholeDrive = WHOLE) -> None:
        self.name, self.path, self.plan, self.sha256 = whole.name, whole.path, whole.plan, "1" * 64
        self.file = whole.path.name
        topic = SimpleNamespace(label="/ins.v")
        self.mapping = SimpleNamespace(truth={"vy_m_s": topic, "vx_m_s": topic})
        self.friction, self.losses, self.notes = SimpleNamespace(label="none"), (), ["a note"]
        self.remarks = ["a remark"]
        self.available = whole.plan.alignment.available
        self._whole, self.asked = whole, {}

    def whole(self, **asked: Any) -> WholeDrive:
        self.asked = asked
        return self._whole

    def __enter__(self) -> ReadDrive:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_a_drive_is_loaded_with_what_is_known_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    read = ReadDrive()
    monkeypatch.setattr(learning_drives, "read_drive", lambda *_: read)
    log, car = LogInput(Path("made.mcap"), "made"), Car.of(VEHICLE)
    found, whole = load_drive(log, car, None, SALOON.read_options, split="test", fill_friction=False, max_bytes=7)
    assert whole is WHOLE
    assert read.asked == {"fill_friction": False, "max_bytes": 7}
    assert (found.name, found.file, found.sha256, found.split) == ("made", "made.mcap", "1" * 64, "test")
    assert (found.truth, found.friction_from, found.notes) == (("/ins.v",), "none", ("a note", "a remark"))
    assert (found.seconds, found.span_s) == (pytest.approx(6.0), pytest.approx((1.5, 7.5)))
    assert found.counts == {"scored_stamps": 601} and found.left_out == ""
    assert found.bytes_held == WHOLE.nbytes > 601 * 8
    assert load_drive(log, car, None, SALOON.read_options, least_scored=601)[1] is WHOLE
    short, whole = load_drive(log, car, None, SALOON.read_options, least_scored=602)
    assert whole is None and short.left_out == "601 stamps with a true sideslip above 3 m/s"
    assert (short.seconds, short.span_s, short.bytes_held, short.counts) == (0.0, None, 0, {})
    refused, whole = load_drive(log, car, None, SALOON.read_options, refuse=lambda d: f"not {d.name}")
    assert whole is None and refused.left_out == "not made"
    unknown = replace(WHOLE.truth, sideslip_rad=np.full(601, np.nan))
    read._whole = replace(WHOLE, truth=unknown)
    assert load_drive(log, car, None, SALOON.read_options)[1] is None


def test_only_whole_entries_of_a_manifest_count(tmp_path: Path) -> None:
    assert set_manifest(tmp_path) == {}
    entries = [{"file": "a.mcap", "split": "test"}, "text", {"file": 3}, {"split": "train"}]
    (tmp_path / "manifest.json").write_text(json.dumps({"drives": entries, "log": {"file": "b"}}))
    (tmp_path / "manifest.toml").write_text('[[log]]\nfile = "c.mcap"\nsplit = "train"\n')
    assert set_manifest(tmp_path) == {
        "a.mcap": {"file": "a.mcap", "split": "test"},
        "c.mcap": {"file": "c.mcap", "split": "train"},
    }
    (tmp_path / "manifest.json").write_text("no json")
    assert list(set_manifest(tmp_path)) == ["c.mcap"]


def test_three_refused_drives_are_named_and_the_rest_counted(tmp_path: Path) -> None:
    inputs = [LogInput(tmp_path / f"{n}.mcap", n) for n in "abcde"]
    entries = [{"file": f"{n}.mcap", "split": "test"} for n in "abcde"]

    def refused(count: int) -> str:
        (tmp_path / "manifest.json").write_text(json.dumps({"drives": entries[:count]}))
        with pytest.raises(UsageError) as caught:
            choose_drives(inputs, LearnSettings(config=SALOON))
        return str(caught.value)

    assert "a (test), b (test), c (test) and 2 more" in refused(5)
    assert "a (test), b (test), c (test)" in refused(3) and "more" not in refused(3)
    (tmp_path / "manifest.json").unlink()
    with pytest.raises(UsageError, match="drives without a set's manifest"):
        choose_drives(inputs, LearnSettings(config=SALOON, split="validation"))
    assert choose_drives(inputs, LearnSettings(config=SALOON)) == (inputs, {})


def test_settings_are_told_by_name_and_estimators_where_they_matter() -> None:
    settings = LearnSettings(config=replace(SALOON, end="5"), seed=3, split="test")
    document = settings.to_dict()
    assert (document["seed"], document["split"], document["any_split"], document["end"]) == (3, "test", False, "5")
    assert not {"config", "estimators", "window_s", "annotate"} & document.keys()
    named = LearnSettings(config=replace(SALOON, estimators=("zero",))).to_dict()
    assert named["estimators"] == ["zero"]


# ---- calibrate ----


def test_every_wrong_run_is_wrong() -> None:
    for key in "abcd":
        draws = made_wrong(VEHICLE, 0.1, key)
        first = [next(draws) for _ in range(8)]
        assert all(one.vehicle != VEHICLE and one.friction_factor != 1.0 for one in first)
        assert len({one.friction_factor for one in first}) == 8


def test_samples_stand_every_twentieth_of_a_second_where_all_is_known() -> None:
    signals, truth = WHOLE.signals, WHOLE.truth
    assert truth is not None
    n = len(truth)
    covariance = np.tile(np.diag([0.04, 0.09, 0.0001]), (n, 1, 1))
    own = np.full(n, 0.02)
    own[:7] = 0.0  # no interval before there is one
    rate = truth.yaw_rate_rad_s + 0.01
    rate[100:111] = np.nan
    track = make_track(
        "phy-ukf",
        truth.stamps_ns,
        vx_m_s=truth.vx_m_s,
        vy_m_s=truth.vy_m_s + 0.1,
        yaw_rate_rad_s=rate,
        covariance=covariance,
        sideslip_std_rad=own,
    )
    found = drive_samples(track, signals, signals, truth, VEHICLE, 4, wrong=True)
    at = [7, *(i for i in range(10, 601, 5) if not 100 <= i <= 110)]
    at = sorted({*at, 111})
    assert len(found) == len(at)
    np.testing.assert_allclose(found.vy_error, 0.1)
    np.testing.assert_allclose(found.yaw_rate_error, 0.01)
    np.testing.assert_allclose(found.sideslip_error, (track.sideslip_rad - truth.sideslip_rad)[at])
    np.testing.assert_allclose(found.vy_per_sideslip, 0.3 / 0.02)
    assert set(found.drive.tolist()) == {4} and found.wrong.all() and (found.own_std == 0.02).all()
    grip = np.abs(truth.ay_m_s2) / (0.85 * 9.81)
    clear = np.abs(grip[at] - 0.3) > 0.03
    assert grip.max() < 0.55 and np.count_nonzero(grip[at][clear] > 0.3) > 0
    np.testing.assert_array_equal(found.bin[clear], (grip[at][clear] > 0.3).astype(int))
    assert found.terms.shape == (len(at), 9) and found.yaw_rate_terms.shape == (len(at), 3)
    np.testing.assert_allclose(found.yaw_rate_terms[:, 1], 0.01)
    # The drive's own friction decides the bins; without a true a_y the sensor's does.
    icy = replace(signals, friction=np.full(n, 0.3))
    assert set(drive_samples(track, signals, icy, truth, VEHICLE, 4, wrong=True).bin.tolist()) >= {2}
    blind = replace(truth, ay_m_s2=np.full(n, np.nan))
    same = drive_samples(track, signals, signals, blind, VEHICLE, 4, wrong=True)
    np.testing.assert_array_equal(same.bin, found.bin)
    holed = truth.ay_m_s2.copy()
    holed[200:211] = np.nan  # no bin there
    without = drive_samples(track, signals, signals, replace(truth, ay_m_s2=holed), VEHICLE, 4, wrong=True)
    assert len(without) == len(found) - 2
    late = [replace(one, stamps_ns=one.stamps_ns + 13_000_000) for one in (track, signals, truth)]
    shifted = drive_samples(late[0], late[1], late[1], late[2], VEHICLE, 4, wrong=True)
    np.testing.assert_array_equal(shifted.sideslip_error, found.sideslip_error)
    none = replace(track, sideslip_std_rad=np.full(n, np.nan))
    assert len(drive_samples(none, signals, signals, truth, VEHICLE, 4, wrong=True)) == 0


def test_a_drive_is_run_as_told_and_twice_with_a_wrong_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = record("a", counts={"scored_stamps": 601})
    monkeypatch.setattr(intervals, "load_drive", lambda *_, **__: (kept, WHOLE))
    seen: list[Any] = []

    def samples(track: Any, told: Any, signals: Any, truth: Any, vehicle: Any, number: int, *, wrong: bool) -> Any:
        assert truth is WHOLE.truth
        seen.append((track.name, told.friction, signals.friction, vehicle, number, wrong))
        return range(20)

    monkeypatch.setattr(intervals, "drive_samples", samples)
    settings = LearnSettings(config=replace(SALOON, friction=0.5), spread=0.1, seed=2)
    car, log = Car.of(VEHICLE), LogInput(Path("a.mcap"), "a")
    task = Task(car=car, settings=settings, split=Split.undivided([log]), estimators=("phy-ukf",))
    told, found = intervals._run_drive(log, 5, task)
    assert found is not None
    assert told.counts == {"scored_stamps": 601, "runs": 3}
    assert [(name, len(part)) for name, _, part in found] == [("phy-ukf", 20)] * 3
    assert [one[5] for one in seen] == [False, True, True]
    assert {(one[3] is VEHICLE, one[4]) for one in seen} == {(True, 5)}
    assert len({a.physics_sha256 for _, a, _ in found}) == 3
    # The bins know the best that is known of the drive, whatever a run was told.
    assert all((one[2] == 0.5).all() for one in seen)
    assert (seen[0][1] == 0.5).all() and all((one[1] != 0.5).all() for one in seen[1:])
    monkeypatch.setattr(intervals, "drive_samples", lambda *_, **__: range(19))
    told, found = intervals._run_drive(log, 5, replace(task, settings=replace(settings, spread=0.0)))
    assert found is None and told.left_out.startswith("no estimate with an interval")
    left_out = record("b", left_out="no true sideslip")
    monkeypatch.setattr(intervals, "load_drive", lambda *_, **__: (left_out, None))
    assert intervals._run_drive(log, 5, task) == (left_out, None)


def _samples(drive_number: int, wrong: bool = False) -> Samples:
    one = np.ones(30)
    return Samples(
        np.ones((30, 7)), np.ones((30, 3)), one, one, one, one, one,
        np.zeros(30, dtype=int), np.full(30, drive_number), np.full(30, wrong),
    )  # fmt: skip


INFLATION = Inflation(
    sideslip=SideslipCoefficients(
        floor=1.0, filter=2.0, yaw_rate=0.0, sideslip=0.0, grip=0.0, grip2=0.0, kinematic=0.0
    ),
    yaw_rate=YawRateCoefficients(floor=1.0, filter=2.0, yaw_rate=0.0),
)


def test_calibrate_tells_its_progress_and_whom_it_leaves_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pdhef_logtool.estimators.algorithm import resolve
    from pdhef_logtool.estimators.table import make_estimator

    car = Car.of(VEHICLE)
    one, other = (resolve(make_estimator(n, car)) for n in ("phy-ukf", "kinematic"))
    fitted: list[Samples] = []

    def run(log: LogInput, number: int, task: Task) -> Any:
        assert task.settings.spread == 0.1 and task.car.vehicle.name
        if log.stem == "f":
            return record("f", left_out="no true sideslip"), None
        parts = [("phy-ukf", one, _samples(number)), ("phy-ukf", one, _samples(number, wrong=True))]
        return record(log.stem), [*parts, *([("kinematic", other, _samples(number))] if number < 4 else [])]

    def fit(samples: Samples) -> Fitted:
        fitted.append(samples)
        return Fitted(INFLATION, 1.5, (Coverage("low", False, 5, 150, 0.1, 0.8, 0.95, 0.9, 1.1),))

    monkeypatch.setattr(intervals, "_run_drive", run)
    monkeypatch.setattr(intervals, "fit_inflation", fit)
    folder = tmp_path / "set"
    arguments = logs(folder, "abcdef")
    (folder / "manifest.json").write_text(json.dumps({"drives": [{"file": "a.mcap", "split": "train"}]}))
    told: list[tuple[str, float]] = []
    warned: list[str] = []
    settings = LearnSettings(config=SALOON, stages=("intervals",), spread=0.1, seed=4)
    result = learn(arguments, tmp_path / "car", settings, reporter=Reporter(lambda *x: told.append(x), warned.append))
    shares = {f"reading {n}": 0.9 * i / 6 for i, n in enumerate("abcdef")}
    assert dict(told) == pytest.approx(shares | {"fitting phy-ukf": 0.9, "fitting kinematic": 0.95, "done": 1.0})
    assert [s for _, s in told] == sorted(s for _, s in told)
    assert warned == [
        "drives of split train: a network is better there than in service, and its intervals too narrow",
        "f is left out: no true sideslip",
        "kinematic is not calibrated: it has 4 drives, at least 5 are needed",
    ]
    assert [len(s) for s in fitted] == [300]
    document = json.loads((tmp_path / "car/intervals.json").read_text())
    (entry,) = document["entries"]
    assert (entry["estimator"], entry["unseen_factor"]) == ("phy-ukf", 1.5)
    assert entry["coverage"][0]["covered_after"] == 0.95
    assert document["fit"] == {
        "covered": 0.95, "folds": 5, "wrong_runs": 2, "sample_every_s": 0.05,
    }  # fmt: skip
    assert [d["name"] for d in document["drives"]] == list("abcde")
    assert document["roll_gradient_rad_per_m_s2"] == Car.load("saloon").vehicle.roll_gradient_rad_per_m_s2
    assert [r.split for r in result.records] == ["train", None, None, None, None, None]
    assert result.figures == {"coverage": {"phy-ukf": entry["coverage"]}} and result.exit_code == 3
    line = json.loads((tmp_path / "car" / HISTORY_FILE).read_text().splitlines()[-1])
    assert (line["command"], line["part"]) == ("learn --stages intervals", "intervals.json")
    for few in (arguments[:4], [*arguments[:4], arguments[5]]):
        with pytest.raises(EstimatorError, match=r"at least 5 drives.*, got 4"):
            learn(few, tmp_path / "other", settings)
    with pytest.raises(UsageError, match="--vary"):
        replace(settings, spread=0.31)


# ---- trust ----


def test_trust_tells_its_progress_warns_and_keeps_its_evidence(
    sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", network=Path("default"))
    shipped = LearnSettings(config=config, stages=("gain",))
    asked: list[Any] = []

    def load(log: LogInput, *_: Any, refuse: Any, least_scored: int) -> Any:
        asked.append((least_scored, refuse(SimpleNamespace(available=frozenset({"speed_m_s"})))))
        assert refuse(ReadDrive()) == ""
        if log.stem == "c":
            return record("c", left_out="no true sideslip"), None
        return record(log.stem), WHOLE

    squares = np.radians(np.array([0.5, 0.4, 0.3, 0.2, 0.1]))[:, None] ** 2 * np.full(20, 100.0)
    blocks = BlockErrors(squares, np.full(20, 100.0), 200.1234, 50.1234, lost=3)
    monkeypatch.setattr(gain, "load_drive", load)
    monkeypatch.setattr(gain, "errors_by_trust", lambda *_, **__: blocks)
    folder = tmp_path / "set"
    arguments = logs(folder, "abc")
    (folder / "manifest.json").write_text(json.dumps({"drives": [{"file": "b.mcap", "split": "test"}]}))
    told: list[tuple[str, float]] = []
    warned: list[str] = []
    result = learn(arguments, tmp_path / "car", shipped, reporter=Reporter(lambda *x: told.append(x), warned.append))
    shares = (0.0, pytest.approx(1 / 3), pytest.approx(2 / 3), 1.0)
    assert told == list(zip(("reading a", "reading b", "reading c", "done"), shares, strict=True))
    missing = "pd-hef needs ay_m_s2, steer_rad, yaw_rate_rad_s"
    assert asked == [(100, missing)] * 3
    assert [r.split for r in result.records] == [None, "test", None]
    assert warned == [
        "c is left out: no true sideslip",
        "6 stamps without an estimate at some gain above 0 are counted against it",
    ]
    assert result.figures["trust_cap"] == 1.0
    car = Car.load(tmp_path / "car")
    assert car.trust is not None and car.trust.network == "default"
    assert not (tmp_path / "car/network").exists()  # a shipped network is named, not copied
    assert (car.trust.physics_sha256, car.trust.noise_sha256) == (car.physics_sha256, car.noise_sha256)
    assert [d.name for d in car.trust.drives] == ["a", "b"]
    document = result.figures
    assert (document["scored_s"], document["excited_s"], document["blocks"]) == (400.247, 100.247, 40)
    assert document["against_trust_0"][4]["value_deg2"] == pytest.approx(0.01 - 0.25)
    record_json = json.loads((tmp_path / "car/network.record.json").read_text())
    assert record_json["drives"][0]["rmse_deg"] == pytest.approx([0.5, 0.4, 0.3, 0.2, 0.1])
    assert (record_json["format"], record_json["version"]) == ("pdhef-trust", 2)
    assert record_json["network_sha256"] == car.trust.network_sha256
    assert record_json["rule"] == {
        "block_s": 10.0, "min_blocks": 8, "excited_m_s2": 2.0, "min_excited_s": 20.0, "tolerance": 0.05,
        "unconfirmed_cap": 0.5, "level": 0.95, "resamples": 4000,
    }  # fmt: skip
    monkeypatch.setattr(gain, "errors_by_trust", lambda *_, **__: replace(blocks, lost=0))
    learn(arguments[:1], tmp_path / "other", shipped, reporter=Reporter(warn=warned.append))
    assert len(warned) == 2


def test_the_evidence_is_one_sentence_with_its_figures() -> None:
    decision = TrustDecision(
        cap=0.25,
        reason="an improvement on the mean; 3 blocks are too few",
        rmse_deg=(0.5, 0.41, 0.3, 0.45, 0.7),
        against_zero=(Bound(0.0, 0.0, 0.0),) * 4 + (Bound(0.24, -0.1, 0.5),),
        blocks=3,
        scored_s=61.6,
        excited_s=20.4,
    )
    said = gain.evidence(decision, 2, "0123456789abcdef" * 4)
    assert said == (
        "an improvement on the mean; 3 blocks are too few: 2 drives with ground truth, 62 s scored, 20 s of them above "
        "2 m/s²; "
        "sideslip RMSE 0.500° at gain 0, 0.410° at gain 0.25, 0.300° at gain 0.5, 0.700° at gain 1; squared error "
        "at 1 less that at 0 0.24 (95 %: -0.1 to 0.5) deg² over 3 blocks; network 0123456789ab"
    )
    few = replace(decision, against_zero=(Bound(0.24, math.nan, math.nan),) * 5)
    assert "at 0 0.24 deg² over" in gain.evidence(few, 1, "0" * 64)
    assert "1 drive with ground truth" in gain.evidence(few, 1, "0" * 64)
    assert gain._bound(Bound(0.24, math.nan, 1.0)) == {"value_deg2": 0.24, "low_deg2": None, "high_deg2": 1.0}


# ---- tune ----


def error(rmse_deg: float, scored: int = 1000) -> DriveError:
    return DriveError(math.radians(rmse_deg) if scored else math.nan, math.radians(5.0), scored, 1000)


class FakeBench:
    """Drives of which the third is left out; the error grows with the distance of q_v_y from an optimum."""

    made: list[Any]

    def __init__(self, *arguments: Any) -> None:
        self.made.append(arguments)

    def load(self, log: LogInput) -> Any:
        return (record("c", left_out="no true sideslip"), None) if log.stem == "c" else (record(log.stem), WHOLE)

    def score(self, tunings: dict[str, FilterNoise]) -> dict[str, list[DriveError]]:
        def of(noise: FilterNoise) -> float:
            return 0.1 + abs(math.log(noise.q_std[1] / 0.3))

        return {n: [error(of(one)), error(2.0 * of(one), scored=0)] for n, one in tunings.items()}


def test_tune_tells_its_progress_and_writes_what_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeBench, "made", [], raising=False)
    monkeypatch.setattr(noise, "Bench", FakeBench)
    folder = tmp_path / "set"
    arguments = logs(folder, "abc")
    (folder / "manifest.json").write_text(json.dumps({"drives": [{"file": "b.mcap", "split": "train"}]}))
    told: list[tuple[str, float]] = []
    warned: list[str] = []
    config = replace(SALOON, estimators=("phy-ukf:tuned", "physics"))
    settings = LearnSettings(config=config, stages=("noise",), trials=6, seed=1)
    result = learn(arguments, tmp_path / "car", settings, reporter=Reporter(lambda *x: told.append(x), warned.append))
    assert dict(told) == pytest.approx(
        {f"reading {n}": 0.2 * i / 3 for i, n in enumerate("abc")}
        | {f"trial {i} of 6": 0.2 + 0.8 * i / 6 for i in range(1, 7)}
        | {"done": 1.0}
    )
    assert told[-2] == ("trial 6 of 6", pytest.approx(1.0))
    assert FakeBench.made[0][-1] == ("physics", "phy-ukf:tuned")
    assert warned[0] == "c is left out: no true sideslip"
    assert result.figures["notes"] == warned[1:]
    car = Car.load(tmp_path / "car")
    document = json.loads((tmp_path / "car/noise.record.json").read_text())
    for name in ("physics", "phy-ukf:tuned"):
        entry, best_noise = document["estimators"][name], car.noise[name]
        best = min(entry["trials"], key=lambda t: t["objective_deg"])
        values = tuple(best["values"].values())
        assert (best_noise.trial, best_noise.score_deg) == (best["trial"], round(best["objective_deg"], 4))
        assert best_noise.q_std[1:] + tuple(best_noise.r_std.values()) == values
        assert entry["best_trial"] == best["trial"] and len(entry["trials"]) == 6
        rmse = 0.1 + abs(math.log(values[0] / 0.3))
        assert entry["rmse_deg"] == {"a": pytest.approx(rmse), "b": None}
        assert list(entry["trials"][2]["values"]) == ["q_vy", "q_yaw_rate", "r_ay", "r_yaw_rate"]
        figures_of = result.figures["estimators"][name]
        assert entry["before"] is not None  # the saloon has noise for both
        assert figures_of["before"] == entry["before"]
        assert (figures_of["trials"], figures_of["best_trial"]) == (6, best["trial"])
    told_search = document["search"]
    assert (told_search["trials"], told_search["seed"], told_search["floor_deg"]) == (6, 1, 0.05)
    assert (told_search["exploring_share"], told_search["step_shares"]) == (0.5, [0.15, 0.02])
    assert (told_search["min_availability"], told_search["low_speed_m_s"]) == (0.9, 3.0)
    assert [f["name"] for f in told_search["space"]] == ["q_vy", "q_yaw_rate", "r_ay", "r_yaw_rate"]
    with pytest.raises(EstimatorError, match="noise"):
        learn(arguments[2:], tmp_path / "other", settings)
    with pytest.raises(UsageError, match="trials"):
        replace(settings, trials=3)


def test_only_a_search_that_ends_badly_is_noted() -> None:
    good = Trial(0, "sobol", (0.1, 0.1, 0.5, 0.005), Score(1.0, 1.0, 1.0))
    edge = Trial(0, "sobol", (2.0, 0.1, 0.5, 0.0002), Score(1.0, 1.0, 1.0))
    assert noise._notes([Tuned("a", None, (good,), ()), Tuned("b", Score(1.0, 0, 0), (good,), ())]) == []
    notes = noise._notes([Tuned("a", Score(0.87654321, 0, 0), (edge,), ())])
    assert notes[0] == "a: the best q_vy, r_yaw_rate is at an end of the search space"
    assert "(0.8765 deg)" in notes[1] and len(notes) == 2


def test_what_a_person_wrote_is_no_search_s() -> None:
    searched = FilterNoise(q_std=(0.1, 0.1, 0.1), trial=3, score_deg=0.5)
    car = Car.of(VEHICLE, noise={"phy-ukf:tuned": searched, "physics": FilterNoise(q_std=(0.2, 0.2, 0.2))})
    assert noise._kept(car) == {"phy-ukf:tuned": searched.model_copy(update={"score_deg": None})}


def test_names_are_those_of_the_tables_in_their_order() -> None:
    car = Car.load("saloon")
    assert choose_names(None, car) == ("phy-ukf:tuned",)
    # Where no fit of it holds the noise of physics, it is tuned as all are.
    assert choose_names(None, replace(car, fitted_physics=None)) == ("physics", "phy-ukf:tuned")
    assert choose_names(("phy-ukf:tuned", "physics"), car) == ("physics", "phy-ukf:tuned")
    for wrong in ((), ("zero",), ("pd-hef",), ("physics", "physics")):
        with pytest.raises(UsageError, match="--estimators"):
            choose_names(wrong, car)


def test_a_bench_keeps_drives_within_the_memory_and_scores_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    from pdhef_logtool.estimators.table import Options, spec_of
    from pdhef_logtool.learning.noise.search import drive_error

    car = Car.of(VEHICLE)
    asked: list[Any] = []

    def load(log: LogInput, used: Car, _mapping: Any, _options: Any, *, refuse: Any, **named: Any) -> Any:
        asked.append((used, refuse(SimpleNamespace(available=frozenset({"speed_m_s", "steer_rad", "ax_m_s2"}))), named))
        assert refuse(ReadDrive()) == ""
        return record(log.stem, bytes_held=40), None if log.stem == "b" else WHOLE

    monkeypatch.setattr(bench, "load_drive", load)
    monkeypatch.setattr(bench, "MAX_BYTES", 100)
    config = replace(SALOON, sensors="esp")
    made = bench.Bench(car, None, config.read_options, ("phy-ukf:tuned", "physics"))
    loaded = [made.load(LogInput(Path(name), name)) for name in "ab"]
    assert [(r.name, drive is not None) for r, drive in loaded] == [("a", True), ("b", False)]
    used, why, _ = asked[0]
    lacks = "ay_m_s2, yaw_rate_rad_s"
    assert used is car and why == f"phy-ukf:tuned needs {lacks}; physics needs {lacks}"
    assert [one[2] for one in asked] == [{"least_scored": 100, "max_bytes": n} for n in (100, 60)]
    noise = FilterNoise(q_std=(0.1, 0.2, 0.3), r_std={"ay_m_s2": 0.5, "yaw_rate_rad_s": 0.004})
    own = spec_of("phy-ukf:tuned").make(car.with_noise("phy-ukf:tuned", noise), Options(use_speed=False))
    assert WHOLE.truth is not None
    expected = drive_error(run_window(own, WHOLE.signals)[0], WHOLE.truth, 3.0)
    assert made.score({"phy-ukf:tuned": noise}) == {"phy-ukf:tuned": [expected]}
    with pytest.raises(EstimatorError, match="c: expected"):
        made.load(LogInput(Path("c"), "c"))


# ---- extract ----


def test_extract_tells_its_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, float]] = []

    def one(job: Any, progress: Callable[[float], None]) -> Any:
        progress(0.5)
        return extract_command._failure(job, "it is no log")

    monkeypatch.setattr(extract_command, "_extract", one)
    arguments = logs(tmp_path / "set", "ab")
    warned: list[str] = []
    result = extract_command.extract(
        arguments,
        tmp_path / "out",
        extract_command.ExtractSettings(SALOON),
        reporter=Reporter(lambda *x: told.append(x), warned.append),
    )
    assert told == [("a", 0.25), ("a", 0.5), ("b", 0.75), ("b", 1.0)]
    assert warned == ["a is left out: it is no log", "b is left out: it is no log"]
    assert result.exit_code == 1
    assert result.manifest["failed"] == [{"log": n, "file": f"{n}.mcap", "reason": "it is no log"} for n in "ab"]
    assert result.manifest["vehicles"] == [] and result.manifest["period_s"] is None
