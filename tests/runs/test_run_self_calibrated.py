"""A run with self-calibration: its users, its messages, and that no ground truth is read."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.model import fit
from pdhef_logtool.model.drive_model import DriveModel, read_driving
from pdhef_logtool.results.parquet_sink import list_estimators, read_track
from pdhef_logtool.runs import selection
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows

pytestmark = pytest.mark.slow

#: End of the part of the road drive that suffices for a calibration.
END = "110"
NAMES = ("zero", "open-loop", "open-loop:calibrated", "phy-ukf", "physics")


@pytest.fixture(scope="module")
def wrong_car(bare_vehicle: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bare vehicle file of the sample logs' car with half the front axle stiffness."""
    path = tmp_path_factory.mktemp("car") / "vehicle.toml"
    path.write_text(bare_vehicle.replace("B = 11.146", "B = 5.6"))
    return path


def run(log: Path, car: Path, out: Path, **changes: Any) -> dict[str, Any]:
    values: dict[str, Any] = {"car": car, "keep": "estimates", "estimators": NAMES, "end": END, **changes}
    run_logs([str(log)], out, RunConfig(**values), report=False)
    return json.loads((out / "logs" / log.stem / "report.json").read_text())


@pytest.fixture(scope="module")
def calibrated(sample_logs_dir: Path, wrong_car: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("log")
    run(sample_logs_dir / "road.mcap", wrong_car, out)
    return out


def causal_rows(folder: Path) -> dict[object, pl.Series]:
    """Return the column ``causal`` of estimates.parquet by estimator."""
    rows = pl.read_parquet(folder / "estimates.parquet").with_columns(pl.col("estimator").cast(pl.String))
    return {name: part["causal"] for (name,), part in rows.group_by("estimator", maintain_order=True)}


def rmse(out: Path, estimator: str) -> float:
    chosen = {"estimator": estimator, "signal": "sideslip_rad", "metric": "rmse", "segment": "all"}
    return float(pl.read_parquet(out / "metrics.parquet").filter(**chosen)["value"].item())


def test_calibrated_estimators_are_not_causal_and_say_so_and_the_others_keep_the_file(calibrated: Path) -> None:
    report = json.loads((calibrated / "logs/road/report.json").read_text())
    follows(report)
    told = {e["name"]: e for e in report["estimators"]}
    for name in ("physics", "open-loop:calibrated"):
        assert not told[name]["causal"]
        assert any("whole log" in note for note in told[name]["notes"])
    assert all(told[name]["causal"] for name in ("zero", "open-loop", "phy-ukf"))
    assert told["phy-ukf"]["algorithm"]["physics_sha256"] == report["vehicle"]["sha256"]
    assert told["physics"]["algorithm"]["physics_sha256"] != report["vehicle"]["sha256"]
    assert "calibrated on this log without ground truth" in report["answer"]["texts"]["assumed"]
    assert told["physics"]["intervals"] == ["intervals: own, parameters and sensors"]
    assert told["open-loop:calibrated"]["intervals"] == []
    assert not causal_rows(calibrated / "logs/road")["zero"].any(), "settings and model are those of the whole log"


def test_a_wrong_file_is_mended(calibrated: Path) -> None:
    assert rmse(calibrated, "physics") < 0.65 * rmse(calibrated, "phy-ukf")


def test_off_is_the_prior_about_the_file_and_causal(sample_logs_dir: Path, wrong_car: Path, tmp_path: Path) -> None:
    report = run(sample_logs_dir / "road.mcap", wrong_car, tmp_path, model="off", end="30", estimators=NAMES[:2])
    assert (report["self_calibration"]["parameters"], report["self_calibration"]["refused"]) == ([], None)
    assert all(e["causal"] for e in report["estimators"])


def test_a_model_of_an_earlier_drive_is_causal_and_mends_the_file(
    sample_logs_dir: Path, wrong_car: Path, calibrated: Path, tmp_path: Path
) -> None:
    model = calibrated / "logs/road/model.toml"
    report = run(sample_logs_dir / "dlc.mcap", wrong_car, tmp_path, model=model, end=None)
    follows(report)
    assert all(e["causal"] for e in report["estimators"] if e["name"] != "open-loop:calibrated")
    assert report["model"]["source"] == "file"
    causal = causal_rows(tmp_path / "logs/dlc")
    assert causal["zero"][100:].all() and causal["truth"].is_null().all()
    assert not causal["open-loop:calibrated"].any() and causal["selected"].equals(causal["physics"])
    assert "from earlier drives" in report["answer"]["texts"]["assumed"]
    assert rmse(tmp_path, "physics") < 0.65 * rmse(tmp_path, "phy-ukf")
    passed_on = tomllib.loads((tmp_path / "logs/dlc/model.toml").read_text())
    assert passed_on["parameters"] == tomllib.loads(model.read_text())["parameters"] != []


def test_no_truth_is_read(sample_logs_dir: Path, wrong_car: Path) -> None:
    """The same log with its truth made unreadable gives the same bits."""
    log, car, options = sample_logs_dir / "road.mcap", Car.load(wrong_car), ReadOptions(end=END)
    with read_drive(log, car, options=options) as drive:
        found = read_driving(drive)
        with_truth = DriveModel.fit(drive).posterior
    with read_drive(log, car, options=options, adjust=lambda _log, mapping, _tell: replace(mapping, truth={})) as drive:
        assert drive.plan.truth is None
        np.testing.assert_array_equal(read_driving(drive).columns, found.columns)
        alone = DriveModel.fit(drive).posterior
    assert with_truth is not None and alone is not None
    assert alone.to_dict() == with_truth.to_dict()


def test_a_short_log_is_refused_and_the_file_stays(sample_logs_dir: Path, wrong_car: Path, tmp_path: Path) -> None:
    report = run(sample_logs_dir / "sweep.mcap", wrong_car, tmp_path, end="4")
    assert "are needed" in report["self_calibration"]["refused"]
    told = {e["name"]: e for e in report["estimators"]}
    assert told["open-loop:calibrated"]["outcome"] == "skipped"
    assert "not calibrated on this log" in report["answer"]["texts"]["assumed"]


@pytest.mark.parametrize("given", [None, 0.8])
def test_a_car_that_slides_has_the_friction_that_it_reaches_if_none_is_given(
    sample_logs_dir: Path, wrong_car: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: float | None
) -> None:
    monkeypatch.setattr(fit, "SLIDING_RAD", 0.001)
    car = tmp_path / "vehicle.toml"
    car.write_text("\n".join(x for x in wrong_car.read_text().splitlines() if not x.startswith("friction =")))
    friction = {} if given is None else {"friction": given}
    report = run(sample_logs_dir / "sweep.mcap", car, tmp_path, estimators=("phy-ukf", "physics"), **friction)
    assert "slides" in report["self_calibration"]["refused"]
    causal = {e["name"]: e["causal"] for e in report["estimators"]}
    assert (causal["phy-ukf"], causal["physics"]) == (True, given is not None)
    assert report["friction"]["source"] == ("largest lateral acceleration" if given is None else "option")
    if given is None:  # a drive has one model, however often it is fitted
        with read_drive(sample_logs_dir / "sweep.mcap", Car.load(car), options=ReadOptions(end=END)) as drive:
            first, again = DriveModel.fit(drive), DriveModel.fit(drive)
        assert first.friction == again.friction and first.friction.to_dict() == report["friction"]
        assert first.car.self_calibrated is not None and again.car.self_calibrated is not None


def test_a_car_with_evidence_is_not_calibrated(sample_logs_dir: Path) -> None:
    with read_drive(sample_logs_dir / "road.mcap", Car.load(sample_logs_dir / "vehicle.toml")) as drive:
        assert drive.car.has_evidence
        assert DriveModel.fit(drive).posterior is None


def test_an_estimate_that_contradicts_the_sensors_is_not_selected_and_keeps_its_name(
    sample_logs_dir: Path, wrong_car: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever pd-hef is on this car, it stands for a large d2 here."""
    if Car.load().network is None:
        pytest.skip("no network is shipped, without which there is no pd-hef")
    monkeypatch.setattr(selection, "FACTOR", 0.0)
    names = ("zero", "phy-ukf", "pd-hef", "physics")
    report = run(sample_logs_dir / "sweep.mcap", wrong_car, tmp_path, estimators=names, end=None)
    follows(report)
    assert any(w.startswith("WARNING: pd-hef contradicts the sensors") for w in report["warnings"])
    assert report["selected_estimate"] == "physics"
    file = tmp_path / "logs" / "sweep" / "estimates.parquet"
    assert list_estimators(file) == ("truth", *names)
    selected, named, other = (read_track(file, name) for name in ("selected", "physics", "pd-hef"))
    np.testing.assert_array_equal(selected.sideslip_rad, named.sideslip_rad)
    assert (selected.sideslip_rad != other.sideslip_rad).any()
