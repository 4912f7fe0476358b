"""How far pd-hef may follow a network: the car's evidence counts for the network, physics and noise it is about."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_models import random_network

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedValues, Trust
from pdhef_logtool.car.toml_files import part_toml, read_vehicle_file, vehicle_toml
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.results.parquet_sink import read_track
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

EVIDENCE = "a gain on one drive: 0.41° at trust 0, 0.33° at 0.5"


def _car(bundle: ModelBundle | None = None, **entries: object) -> Car:
    return Car.of(default_vehicle(), network=bundle or random_network(), trust=Trust(**entries))  # type: ignore[arg-type]


def test_a_car_without_evidence_gets_none() -> None:
    bare = Car.of(default_vehicle(), network=random_network())
    for car in (bare, _car(trust_cap=1.0), _car(trust_cap=0.5, evidence=" None ")):
        allowed = car.allowed_trust
        assert allowed.cap == 0.0
        assert "no evidence" in allowed.reason
        assert "pdhef learn --stages gain" in allowed.note


@pytest.mark.parametrize("cap", [0.0, 0.25, 0.5, 1.0])
def test_evidence_counts_for_its_network(cap: float) -> None:
    allowed = _car(trust_cap=cap, evidence=EVIDENCE, network_sha256=random_network().sha256).allowed_trust
    assert (allowed.cap, allowed.reason) == (cap, EVIDENCE)
    assert allowed.note == f"residual gain {cap:g}: {EVIDENCE}"
    for bundle in (random_network(), random_network(1)):  # by hand
        assert _car(bundle, trust_cap=cap, evidence=EVIDENCE).allowed_trust.cap == cap


def test_another_network_needs_evidence_of_its_own() -> None:
    other = random_network(1)
    allowed = _car(other, trust_cap=1.0, evidence=EVIDENCE, network_sha256=random_network().sha256).allowed_trust
    assert allowed.cap == 0.0
    assert random_network().sha256[:12] in allowed.reason
    assert other.sha256[:12] in allowed.reason
    assert EVIDENCE not in allowed.reason


def test_other_physics_or_noise_need_evidence_of_their_own() -> None:
    car = _car()
    found = dict(zip(("physics_sha256", "noise_sha256"), car.tried_with, strict=True))
    tried = _car(trust_cap=1.0, evidence=EVIDENCE, network_sha256=random_network().sha256, **found)
    assert tried.allowed_trust.cap == 1.0
    fit = Fit(physics_sha256=car.physics_sha256, values=FittedValues(friction=0.5))
    assert "no evidence" in tried.with_fit(fit).allowed_trust.reason
    for what in ("physics", "noise"):
        other = _car(trust_cap=1.0, evidence=EVIDENCE, **{**found, f"{what}_sha256": "0" * 64})
        assert other.allowed_trust.cap == 0.0
        assert f"other {what}; pdhef learn --stages gain" in other.allowed_trust.reason
    assert tried.with_noise("physics", FilterNoise(q_std=(1.0, 1.0, 1.0))).allowed_trust.cap == 0.0
    assert tried.with_noise("phy-ukf:tuned", FilterNoise(q_std=(1.0, 1.0, 1.0))).allowed_trust.cap == 1.0
    heavier = tried.vehicle.model_copy(update={"mass_kg": 1500.0})
    assert tried.with_vehicle(heavier).allowed_trust.cap == 1.0  # a car made wrong on purpose is trusted as before


def test_the_entries_survive_the_part(tmp_path: Path) -> None:
    vehicle = default_vehicle()
    trust = Trust(trust_cap=0.25, evidence=EVIDENCE + ' "so to speak"', network_sha256="0" * 64)
    (tmp_path / "vehicle.toml").write_text(vehicle_toml(vehicle))
    (tmp_path / "network.toml").write_text(part_toml(trust, "Written by a test."))
    assert Car.load(tmp_path, network="none").trust == trust


def test_only_pd_hef_heeds_the_cap() -> None:
    model = random_network()
    for car in (_car(), _car(trust_cap=0.25, evidence=EVIDENCE, network_sha256=model.sha256)):
        assert make_estimator("pd-hef:gain=1", car).trust == 1.0  # type: ignore[attr-defined]
        assert make_estimator("pd-hef:fixed-r", car).trust == 1.0  # type: ignore[attr-defined]
        capped = make_estimator("pd-hef", car)
        assert getattr(capped, "trust", 0.0) == car.allowed_trust.cap


@pytest.mark.slow
def test_the_report_says_the_cap_and_why(
    sample_logs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    from pdhef_logtool.cli.run_tables import render_run

    model = random_network()
    model.save(tmp_path / "model")
    text = vehicle_toml(read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle)
    tried = Trust(trust_cap=0.25, evidence=EVIDENCE, network_sha256=model.sha256)
    for trust, cap, why in ((tried, 0.25, EVIDENCE), (Trust(), 0.0, "no evidence")):
        file = tmp_path / f"car{cap}"
        file.mkdir()
        (file / "vehicle.toml").write_text(text)
        (file / "network.toml").write_text(part_toml(trust, "Written by a test."))
        config = RunConfig(
            car=file,
            network=tmp_path / "model",
            estimators=("pd-hef", "pd-hef:gain=1"),
            annotate="none",
            calibrate="off",
        )
        result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / f"out{cap}", config)
        report = json.loads((tmp_path / f"out{cap}" / "logs" / "dlc" / "report.json").read_text())
        notes = {e["name"]: [n for n in e["notes"] if n.startswith("residual gain")] for e in report["estimators"]}
        assert notes["pd-hef:gain=1"] == []
        (note,) = notes["pd-hef"]
        assert note.startswith(f"residual gain {cap:g}: ")
        assert why in note
        assert note in report_markdown(report)
        render_run(result, Console(width=400))
        used = f"residual gain of the network {cap:g}, from the car's validation data"
        said = used if cap else "network not used"
        assert said in capsys.readouterr().out
        folder = tmp_path / f"out{cap}" / "logs" / "dlc"
        track = read_track(folder / "estimates.parquet", "pd-hef")
        assert set(np.unique(track.network_trust[track.valid])) == {cap}
