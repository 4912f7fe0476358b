"""``pdhef retrain``: who does what, stages that are done once, and a gate that says where the candidate goes."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.evaluation.comparison import Errors
from pdhef_logtool.learning.drives import DriveRecord
from pdhef_logtool.learning.resume import Stages
from pdhef_logtool.learning.retrain import retrain_command
from pdhef_logtool.learning.retrain.assignment import GATE, LEAST, SHARES, STOP, TRAIN, TRUST, Candidate, deal
from pdhef_logtool.learning.retrain.retrain_command import (
    ACCEPTED,
    CAR_FOLDER,
    RECORD_FILE,
    REJECTED,
    RetrainResult,
    RetrainSettings,
    retrain,
)
from pdhef_logtool.learning.score import Scored
from pdhef_logtool.records.errors import EXIT_GATE, EXIT_OK, EstimatorError, OutputError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.config import RunConfig

candidates = st.lists(
    st.builds(Candidate, st.text("abcdef", min_size=4, max_size=4), st.sampled_from(["", "", "train", "test", "odd"])),
    max_size=60,
    unique_by=lambda c: c.signals_sha256,
)


@settings(max_examples=60, deadline=None)
@given(candidates, candidates, st.integers(0, 3))
def test_a_drive_keeps_its_part_as_the_fleet_grows_whatever_the_order(
    first: list[Candidate], more: list[Candidate], seed: int
) -> None:
    roles = deal(first, {}, seed)
    assert deal(first[::-1], {}, seed) == roles
    grown = deal([*first, *more], roles, seed)
    assert {k: grown[k] for k in roles} == roles
    assert all(grown[c.signals_sha256] in c.allowed for c in first)


def test_parts_have_what_they_need_first_and_then_their_share() -> None:
    drives = [Candidate(f"{i:04x}") for i in range(200)]
    counts = Counter(deal(drives, {}, 0).values())
    assert all(abs(counts[role] - share * 200) <= 2 for role, share in SHARES.items())
    few = Counter(deal(drives[: sum(LEAST.values())], {}, 0).values())
    assert few == LEAST
    # What taught the car judges nothing, and a test set teaches nothing.
    taught = deal([replace(c, taught=True) for c in drives], {}, 0)
    assert set(taught.values()) == {TRAIN, STOP}
    assert set(deal([replace(c, split="test") for c in drives], {}, 0).values()) == {TRUST, GATE}
    assert set(deal([replace(c, split="extrapolation") for c in drives], {}, 0).values()) == {GATE}


def test_a_stage_is_done_once_for_a_basis_and_stands_whole_or_not_at_all(tmp_path: Path) -> None:
    said: list[str] = []
    stages = Stages(tmp_path, lambda found: f"came to {found['n']}", Reporter(note=said.append))
    done: list[int] = []

    def work(folder: Path) -> dict[str, Any]:
        done.append(1)
        (folder / "file").write_text("x")
        if len(done) == 3:
            raise KeyboardInterrupt
        return {"n": len(done)}

    assert [stages.do(1, "one", ["a"], 0.0, work)["n"] for _ in range(3)] == [1, 1, 1]
    assert said == ["one: came to 1 (0 s)", *["one: came to 1 (from an earlier call)"] * 2]
    assert stages.do(1, "one", ["b"], 0.0, work) == {"n": 2}
    with pytest.raises(KeyboardInterrupt):
        stages.do(2, "two", [], 0.0, work)
    assert not stages.place(2, "two").exists() and stages.place(1, "one").is_dir()


@dataclass
class Fleet:
    """Stages that cost nothing: logs by what they hold, and the errors of both cars on the drives of the gate."""

    folder: Path
    monkeypatch: pytest.MonkeyPatch
    done: list[str] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    gate: set[str] = field(default_factory=set)
    network: str = "a" * 64
    cap: float = 0.5
    better: Callable[[int], float] = lambda _: 0.9

    def __post_init__(self) -> None:
        for name in ("_extract", "_train", "_trust", "_intervals", "_read_log"):
            self.monkeypatch.setattr(retrain_command, name, getattr(self, name))
        self.monkeypatch.setattr(retrain_command, "score_slices", self._score)
        self.monkeypatch.setattr(retrain_command, "_car", lambda folder: folder)
        (self.folder / "logs").mkdir()

    def add(self, *names: str, holds: str = "") -> None:
        for name in names:
            (self.folder / "logs" / f"{name}.mcap").write_text(f"{name} {holds or name}")

    def _read_log(self, log: Any, tell: Any) -> Any:
        self.done.append(f"read {log.log_input.stem}")
        key = log.log_input.path.read_text().split()[1]
        left_out = "no true sideslip" if key == "nothing" else ""
        record = DriveRecord(log.log_input.stem, log.log_input.path.name, span_s=(0.0, 12.0), left_out=left_out)
        return retrain_command._Seen(record, None if left_out else f"signals {key}")

    def _extract(self, this: Any) -> dict[str, Any]:
        self.done.append("extract")
        both = sorted(i.stem for role in (TRAIN, STOP) for i in this.drives[role])
        return {"shown": "", "sha256": repr(both), "cells": {}, "splits": {}}

    def _train(self, this: Any, folder: Path, basis: str) -> dict[str, Any]:
        self.done.append("train")
        return {"shown": "", "sha256": self.network}

    def _trust(self, this: Any, folder: Path, network: Path) -> dict[str, Any]:
        self.done.append("trust")
        return {"shown": f"trust {self.cap:g}", "cap": self.cap, "evidence": "some"}

    def _intervals(self, this: Any, folder: Path) -> dict[str, Any]:
        self.done.append("intervals")
        (folder / CAR_FOLDER).mkdir()
        (folder / CAR_FOLDER / "vehicle.toml").write_text(f"network {self.network}")
        return {"shown": ""}

    def _score(self, car: Any, names: Any, slices: Any, mapping: Any, options: Any) -> Scored:
        """Return errors of 10 s a drive; those of the candidate, in ``work``, are ``better``."""
        self.done.append("score")
        self.gate = {i.stem for i in slices}
        count = len(self.gate) * 10
        drive, error = np.arange(count) // 10, np.random.default_rng(0).normal(0.0, 0.01, count)
        if "work" in str(car):
            error = error * np.array([self.better(int(i)) for i in drive])
        stamps = np.arange(count) * 1_000_000_000
        return Scored({names[0]: Errors(names[0], error, stamps)}, {})

    def retrain(self, **asked: Any) -> RetrainResult:
        """Call it, with what is done, said and told of this call alone."""
        self.done.clear()
        self.said.clear()
        self.told.clear()
        wanted = RetrainSettings(config=RunConfig(car=Path("saloon")), **asked)
        logs, out = [str(self.folder / "logs")], self.folder / "out"
        return retrain(logs, out, wanted, reporter=Reporter(warn=self.told.append, note=self.said.append))


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    made = Fleet(tmp_path, monkeypatch)
    made.add(*(f"d{i:02}" for i in range(30)))
    return made


ALL = ["extract", "train", "trust", "intervals", "score", "score"]


@pytest.mark.slow
def test_a_candidate_goes_where_its_verdict_belongs_and_what_is_new_is_done_alone(fleet: Fleet) -> None:
    out = fleet.folder / "out"
    found = fleet.retrain()
    assert found.accepted and found.exit_code == EXIT_OK
    assert [d for d in fleet.done if not d.startswith("read")] == ALL
    assert found.folder == out / ACCEPTED / ("a" * 12)
    assert {p.name for p in found.folder.iterdir()} == {CAR_FOLDER, RECORD_FILE}
    roles = {r.name: r.split for r in found.records}
    assert {n for n, role in roles.items() if role == GATE} == fleet.gate
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    again = fleet.retrain()
    assert fleet.done == [] and all(s.endswith("(from an earlier call)") for s in fleet.said) and len(fleet.said) == 5
    assert again.document == found.document
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before
    # A stricter verdict on the same candidate: only the gate is done again, and the candidate moves.
    fleet.better = lambda _: 1.0
    other = fleet.retrain(strict=True)
    assert fleet.done == ["score", "score"] and not other.accepted and not found.folder.exists()
    assert other.exit_code == EXIT_GATE and other.folder == out / REJECTED / ("a" * 12)
    assert json.loads((other.folder / RECORD_FILE).read_text())["reasons"] == other.document["reasons"] != []
    # More drives: each that was there keeps its part, and what rests on new ones is done anew.
    fleet.add(*(f"e{i:02}" for i in range(12)), "x", "y")
    fleet.add("z_copy", holds="d03")
    fleet.add("none", holds="nothing")
    fleet.network = "b" * 64
    grown = fleet.retrain()
    assert {d for d in fleet.done if d.startswith("read")} == {"read z_copy", "read none", "read x", "read y"} | {
        f"read e{i:02}" for i in range(12)
    }
    assert {r.name: r.split for r in grown.records if r.name in roles} == roles
    assert grown.document["judged"] == 2 and grown.folder.name == "b" * 12
    assert (
        "z_copy: left out, its signals equal those of d03" in fleet.told
        and "none is left out: no true sideslip" in fleet.told
    )


@pytest.mark.parametrize(
    ("better", "cap", "accepted", "why"),
    [
        (lambda i: 0.99 + 0.02 * (i % 2), 0.5, True, ""),
        (lambda i: 1.2 + 0.01 * i, 0.5, False, "worse"),
        (lambda i: 0.9, 0.0, False, "trust 0"),
    ],
)
def test_what_is_worse_or_may_not_be_followed_is_rejected_with_the_reason(
    fleet: Fleet, better: Callable[[int], float], cap: float, accepted: bool, why: str
) -> None:
    fleet.better, fleet.cap = better, cap
    found = fleet.retrain()
    assert found.accepted is accepted
    assert why in " ".join(found.document["reasons"])


def test_too_few_drives_and_wrong_calls_are_told(fleet: Fleet) -> None:
    for path in sorted((fleet.folder / "logs").iterdir())[8:]:
        path.unlink()
    with pytest.raises(EstimatorError, match="at least 3 for train"):
        fleet.retrain()


@pytest.mark.slow
def test_a_car_that_took_part_elsewhere_is_not_lost_when_the_stages_are(fleet: Fleet) -> None:
    found = fleet.retrain()
    shutil.rmtree(found.folder)
    assert fleet.retrain().folder.is_dir() and fleet.done == []
    roles = fleet.folder / "out/work/roles.json"
    sound = roles.read_text()
    for damaged in ("[]", "no json", '{"basis": 1, "digest": "a"}'):
        (fleet.folder / "out/work/seen.json").write_text(damaged)
        assert fleet.retrain().document == found.document
        roles.write_text(damaged)
        with pytest.raises(OutputError, match=r"roles\.json"):
            fleet.retrain()
        roles.write_text(sound)
    shutil.rmtree(fleet.folder / "out/work")
    assert fleet.retrain().document == found.document, "parts are drawn by content and seed"
