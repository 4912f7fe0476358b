"""``pdhef learn``: parts that do not mix, stages that are undone, a rerun that continues, and a car from one minute."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.car.car import FIT_FILE, Car
from pdhef_logtool.car.parts import Fit, FittedValues, physics_sha256
from pdhef_logtool.car.store import Change
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import AxleTyre, Tyres
from pdhef_logtool.evaluation.comparison import Errors
from pdhef_logtool.learning import engine
from pdhef_logtool.learning.drives import STAGES, LearnSettings
from pdhef_logtool.learning.engine import count_evaluations, learn
from pdhef_logtool.learning.page import draw_page, page_markdown
from pdhef_logtool.learning.score import paired_test
from pdhef_logtool.learning.split import (
    GAP_S,
    NETWORK_TRAINING,
    OWN_NETWORK_PART_S,
    PARTS,
    TEST,
    TRAINING,
    VALIDATION,
    WHOLE_DRIVES,
    DriveTimes,
    divided,
    pieces_of,
    shares_of,
    split_drives,
    usable_in,
)
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.config import RunConfig

ROUNDING_S = 2e-3


def _times(name: str, stretches: list[tuple[float, float]], period_s: float = 0.05) -> DriveTimes:
    """Stretches of (pause, driving) in seconds."""
    at, usable = 0.0, []
    for pause_s, driving_s in stretches:
        at += pause_s
        usable.append(at + np.arange(0.0, driving_s, period_s))
        at += driving_s
    return DriveTimes(LogInput(Path(f"{name}.mcap"), name), np.concatenate(usable), period_s)


stretches = st.lists(st.tuples(st.floats(0.0, 40.0), st.floats(1.0, 300.0)), min_size=1, max_size=5)


# ---- parts ----


@settings(max_examples=60, deadline=None)
@given(st.lists(stretches, min_size=1, max_size=WHOLE_DRIVES - 1), st.floats(0.0, 0.5))
def test_parts_of_a_drive_never_meet(drives: list[list[tuple[float, float]]], holdout: float) -> None:
    times = [_times(f"d{i}", s) for i, s in enumerate(drives)]
    parts = split_drives(times, holdout)
    assert set(parts) == set(PARTS) and bool(parts[TEST]) <= (holdout > 0.0)
    for drive in times:
        mine = [(s.span_s, part) for part in PARTS for s in parts[part] if s.path == drive.log.path and s.span_s]
        assert [s.stem for p in PARTS for s in parts[p] if s.path == drive.log.path] == [
            f"{drive.log.stem}_{a:g}-{b:g}s" for (a, b), _ in mine
        ]
        mine.sort()
        for ((_, end), part), ((start, _), other) in pairwise(mine):
            assert start - end > GAP_S - ROUNDING_S and part != other
        assert all(b > a for (a, b), _ in mine)
        assert not any(part == TEST for _, part in mine[:-1])
        assert not mine or (mine[0][0][0] >= drive.usable_s[0] - ROUNDING_S)
        assert not mine or mine[-1][0][1] <= drive.usable_s[-1] + ROUNDING_S


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(5.0, 60.0), min_size=WHOLE_DRIVES, max_size=40), st.floats(0.0, 0.5))
def test_many_drives_are_dealt_whole(lengths: list[float], holdout: float) -> None:
    times = [_times(f"d{i}", [(1.0, length)]) for i, length in enumerate(lengths)]
    parts = split_drives(times, holdout)
    taken = [s.path for part in PARTS for s in parts[part]]
    assert sorted(taken) == sorted(t.log.path for t in times)
    total = sum(t.seconds for t in times)
    for part, share in shares_of(total, holdout).items():
        got = sum(t.seconds for t in usable_in(times, parts[part]))
        assert abs(got - share * total) <= max(lengths) + 1.0


def test_a_minute_leaves_something_to_check_and_to_score_however_it_comes() -> None:
    for drives in ([(0.0, 60.0)], [(0.0, 20.0)] * 3, [(0.0, 35.0), (0.0, 25.0)]):
        times = [_times(f"d{i}", [one]) for i, one in enumerate(drives)]
        parts = split_drives(times, 0.15)
        usable = {p: sum(t.seconds for t in usable_in(times, parts[p])) for p in PARTS}
        assert usable[TRAINING] > 22.0 and usable[VALIDATION] > 9.5 and usable[TEST] > 9.5, drives


def test_shares_are_of_usable_driving_and_the_network_has_its_own_where_there_is_much() -> None:
    # Half of the log is a stop.
    little = _times("a", [(0.0, 50.0), (300.0, 250.0)])
    parts = split_drives([little], 0.15)
    usable = {p: sum(t.seconds for t in usable_in([little], parts[p])) for p in PARTS}
    assert parts[NETWORK_TRAINING] == () and len(parts[TRAINING]) == 1
    assert usable[TRAINING] == pytest.approx(0.85 * 0.82 * 300.0 - GAP_S / 2, abs=0.5)
    assert usable[VALIDATION] == pytest.approx(0.85 * 0.18 * 300.0 - GAP_S, abs=0.5)
    assert usable[TEST] == pytest.approx(0.15 * 300.0 - GAP_S / 2, abs=0.5)
    much = split_drives([_times("a", [(0.0, OWN_NETWORK_PART_S + 1.0)])], 0.15)
    assert len(much[TRAINING]) == len(much[NETWORK_TRAINING]) == len(much[VALIDATION]) == 2 and len(much[TEST]) == 1
    # Without a fit the network is trained on the training part, however much there is.
    assert split_drives([_times("a", [(0.0, 900.0)])], 0.15, ("gain", "network"))[NETWORK_TRAINING] == ()
    # Where nothing is trained all but the test part is for validation.
    alone = split_drives([_times("a", [(0.0, 900.0)])], 0.15, ("gain", "intervals"))
    assert alone[TRAINING] == () and len(alone[TEST]) == 1
    assert sum(t.seconds for t in usable_in([_times("a", [(0.0, 900.0)])], alone[VALIDATION])) > 740.0
    for share in (0.0, 0.15, 0.5):
        assert sum(shares_of(100.0, share).values()) == pytest.approx(1.0)
        assert sum(shares_of(1000.0, share).values()) == pytest.approx(1.0)


def test_a_slice_is_divided_with_a_gap_and_cut_into_pieces_of_usable_driving() -> None:
    drive = _times("a", [(0.0, 50.0), (100.0, 50.0)])
    (whole,) = usable_in([drive], [LogInput(drive.log.path, "a_0-200s", (0.0, 200.0))])
    first, rest = divided([whole], 0.75)
    assert [s.span_s for s in (*first, *rest)] == [(0.0, 172.5), (177.5, 199.95)]
    assert [s.stem for s in (*first, *rest)] == ["a_0-172.5s", "a_177.5-199.95s"]
    many = [_times(f"d{i}", [(0.0, 10.0)]) for i in range(10)]
    whole_ones = usable_in(many, [LogInput(d.log.path, f"{d.log.stem}_0-10s", (0.0, 10.0)) for d in many])
    assert [len(x) for x in divided(whole_ones, 0.8)] == [8, 2]
    pieces = pieces_of([whole], 30.0)
    assert len(pieces) == 3 and all(b.span_s[0] == a.span_s[1] for a, b in pairwise(pieces) if a.span_s and b.span_s)
    assert [s.span_s for s in pieces_of([whole], 101.0)] == [(0.0, 199.95)]


# ---- what stays ----


def _errors(*degrees: float) -> Errors:
    return Errors("x", np.radians(np.array(degrees)), np.arange(len(degrees)))


def test_what_is_worse_or_says_less_does_not_stay() -> None:
    nan = float("nan")
    good = paired_test(_errors(1.0, 1.0), _errors(0.5, -0.5))
    assert (good.was_deg, good.now_deg, good.better) == (1.0, 0.5, True)
    assert paired_test(_errors(0.5, 0.5), _errors(1.0, nan)).better is False
    assert paired_test(_errors(1.0, 1.0), _errors(-1.0, 1.0)).better is None
    # Where one of them says nothing, neither counts; an estimate that is missing too often is worse.
    assert paired_test(_errors(nan, *[1.0] * 10), _errors(9.0, *[0.5] * 10)).better is True
    assert paired_test(_errors(*[1.0] * 10), _errors(nan, nan, *[0.5] * 8)).better is False
    assert paired_test(_errors(1.0, nan), _errors(nan, 1.0)).better is False


def test_noise_must_be_better_beyond_doubt() -> None:
    def errors(size: np.ndarray) -> Errors:
        return Errors("x", size, np.arange(size.size) * 100_000_000)

    rng = np.random.default_rng(0)
    old = rng.normal(0.0, 1.0, 900)

    def verdict(before: np.ndarray, after: np.ndarray) -> bool:
        return paired_test(errors(before), errors(after)).confirmed

    assert verdict(old, 0.9 * old)
    assert not verdict(old[:700], 0.9 * old[:700])  # of seven blocks
    assert not verdict(old, rng.normal(0.0, 0.99, 900))
    assert not verdict(0.9 * old, old)
    assert not verdict(old, np.where(np.arange(900) < 300, np.nan, 0.5 * old))


def test_evaluations_of_the_same_driving_are_counted(tmp_path: Path) -> None:
    file = tmp_path / "evaluations.json"
    calls = ([["a", 90.0, 100.0], ["b", 0.0, 10.0]], [["a", 100.0, 110.0]], [["b", 9.0, 20.0]], [["a", 95.0, 105.0]])
    assert [count_evaluations(file, list(spans)) for spans in calls] == [1, 1, 2, 3]
    assert count_evaluations(file, []) == 1


@pytest.mark.parametrize(
    ("was", "now", "sure"), [(10, 8, True), (10, 7, False), (7, 7, True), (7, 6, False), (3, 4, True), (0, 0, True)]
)
def test_a_gain_is_not_worth_intervals_that_mean_nothing(was: int, now: int, sure: bool) -> None:
    old, new = (replace(_errors(*[1.0] * 10), inside=np.arange(10) < n) for n in (was, now))
    assert engine._still_sure(old, new) is sure


@pytest.mark.slow
def test_the_page_holds_any_name_and_what_was_not_known() -> None:
    line = {"name": "pd-hef-smoothed, trained", "causal": False, "share": 1.0, "covered": None}
    document = {
        "car_name": "a|b\x1b",
        "evaluations": 2,
        "versions": {"tool": "1"},
        "split": {"training": {"usable_s": 30.4, "slices": ["x|y_0-30s"]}, "test": {"usable_s": 0.0, "slices": []}},
        "stages": [
            {
                "name": "one",
                "status": "undone",
                "text": "why",
                "before": ["a", 0.5],
                "after": ["b", 0.75],
                "figures": {},
            },
            {"name": "two", "status": "not done", "text": "why not", "before": None, "after": None, "figures": {}},
        ],
        "validation": [
            {**line, "rmse_deg": [0.1, None, None], "against_hybrid_deg": [-0.02, -0.03, 0.01]},
            {"name": "physics, as given", "skipped": "no noise"},
        ],
        "test": [],
        "more": ["more | driving"],
    }
    page = page_markdown(document)
    for text in (
        "# Training of a\\|b\\x1b",
        "x\\|y_0-30s |",
        "| one | undone | a: 0.500 | b: 0.750 | why |",
        "| two | not done | – | – | why not |",
        "Nothing was held out.",
        "Number of evaluations on the test part, in calls with this output: 2.",
        "| pd-hef-smoothed, trained (not causal) | 0.100 | 100 % | – | -0.020 [-0.030, 0.010] |",
        "| physics, as given | – (no noise) |",
        "- more \\| driving",
    ):
        assert text in page, text
    assert draw_page(document).startswith(b"\x89PNG") and draw_page(document) == draw_page(document)


# ---- the command, with stages that are quick ----

SLICE = RunConfig(start="210", end="275")
GOOD, BAD = 1.0, 0.5
#: Everything but the intervals.
FOUR = STAGES[:4]


def _tyres(factor: float) -> Callable[[Task], StageOutput]:
    """Return a stage that gives the car the tyres that it should have, times a factor on its rear stiffness."""

    def run(task: Task) -> StageOutput:
        tyres = Tyres(
            front=AxleTyre(cornering_stiffness_n_per_rad=90_000.0),
            rear=AxleTyre(cornering_stiffness_n_per_rad=factor * 125_000.0),
        )
        fit = Fit(physics_sha256=physics_sha256(task.car.datasheet), values=FittedValues(tyres=tyres))
        change = Change("stage", FIT_FILE, {FIT_FILE: part_toml(fit, "made").encode()})
        return StageOutput(change, (), f"factor {factor}", {})

    return run


def _too_little(_task: Task) -> StageOutput:
    raise EstimatorError(expected="more", got="less", where="little")


def _interrupted(_task: Task) -> StageOutput:
    raise KeyboardInterrupt


@pytest.fixture
def guess(tmp_path: Path, sample_logs_dir: Path) -> Path:
    """A stranger's file of the saloon: its tyres are far too soft, and it knows of no network."""
    lines = (sample_logs_dir / "vehicle.toml").read_text(encoding="utf-8").splitlines(keepends=True)
    lines = [line for line in lines if not line.startswith(("[network]", "trust_cap", "evidence"))]
    text = "".join(lines).partition("[tyres")[0]
    stiffness = "cornering_stiffness_n_per_rad = 60000.0\n"
    path = tmp_path / "guess.toml"
    path.write_text(f"{text}[tyres.front]\n{stiffness}\n[tyres.rear]\n{stiffness}", encoding="utf-8")
    return path


def _content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_stages_that_raise_the_error_are_undone_and_a_rerun_continues_to_the_same_bytes(
    guess: Path, tmp_path: Path, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def counted(name: str, run: Callable[[Task], StageOutput]) -> Callable[[Task], StageOutput]:
        def count(task: Task) -> StageOutput:
            done.append(name)
            return run(task)

        return count

    stages = {"calibrate": _tyres(GOOD), "noise": _too_little, "gain": _tyres(BAD), "network": _tyres(GOOD)}
    for name, run in stages.items():
        monkeypatch.setitem(engine.RUN, name, counted(name, run))
    settings = LearnSettings(config=RunConfig(car=guess, start=SLICE.start, end=SLICE.end), stages=FOUR)
    logs = [str(sample_logs_dir / "road.mcap")]
    whole = tmp_path / "whole"
    result = learn(logs, whole, settings)
    assert [(s.name, s.status) for s in result.stages] == [
        ("calibrate", "kept"),
        ("noise", "not done"),
        ("gain", "undone"),
        ("network", "undone"),
    ]
    good, little, bad, again = result.stages
    assert good.before is not None and bad.before is not None
    assert good.after is not None and bad.after is not None and again.after is not None
    assert good.after[1] < good.before[1] and bad.after[1] > bad.before[1] == good.after[1] == again.after[1]
    assert "expected more, got less" in little.text and result.exit_code == 0
    assert Car.load(whole).vehicle.tyres.rear.cornering_stiffness_n_per_rad == 125_000.0
    assert sorted(p.name for p in (whole / "learn" / "3-gain").iterdir()) == ["step.json"]
    names = [line["name"] for line in result.document["test"]]
    assert names[:4] == ["zero", "kinematic", "open-loop, as given", "phy-ukf, as given"]
    page = (whole / "learn.md").read_text(encoding="utf-8")
    assert "| gain | undone |" in page and "scored once" in page
    json.dumps(result.to_dict())

    # The second is stopped after its first stage, continues, and then has nothing left to do.
    halted = tmp_path / "halted"
    monkeypatch.setitem(engine.RUN, "noise", _interrupted)
    with pytest.raises(KeyboardInterrupt):
        learn(logs, halted, settings)
    assert Car.load(halted).vehicle == Car.load(guess).vehicle  # a car all the time
    monkeypatch.setitem(engine.RUN, "noise", counted("noise", _too_little))
    done.clear()
    learn(logs, halted, settings)
    assert done == ["noise", "gain", "network"]
    assert _content(halted) == _content(whole)
    for folder in (halted, whole):  # what else is there stays; a part that was not made here does not
        (folder / "notes.txt").write_text("mine", encoding="utf-8")
    (halted / "noise.toml").write_text("stale", encoding="utf-8")
    done.clear()
    monkeypatch.setattr(engine, "score_slices", lambda *_: pytest.fail("scored more than once"))
    said: list[str] = []
    learn(logs, halted, settings, reporter=Reporter(note=said.append))
    assert not done and all("from an earlier call" in line for line in said) and _content(halted) == _content(whole)


@pytest.mark.slow
def test_other_settings_begin_anew_and_so_does_fresh(
    guess: Path, tmp_path: Path, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[int] = []
    good = _tyres(GOOD)

    def run(task: Task) -> StageOutput:
        done.append(1)
        return good(task)

    monkeypatch.setitem(engine.RUN, "calibrate", run)
    monkeypatch.setitem(engine.RUN, "noise", _too_little)
    end = {"car_name": "x", "evaluations": 1, "validation": [], "test": [], "more": []}
    monkeypatch.setattr(engine, "_end", lambda *_: end)
    logs = [str(sample_logs_dir / "road.mcap")]
    config = RunConfig(car=guess, start=SLICE.start, end=SLICE.end)
    settings = LearnSettings(config=config, stages=("noise", "calibrate"))
    for count, (holdout, fresh) in enumerate(((0.2, False), (0.3, False), (0.3, True)), start=1):
        learn(logs, tmp_path / "car", replace(settings, holdout=holdout), fresh=fresh)
        assert len(done) == count
    shutil.rmtree(tmp_path / "car" / "learn")
    learn(logs, tmp_path / "car", replace(settings, holdout=0.3))
    assert len(done) == 4


@pytest.mark.slow
def test_some_stages_start_from_the_parts_that_the_car_has(
    guess: Path, tmp_path: Path, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [str(sample_logs_dir / "road.mcap")]
    config = RunConfig(car=guess, start=SLICE.start, end=SLICE.end)
    monkeypatch.setitem(engine.RUN, "calibrate", _tyres(GOOD))
    learn(logs, tmp_path / "car", LearnSettings(config=config, stages=("calibrate",)))
    seen: list[Car] = []

    def run(task: Task) -> StageOutput:
        seen.append(task.car)
        raise EstimatorError(expected="more", got="less", where="gain")

    monkeypatch.setitem(engine.RUN, "gain", run)
    monkeypatch.setitem(engine.RUN, "intervals", run)
    settings = LearnSettings(config=replace(config, car=tmp_path / "car"), stages=("intervals", "gain"))
    result = learn(logs, tmp_path / "car", settings)
    assert [(s.name, s.status) for s in result.stages] == [("gain", "not done"), ("intervals", "not done")]
    assert {p.name for p in (tmp_path / "car/learn").iterdir()} >= {"0-start", "1-gain", "2-intervals", "3-end"}
    (tmp_path / "car/learn/4-former").mkdir()
    learn(logs, tmp_path / "car", settings)
    assert not (tmp_path / "car/learn/4-former").exists()
    assert all(car.vehicle.tyres.rear.cornering_stiffness_n_per_rad == 125_000.0 for car in seen)
    assert Car.load(tmp_path / "car").vehicle.tyres.rear.cornering_stiffness_n_per_rad == 125_000.0


@pytest.mark.slow
def test_a_minute_of_driving_gives_a_car_that_says_what_it_could_not_learn(
    guess: Path, tmp_path: Path, sample_logs_dir: Path
) -> None:
    config = RunConfig(car=guess, start="210", end="270")
    settings = LearnSettings(config=config, stages=("calibrate", "network", "intervals"))
    result = learn([str(sample_logs_dir / "road.mcap")], tmp_path / "car", settings)
    by_name = {s.name: s for s in result.stages}
    assert {by_name[n].status for n in ("network", "intervals")} == {"not done"}
    told = "\n".join(result.document["more"])
    for words in ("needs 100 s", "the 95 % intervals are not calibrated"):
        assert words in told


def test_a_removed_stage_is_answered_with_what_does_its_work() -> None:
    with pytest.raises(UsageError, match=r"identify was removed; use: pdhef learn without --stages"):
        LearnSettings(config=RunConfig(), stages=("identify", "noise"))
