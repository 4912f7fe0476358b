"""The whole way on sample logs: outputs, windows, slices, failures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.table import all_names
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows

pytestmark = pytest.mark.slow

TABLES = {"estimates.parquet", "metrics.parquet", "recording.rrd", "report.html", "report.json", "model.toml"}
OUTPUTS = TABLES | {"annotated.mcap", "foxglove.json", "plotjuggler.xml"}

NO_TRUTH_MAPPING = "".join(
    f'[signals.{signal}]\ntopic = "{topic}"\nfield = "{field}"\n'
    for signal, topic, field in (
        ("steer_rad", "/vehicle/status/steering_status", "steering_tire_angle"),
        ("ax_m_s2", "/imu/data", "linear_acceleration.x"),
        ("ay_m_s2", "/imu/data", "linear_acceleration.y"),
        ("yaw_rate_rad_s", "/imu/data", "angular_velocity.z"),
        ("wheel_speed_rl_m_s", "/vehicle/wheel_speeds", "rl_m_s"),
        ("wheel_speed_rr_m_s", "/vehicle/wheel_speeds", "rr_m_s"),
    )
)


def _config(sample_logs_dir: Path, **changes: Any) -> RunConfig:
    values: dict[str, Any] = {"car": sample_logs_dir / "vehicle.toml", "keep": "estimates", **changes}
    return RunConfig(**values)


def _value(metrics: pl.DataFrame, estimator: str, signal: str, metric: str, segment: str = "all") -> float:
    rows = metrics.filter(
        (pl.col("estimator") == estimator)
        & (pl.col("signal") == signal)
        & (pl.col("metric") == metric)
        & (pl.col("segment") == segment)
    )
    assert rows.height == 1, rows
    return float(rows["value"][0])


@pytest.fixture(scope="module")
def dlc_run(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dlc")
    result = run_logs(
        [str(sample_logs_dir / "dlc.mcap")],
        out,
        _config(sample_logs_dir, keep="full", annotate="full", estimators=("all",)),
    )
    assert result.exit_code == 0
    return out


def test_everything_that_a_run_promises_is_there_and_nothing_else(dlc_run: Path) -> None:
    assert {p.name for p in (dlc_run / "logs" / "dlc").iterdir()} == OUTPUTS
    assert {p.name for p in dlc_run.iterdir()} == {
        "logs", "metrics.parquet", "report.html", "report.json", "run.json", "tables",
    }  # fmt: skip


def test_documents_follow_their_schemas(dlc_run: Path, sample_logs_dir: Path) -> None:

    report = json.loads((dlc_run / "logs/dlc/report.json").read_text())
    run = json.loads((dlc_run / "run.json").read_text())
    follows(report)
    follows(run, "run.schema.json")
    assert run["logs"][0]["outcome"] == "ok"
    assert [e["name"] for e in report["estimators"]] == list(all_names(Car.load(sample_logs_dir / "vehicle.toml")))


def test_metrics_agree_with_the_estimates_that_were_written(dlc_run: Path) -> None:
    estimates = pl.read_parquet(dlc_run / "logs/dlc/estimates.parquet")
    metrics = pl.read_parquet(dlc_run / "metrics.parquet")
    truth = estimates.filter(pl.col("estimator") == "truth")
    for name in ("zero", "kinematic", "open-loop", "phy-ukf"):
        both = estimates.filter(pl.col("estimator") == name).join(truth, on="stamp_ns", suffix="_truth")
        both = both.filter(pl.col("valid") & pl.col("valid_truth") & (pl.col("vx_m_s_truth") > 3.0))
        error = (both["sideslip_rad"] - both["sideslip_rad_truth"]).to_numpy()
        error = error[np.isfinite(error)]
        rmse = float(np.sqrt(np.mean(error**2)))
        assert _value(metrics, name, "sideslip_rad", "rmse") == pytest.approx(rmse, rel=1e-4)  # the file is rounded


def test_same_input_gives_the_same_bytes(sample_logs_dir: Path, tmp_path: Path) -> None:
    config = _config(sample_logs_dir, keep="full", annotate="full", estimators=("zero", "physics"), end="4")
    for folder in ("a", "b"):
        run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / folder, config)
    for name in ("run.json", "report.html", "metrics.parquet", *(f"logs/dlc/{n}" for n in OUTPUTS - {"recording.rrd"})):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_slice_scores_the_slice_alone(sample_logs_dir: Path, tmp_path: Path) -> None:
    log = sample_logs_dir / "dlc.mcap"
    run_logs(
        [str(log)], tmp_path, _config(sample_logs_dir, start="2", end="end-3s", estimators=("phy-ukf",)), report=False
    )
    report = json.loads((tmp_path / "logs/dlc/report.json").read_text())
    stamps = pl.read_parquet(tmp_path / "logs/dlc/estimates.parquet")["stamp_ns"]
    assert report["log"]["duration_s"] == pytest.approx(9.5 - 5.0, abs=0.1)
    assert report["log"]["start_ns"] - 20_000_000 <= stamps.min() <= stamps.max() < report["log"]["end_ns"]


def test_estimates_do_not_depend_on_whether_truth_is_mapped(
    sample_logs_dir: Path, tmp_path: Path, dlc_run: Path
) -> None:
    (tmp_path / "m.toml").write_text(NO_TRUTH_MAPPING)
    config = _config(sample_logs_dir, mapping=tmp_path / "m.toml", estimators=("kinematic", "phy-ukf"))
    full_wheels = pl.read_parquet(dlc_run / "logs/dlc/estimates.parquet").filter(pl.col("estimator") == "phy-ukf")
    run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / "a", config, report=False)
    without = pl.read_parquet(tmp_path / "a/logs/dlc/estimates.parquet").filter(pl.col("estimator") == "phy-ukf")
    assert json.loads((tmp_path / "a/logs/dlc/report.json").read_text())["truth"]["available"] is False
    figures = set(pl.read_parquet(tmp_path / "a/metrics.parquet")["metric"])
    assert {"nis", "disagreement_rms", "nis_autocorrelation"} <= figures and "rmse" not in figures
    truth = '[truth.vy_m_s]\ntopic = "/truth/perfect/odometry"\nfield = "twist.twist.linear.y"\n'
    truth += '[truth.vx_m_s]\ntopic = "/truth/perfect/odometry"\nfield = "twist.twist.linear.x"\n'
    (tmp_path / "m.toml").write_text(NO_TRUTH_MAPPING + truth)
    run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / "b", config, report=False)
    with_truth = pl.read_parquet(tmp_path / "b/logs/dlc/estimates.parquet").filter(pl.col("estimator") == "phy-ukf")
    pose = ["x_m", "y_m", "yaw_rad"]
    assert without.drop(pose).equals(with_truth.drop(pose), null_equal=True)
    assert not without.drop(pose).equals(full_wheels.drop(pose), null_equal=True)  # four wheels are not two


def test_all_logs_bad_is_a_failure(sample_logs_dir: Path, tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"no log")
    assert run_logs([str(tmp_path)], tmp_path / "out", _config(sample_logs_dir)).exit_code == 1
    with pytest.raises(LogError):
        run_logs([str(tmp_path / "a.mcap")], tmp_path / "out1", _config(sample_logs_dir))


def test_what_ran_under_a_name_stands_in_every_record(dlc_run: Path) -> None:
    from mcap.reader import make_reader

    folder = dlc_run / "logs" / "dlc"
    told = {e["name"]: e["algorithm"] for e in json.loads((folder / "report.json").read_text())["estimators"]}
    assert None not in told.values()
    assert told["phy-ukf"]["algorithm"] == "vehicle-ukf"
    for metrics in (dlc_run / "metrics.parquet", folder / "metrics.parquet"):
        rows = pl.read_parquet(metrics).select("estimator", "algorithm").unique()
        of = {name: digest for name, digest in rows.iter_rows() if name in told}
        assert of == {name: told[name]["sha256"][:12] for name in of}
        assert {"phy-ukf", "pd-hef"} <= of.keys()
    with (folder / "annotated.mcap").open("rb") as stream:
        (record,) = [m.metadata for m in make_reader(stream).iter_metadata() if m.name == "pdhef.metrics"]
    assert {n: json.loads(record[f"{n}/algorithm"]) for n in told} == told
