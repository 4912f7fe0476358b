"""The parts of a car, whatever the order of the stages: each is valid, or named as stale with its stage."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pdhef_logtool.car.car import HISTORY_FILE, Car
from pdhef_logtool.learning.stages import calibrate as stage
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.storage.documents import digest
from tests.learning.stage_run import run_stage

pytestmark = pytest.mark.slow

#: Files by the command that writes them; the first is the part.
FILES = {
    "calibrate": ("fit.toml",),
    "noise": ("noise.toml", "noise.record.json"),
    "gain": ("network.toml", "network.record.json"),
    "intervals": ("intervals.json",),
}
#: Every command follows every other one once.
ORDER = (
    *("noise", "gain", "intervals", "calibrate", "gain", "noise", "calibrate"),
    *("intervals", "noise", "intervals", "gain", "calibrate", "noise"),
)


def _bundle() -> ModelBundle:
    torch.manual_seed(0)
    n = len(FEATURES)
    network = ResidualNetwork(Architecture(n, 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    return ModelBundle(FEATURES, 8, 1, (4,), 0.01, Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0)), weights)


class Commands:
    """The learning commands on small drives; ``car`` is the folder that they all update."""

    def __init__(self, sample_logs_dir: Path, folder: Path) -> None:
        _bundle().save(folder / "model")
        self.guess = folder / "guess.toml"
        # Without the evidence that this file has for its network.
        lines = (sample_logs_dir / "vehicle.toml").read_text().splitlines(keepends=True)
        unwanted = ("[network]", "trust_cap", "evidence")
        self.guess.write_text("".join(line for line in lines if not line.startswith(unwanted)))
        self.car = folder / "mycar"
        self._logs = {
            name: [str(sample_logs_dir / f"{log}.mcap") for log in logs.split()]
            for name, logs in {
                "calibrate": "dlc step fishhook",
                "noise": "dlc",
                "gain": "dlc",
                "intervals": "dlc step fishhook sweep road",
            }.items()
        }

    def __call__(self, name: str) -> None:
        config = RunConfig(car=self.car if self.car.exists() else self.guess)
        logs = self._logs[name]
        if name == "calibrate":
            run_stage(name, logs, self.car, config)
        elif name == "noise":
            run_stage(name, logs, self.car, replace(config, estimators=("phy-ukf:tuned", "physics")), trials=4)
        elif name == "gain":
            run_stage(name, logs, self.car, replace(config, network=self.car.parent / "model", end="+5s"))
        else:
            run_stage(name, logs, self.car, replace(config, estimators=("physics",), end="+5s"), spread=0.0)

    def drives(self, name: str) -> list[str]:
        return [Path(log).stem for log in self._logs[name]]

    def contents(self) -> dict[str, bytes]:
        """Return all files of the car but its history."""
        files = {str(p.relative_to(self.car)): p.read_bytes() for p in self.car.rglob("*") if p.is_file()}
        files.pop("history.jsonl", None)
        return files

    def run(self, out: Path, log: str) -> tuple[list[str], dict[str, list[str]]]:
        """Return what a run says of the car's parts, and what its intervals are made of, by estimator."""
        told: list[str] = []
        config = RunConfig(car=self.car, estimators=("physics", "pd-hef"), annotate="none", end="+3s")
        result = run_logs([log], out, config, reporter=Reporter(warn=told.append))
        report = result.results[0].report
        assert report is not None
        return [t for t in told if "pdhef " in t], {e["name"]: e["intervals"] for e in report["estimators"]}


@pytest.fixture
def commands(sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Commands:
    fit: Callable[..., object] = stage.self_calibrate
    # Every calibration here has the same drives and start: one is enough.
    found: list[object] = []

    def once(*arguments: object, **named: object) -> object:
        if not found:
            found.append(fit(*arguments, **named))
        return found[0]

    monkeypatch.setattr(stage, "self_calibrate", once)
    return Commands(sample_logs_dir, tmp_path)


def _stale(notes: list[str] | tuple[str, ...]) -> set[str]:
    """Return the commands that notes name, each once."""
    named = [
        command for note in notes for command in FILES if f"pdhef learn --stages {command} creates it again" in note
    ]
    assert len(named) == len(notes) == len(set(named)), notes
    return set(named)


def test_every_order_gives_parts_that_are_valid_or_said_to_be_stale(commands: Commands, sample_logs_dir: Path) -> None:
    dlc = str(sample_logs_dir / "dlc.mcap")
    person = commands.guess.read_bytes()
    identified = False
    made: dict[str, tuple[bool, ...]] = {}  # part by command: what it was made with
    before: dict[str, bytes] = {}
    for number, command in enumerate(ORDER, start=1):
        # What counts is whether the car is identified, and whether it has tuned noise that belongs to it.
        identified |= command == "calibrate"
        tuned = made.get("noise") == (identified,)
        basis = (identified, tuned) if command == "gain" else (identified,)
        commands(command)
        after = commands.contents()

        assert after["vehicle.toml"] == person
        own = {f for f in after if f in FILES[command] or (command == "gain" and f.startswith("network/"))}
        assert set(FILES[command]) <= own
        assert {f: b for f, b in after.items() if f not in own} == {f: b for f, b in before.items() if f not in own} | {
            "vehicle.toml": person
        }
        history = [json.loads(line) for line in (commands.car / HISTORY_FILE).read_text().splitlines()]
        assert [line["command"] for line in history] == [f"learn --stages {name}" for name in ORDER[:number]]
        part = FILES[command][0]
        assert (history[-1]["part"], history[-1]["sha256"]) == (part, digest(after[part].decode()))
        assert [drive["name"] for drive in history[-1]["drives"]] == commands.drives(command)
        assert all(len(drive["sha256"]) == 64 and drive["end_s"] > 0.0 for drive in history[-1]["drives"])

        if command == "calibrate" and command in made:  # its input is the person's file and drives alone
            assert {f: after[f] for f in own} == {f: before[f] for f in own}
        made[command] = basis
        tuned = made.get("noise") == (identified,)
        expected = {c for c in ("noise", "intervals") if made.get(c, (identified,)) != (identified,)}
        expected |= {"gain"} if made.get("gain", (identified, tuned)) != (identified, tuned) else set()
        car = Car.load(commands.car)
        assert _stale(car.notes) == expected, (number, command)
        assert car.vehicle.name.endswith("(calibrated without ground truth)") == identified
        assert ("physics" in car.noise) == (tuned or identified)
        assert (car.fitted_physics is not None) == identified
        assert ("gain" in made) == car.allowed_trust.reason.startswith(("too little", "the car's evidence was found"))
        assert ("gain" in expected) == ("pdhef learn --stages gain creates it again" in car.allowed_trust.reason)
        before = after

        if number == ORDER.index("calibrate") + 1:
            assert expected == {"noise", "gain", "intervals"}
            said, notes = commands.run(commands.car.parent / "out", dlc)
            assert _stale(said) == expected
            assert notes["physics"] == ["intervals: own, parameters and sensors"]
        if (ORDER[number - 2], command) == ("intervals", "gain"):
            assert "intervals" not in expected
            said, notes = commands.run(commands.car.parent / "out", dlc)
            assert said == []
            assert notes["physics"] == [
                "intervals calibrated on truthsim saloon (calibrated without ground truth) for friction and vehicle "
                "as given"
            ]


# What calibrate writes twice is compared where it is tested; what that stage writes, above.
@pytest.mark.parametrize("command", ["noise", "gain"])
def test_the_same_command_on_the_same_input_gives_the_same_bytes(commands: Commands, command: str) -> None:
    commands(command)
    once = commands.contents(), (commands.car / "history.jsonl").read_bytes()
    shutil.rmtree(commands.car)
    commands(command)
    assert (commands.contents(), (commands.car / "history.jsonl").read_bytes()) == once
