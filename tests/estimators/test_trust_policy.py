"""How far pd-hef may follow a network: the vehicle file's evidence counts for the network that it is about."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from pdhef_logtool.estimators.registry import make_estimator
from pdhef_logtool.estimators.trust_policy import CAP_WITHOUT_EVIDENCE, allowed_trust

from pdhef_logtool.car.vehicle import Network, VehicleParameters, default_vehicle, load_vehicle, vehicle_to_toml
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.run.pipeline import run_logs
from pdhef_logtool.sinks.parquet import read_track
from pdhef_logtool.sinks.report import report_markdown

pytestmark = pytest.mark.slow

EVIDENCE = "a gain on one drive: 0.41° at trust 0, 0.33° at 0.5"


def _bundle(seed: int = 0) -> ModelBundle:
    torch.manual_seed(seed)
    n = len(FEATURES)
    network = ResidualNetwork(Architecture(n, 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    return ModelBundle(FEATURES, 8, 1, (4,), 0.01, Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0)), weights)


def _vehicle(**entries: object) -> VehicleParameters:
    return default_vehicle().model_copy(update={"network": Network(**entries)})  # type: ignore[arg-type]


def test_a_car_without_evidence_gets_none() -> None:
    assert CAP_WITHOUT_EVIDENCE == 0.0
    for vehicle in (default_vehicle(), _vehicle(trust_cap=1.0), _vehicle(trust_cap=0.5, evidence=" None ")):
        allowed = allowed_trust(vehicle, _bundle())
        assert allowed.cap == 0.0
        assert "no evidence" in allowed.reason
        assert "pdhef trust" in allowed.note


@pytest.mark.parametrize("cap", [0.0, 0.25, 0.5, 1.0])
def test_evidence_counts_for_its_network(cap: float) -> None:
    tried = _vehicle(trust_cap=cap, evidence=EVIDENCE, model_sha256=_bundle().sha256)
    allowed = allowed_trust(tried, _bundle())
    assert (allowed.cap, allowed.reason) == (cap, EVIDENCE)
    assert allowed.note == f"network trust {cap:g}: {EVIDENCE}"
    by_hand = _vehicle(trust_cap=cap, evidence=EVIDENCE)
    assert allowed_trust(by_hand, _bundle()).cap == allowed_trust(by_hand, _bundle(1)).cap == cap


def test_another_network_needs_evidence_of_its_own() -> None:
    tried, other = _vehicle(trust_cap=1.0, evidence=EVIDENCE, model_sha256=_bundle().sha256), _bundle(1)
    allowed = allowed_trust(tried, other)
    assert allowed.cap == 0.0
    assert _bundle().sha256[:12] in allowed.reason
    assert other.sha256[:12] in allowed.reason
    assert EVIDENCE not in allowed.reason


def test_the_entries_survive_the_file(tmp_path: Path) -> None:
    vehicle = _vehicle(trust_cap=0.25, evidence=EVIDENCE + ' "so to speak"', model_sha256="0" * 64)
    (tmp_path / "car.toml").write_text(vehicle_to_toml(vehicle))
    assert load_vehicle(tmp_path / "car.toml") == vehicle
    assert "model_sha256" not in vehicle_to_toml(default_vehicle())
    (tmp_path / "bad.toml").write_text(vehicle_to_toml(vehicle).replace("0" * 64, "0" * 63))
    with pytest.raises(VehicleError, match=r"network\.model_sha256"):
        load_vehicle(tmp_path / "bad.toml")


def test_only_pd_hef_heeds_the_cap() -> None:
    model = _bundle()
    for vehicle in (default_vehicle(), _vehicle(trust_cap=0.25, evidence=EVIDENCE, model_sha256=model.sha256)):
        assert make_estimator("pd-hef-trust1", vehicle, model=model).trust == 1.0  # type: ignore[attr-defined]
        assert make_estimator("pd-hef-fixed-r", vehicle, model=model).trust == 1.0  # type: ignore[attr-defined]
        capped = make_estimator("pd-hef", vehicle, model=model)
        assert getattr(capped, "trust", 0.0) == allowed_trust(vehicle, model).cap


def test_the_report_says_the_cap_and_why(
    sample_logs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    from pdhef_logtool.cli.run_tables import render_run

    model = _bundle()
    model.save(tmp_path / "model")
    car = load_vehicle(sample_logs_dir / "vehicle.toml")
    tried = Network(trust_cap=0.25, evidence=EVIDENCE, model_sha256=model.sha256)
    for network, cap, why in ((tried, 0.25, EVIDENCE), (Network(), 0.0, "no evidence")):
        file = tmp_path / f"car{cap}.toml"
        file.write_text(vehicle_to_toml(car.model_copy(update={"network": network})))
        config = RunConfig(
            vehicle=file, model=tmp_path / "model", estimators=("pd-hef", "pd-hef-trust1"), annotate="none"
        )
        result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / f"out{cap}", config)
        report = json.loads((tmp_path / f"out{cap}" / "logs" / "dlc" / "report.json").read_text())
        notes = {e["name"]: [n for n in e["notes"] if n.startswith("network trust")] for e in report["estimators"]}
        assert notes["pd-hef-trust1"] == []
        (note,) = notes["pd-hef"]
        assert note.startswith(f"network trust {cap:g}: ")
        assert why in note
        assert note in report_markdown(report)
        render_run(result, Console(width=400))
        assert f"pd-hef: {note}" in capsys.readouterr().out
        folder = tmp_path / f"out{cap}" / "logs" / "dlc"
        track = read_track(folder / "estimates.parquet", "pd-hef")
        assert set(np.unique(track.network_trust[track.valid])) == {cap}
