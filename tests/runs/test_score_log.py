"""Estimates recorded in a log, scored against figures that another path computed."""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import pdhef_logtool as pdhef
from pdhef_logtool import Reporter, RunConfig, open_run
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.reports.drive import drive_page
from pdhef_logtool.reports.pdf import pdf_page
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.recorded_estimates import score_log
from pdhef_logtool.runs.run_result import RunResult
from tests.command_line import rendered
from tests.run_report import follows, text_of
from tests.runs.test_inspection_report import write_log
from tests.runs.test_run import NO_TRUTH_MAPPING
from tests.runs.wrong_mapping import wrong_sign

ERRORS = ("rmse", "rmse_relative", "mae", "bias", "p95_abs", "max_abs", "coverage95", "lag_s", "availability", "nees")

Key = tuple[str, str, str]


@pytest.fixture(scope="module")
def annotated(sample_logs_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("annotated")
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", estimators=("phy-ukf", "zero"))
    run_logs([str(sample_logs_dir / "dlc.mcap")], out, config)
    return out / "logs/dlc"


@pytest.fixture
def config(sample_logs_dir):
    return RunConfig(car=sample_logs_dir / "vehicle.toml")


def _figures(metrics: list[dict[str, Any]], estimator: str) -> dict[Key, tuple[float | None, int]]:
    return {
        (m["signal"], m["segment"], m["metric"]): (m["value"], m["n"])
        for m in metrics
        if m["estimator"] == estimator and (m["metric"] in ERRORS or m["metric"] == "diverged")
    }


def _scored(annotated: Path, config: RunConfig, *estimates: str, **options: Any) -> dict[str, Any]:
    result = score_log(str(annotated / "annotated.mcap"), config, estimates=estimates, **options)
    (log,) = result.results
    assert log.report is not None
    return log.report | {"metrics": [asdict(row) for row in log.rows]}


def _value(report: dict[str, Any], signal: str, metric: str, estimator: str | None = None) -> float:
    found = [
        m["value"]
        for m in report["metrics"]
        if (m["signal"], m["segment"], m["metric"]) == (signal, "all", metric)
        and (estimator is None or m["estimator"] == estimator)
    ]
    assert len(found) == 1
    return float(found[0])


@pytest.mark.slow
def test_state_topic_gives_the_figures_of_the_run_that_wrote_it(annotated, sample_logs_dir):
    config = RunConfig(car=sample_logs_dir / "vehicle.toml")
    report = _scored(annotated, config, "/pdhef/phy_ukf/state")
    of_run = _figures(pl.read_parquet(annotated / "metrics.parquet").to_dicts(), "phy-ukf")
    again = _figures(report["metrics"], "phy-ukf")
    assert again.keys() == of_run.keys()
    assert {("sideslip_rad", "nonlinear", "rmse"), ("sideslip_rad", "all", "coverage95"), ("state", "all", "nees")} <= (
        again.keys()
    )
    assert {("lateral_1s_m", "all", "rmse"), ("ay_m_s2", "linear", "bias")} <= again.keys()
    for key, (value, n) in of_run.items():
        assert again[key][1] == n, key
        assert again[key][0] == (value if value is None else pytest.approx(value, rel=1e-3, abs=1e-6)), key


@pytest.mark.slow
def test_named_fields_and_a_table_with_scale_give_the_same(annotated, sample_logs_dir, tmp_path, config):
    whole = _scored(annotated, config, "/pdhef/phy_ukf/state")
    named = _scored(
        annotated, config, "sideslip_rad=/pdhef/phy_ukf/state.sideslip_rad", "/pdhef/phy_ukf/state.vx_m_s",
        "sideslip_std_rad=/pdhef/phy_ukf/state.sideslip_std_rad", name="mine",
    )  # fmt: skip
    (tmp_path / "m.toml").write_text(
        '[estimates.turned.sideslip_rad]\ntopic = "/pdhef/phy_ukf/state"\nfield = "sideslip_rad"\nscale = -1.0\n'
        '[estimates.same.sideslip_rad]\ntopic = "/pdhef/phy_ukf/state"\nfield = "sideslip_rad"\n'
    )
    tables = RunConfig(car=sample_logs_dir / "vehicle.toml", mapping=tmp_path / "m.toml")
    both = _scored(annotated, tables)
    for metric in ("rmse", "bias", "p95_abs"):
        expected = pytest.approx(_value(whole, "sideslip_rad", metric), rel=1e-9)
        assert _value(named, "sideslip_rad", metric, "mine") == expected
        assert _value(both, "sideslip_rad", metric, "same") == expected
    assert _value(named, "sideslip_rad", "coverage95") == _value(whole, "sideslip_rad", "coverage95")
    assert _value(both, "sideslip_rad", "rmse", "turned") > 2.0 * _value(both, "sideslip_rad", "rmse", "same")
    assert {m["estimator"] for m in _scored(annotated, tables, name="same")["metrics"]} == {"same", "sensors"}
    with pytest.raises(UsageError, match="turned"):
        _scored(annotated, tables, name="third")


def test_outputs_are_those_of_a_run(annotated, config, tmp_path):
    _scored(annotated, config, "/pdhef/phy_ukf/state", output=tmp_path)
    folder = tmp_path / "logs/annotated"
    assert {p.name for p in folder.iterdir()} == {"estimates.parquet", "metrics.parquet", "report.json"}
    assert {p.name for p in tmp_path.iterdir()} == {"logs", "metrics.parquet", "run.json", "tables"}
    report = json.loads((folder / "report.json").read_text())
    follows(report)
    run = json.loads((tmp_path / "run.json").read_text())
    follows(run, "run.schema.json")
    assert run["config"]["estimates"]["phy-ukf"]["vx_m_s"] == "/pdhef/phy_ukf/state.vx_m_s"
    again, of_run = (pl.read_parquet(place / "estimates.parquet") for place in (folder, annotated))
    for name in ("phy-ukf", "truth"):
        a, b = (f.filter(pl.col("estimator") == name) for f in (again, of_run))
        assert a["stamp_ns"].equals(b["stamp_ns"]) and a["valid"].equals(b["valid"]), name


@pytest.mark.parametrize(
    ("estimates", "error", "said"),
    [
        (("/pdhef/phy_ukf/stat",), MappingError, "did you mean /pdhef/phy_ukf/state?"),
        (("sideslip_rad=/pdhef/phy_ukf/state.sideslip",), MappingError, "did you mean sideslip_rad?"),
        (("sideslip_deg=/pdhef/phy_ukf/state.sideslip_rad",), UsageError, "did you mean sideslip_rad?"),
        (("/imu/data.angular_velocity.z",), UsageError, "SIGNAL=TOPIC.FIELD"),
        (("sideslip_rad=/pdhef/phy_ukf/state",), UsageError, "sideslip_rad=/pdhef/phy_ukf/state.FIELD"),
        (("/pdhef/phy_ukf/state", "/pdhef/zero/state"), UsageError, "each signal once"),
        (("sideslip_std_rad=/pdhef/phy_ukf/state.sideslip_std_rad",), UsageError, "one of sideslip_rad"),
        (("colour=/pdhef/phy_ukf/state.sideslip_rad",), UsageError, "got 'colour'"),
        (("=/pdhef/phy_ukf/state.sideslip_rad",), UsageError, "SIGNAL out of"),
        (("sideslip_rad=/nowhere/near.beta",), MappingError, "pdhef inspect lists the topics"),
        ((), UsageError, "an estimate to score"),
    ],
)
def test_wrong_estimates_are_one_clear_line(annotated, config, estimates, error, said):
    with pytest.raises(error, match=re.escape(said)):
        _scored(annotated, config, *estimates)


@pytest.mark.parametrize("name", ["truth", "sensors", ""])
def test_names_that_the_tables_use_themselves_are_refused(annotated, config, name):
    with pytest.raises(UsageError, match="--name"):
        _scored(annotated, config, "/pdhef/zero/state", name=name)


def test_no_truth_is_an_error_that_says_what_to_do(annotated, sample_logs_dir, tmp_path):
    (tmp_path / "m.toml").write_text('[signals.yaw_rate_rad_s]\ntopic = "/imu/data"\nfield = "angular_velocity.z"\n')
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", mapping=tmp_path / "m.toml")
    with pytest.raises(MappingError, match="--truth"):
        _scored(annotated, config, "/pdhef/zero/state")


def test_an_estimate_that_is_the_truth_is_marked(annotated, config):
    report = _scored(annotated, config, "/truth/perfect/odometry", name="copy")
    dependent = {m["signal"] for m in report["metrics"] if m["metric"] == "not_independent"}
    assert dependent == {"vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad"}
    marked = {m["signal"] for m in report["metrics"] if not m["independent"]}
    assert set(report["truth"]["not_independent"]) == marked >= dependent
    honest = _scored(annotated, config, "/pdhef/phy_ukf/state")
    assert "not_independent" not in {m["metric"] for m in honest["metrics"]}


def test_other_stamps_than_the_truths_without_any_imu(tmp_path):
    """A straight line in closed form: linear truth at 50 Hz, an estimate at odd stamps with a known error."""
    start = 1_700_000_000_000_000_000
    at_truth = start + np.arange(500) * 20_000_000
    at_estimate = start + 3_333_333 + np.arange(310) * 33_000_000

    def seconds(stamps: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return (stamps - start) * 1e-9

    t = seconds(at_estimate)
    bias, noise = 0.02, 0.05 * np.where(np.arange(310) % 2 == 0, 1.0, -1.0)
    log, with_error = tmp_path / "line.mcap", {"vx": 10.0 + t + noise, "vy": 0.1 * t + bias, "r": 0.3 + 0.0 * t}
    right = {"vx": 10.0 + seconds(at_truth), "vy": 0.1 * seconds(at_truth), "r": 0.3 + 0.0 * at_truth}
    write_log(log, {"/ins": right, "/mine": with_error}, {"/ins": at_truth, "/mine": at_estimate})
    estimates, truth = (
        [f"{signal}={topic}.{field}" for signal, field in (("vx_m_s", "vx"), ("vy_m_s", "vy"), ("yaw_rate_rad_s", "r"))]
        for topic in ("/mine", "/ins")
    )
    said: list[str] = []
    reporter = Reporter(warn=said.append)
    result = score_log(str(log), RunConfig(), estimates=estimates, truth=truth, name="mine", reporter=reporter)
    (log,) = result.results
    assert log.report is not None
    report = log.report | {"metrics": [asdict(row) for row in log.rows]}
    assert _value(report, "vx_m_s", "rmse") == pytest.approx(0.05, rel=1e-6)
    assert _value(report, "vy_m_s", "bias") == pytest.approx(0.02, rel=1e-6)
    inside = t <= seconds(at_truth)[-1]
    assert 290 < inside.sum() < 310  # the estimate outlives its truth
    assert {m["n"] for m in report["metrics"] if m["metric"] == "rmse" and m["segment"] == "all"} == {int(inside.sum())}
    assert report["truth"]["latency_s"] is None
    assert any("latency" in note and "0" in note for note in report["truth"]["notes"])
    assert any("no IMU" in text for text in said)


def test_named_truth_replaces_the_recognised_one(annotated, config):
    truth = ["/pdhef/zero/state.vx_m_s", "/pdhef/zero/state.vy_m_s"]
    report = _scored(annotated, config, "/pdhef/phy_ukf/state", truth=truth)
    sources = report["truth"]["quantities"]
    assert sources["vy_m_s"] == "/pdhef/zero/state.vy_m_s"
    stamps = pl.read_parquet(annotated / "estimates.parquet")
    a, b = (stamps.filter(pl.col("estimator") == n)["vy_m_s"].to_numpy() for n in ("phy-ukf", "zero"))
    difference = (a - b)[np.isfinite(a - b)]
    # The latency of ground truth without a yaw rate cannot be measured, so that the two are compared stamp by stamp.
    assert _value(report, "vy_m_s", "rmse") == pytest.approx(math.sqrt(float(np.mean(difference**2))), rel=1e-6)


def test_key_figures_of_manoeuvres_are_those_of_the_run(sample_logs_dir, tmp_path):
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", estimators=("zero",))
    run_logs([str(sample_logs_dir / "step.mcap")], tmp_path, config)

    def steps(metrics: list[dict[str, Any]]) -> dict[Key, float]:
        chosen = [m for m in metrics if m["metric"].startswith("step_")]
        return {(m["estimator"], m["signal"], m["metric"]): m["value"] for m in chosen}

    of_run = steps(pl.read_parquet(tmp_path / "logs/step/metrics.parquet").to_dicts())
    (log,) = score_log(str(tmp_path / "logs/step/annotated.mcap"), config, estimates=["/pdhef/zero/state"]).results
    assert steps(log.report["metrics"]) == pytest.approx(of_run, rel=1e-5)
    assert {estimator for estimator, *_ in of_run} == {"zero", "truth"}


ESTIMATE = ("/rtk/odometry",)


def _metrics(log, **settings):
    config = RunConfig(car=log.parent / "vehicle.toml", end="8", **settings)
    report = score_log(str(log), config, estimates=ESTIMATE).results[0].report
    found = {m["metric"]: m["value"] for m in report["metrics"] if m["signal"] == "sideslip_rad"}
    return report, found


def test_beside_ground_truth_both_figures_exist(sample_logs_dir):
    log = sample_logs_dir / "dlc.mcap"
    report, found = _metrics(log, reference="on")
    assert report["truth"]["available"]
    assert np.degrees(found["rmse"]) < 0.1
    assert np.degrees(found["reference_rms"]) < 3.0 * np.degrees(found["reference_std"])
    _, alone = _metrics(log)
    assert alone["rmse"] == found["rmse"]
    assert "reference_rms" not in alone


def test_without_ground_truth_no_figure_is_an_error(sample_logs_dir, tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(NO_TRUTH_MAPPING)
    report, found = _metrics(sample_logs_dir / "dlc.mcap", mapping=mapping)
    assert not report["truth"]["available"]
    assert "rmse" not in found
    assert np.degrees(found["reference_rms"]) < 0.5
    with pytest.raises(MappingError, match="ground truth"):
        _metrics(sample_logs_dir / "dlc.mcap", mapping=mapping, reference="off")


# ---- report.json: at most 120 paths, 40 kB for a drive of 10 s; terminal, page and PDF agree with it ----

#: Entries whose keys are names: of parameters, of quantities, of reasons, of packages, of the recorder.
NAMED = ("assumed", "dropped", "metadata", "options", "quantities", "versions")


def paths(value: Any, at: str = "") -> Iterator[str]:
    """Yield the path of each leaf; entries of a list have one path, and so have entries by name."""
    if at.rpartition(".")[2] in NAMED:
        yield f"{at}.*"
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield from paths(entry, f"{at}.{key}")
    elif isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value):
        for entry in value:
            yield from paths(entry, f"{at}[]")
    else:
        yield at


@pytest.mark.parametrize(
    ("log", "settings"),
    [
        ("dlc", {"car": Path("saloon"), "plan": Path("sample_logs/plan.toml")}),
        pytest.param("fishhook", {}, marks=pytest.mark.slow),
        pytest.param("faults", {"end": "10"}, marks=pytest.mark.slow),
    ],
)
def test_the_document_of_ten_seconds_is_short(log, settings, sample_logs_dir, tmp_path):
    run_logs([str(sample_logs_dir / f"{log}.mcap")], tmp_path, RunConfig(keep="estimates", **settings), report=False)
    text = (tmp_path / "logs" / log / "report.json").read_bytes()
    document = json.loads(text)
    follows(document)
    assert len(text) <= 40_000
    assert len({*paths(document)}) <= 120


def told(result: RunResult) -> list[str]:
    """Return the assumptions and failed checks that the terminal names, one by one."""
    lines = [line.strip() for line in rendered(render_run, result, 5000).splitlines()]
    assumed = [line.partition("Assumed")[2].strip() for line in lines if line.startswith("Assumed")]
    assert assumed
    return [
        *(clause for text in assumed if "see below" not in text for clause in text.split("; ")),
        *(line for line in lines if line.startswith(("FAILED: ", "waived: "))),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("logs", [("sweep",), ()])
def test_first_screen_and_first_sheet_name_what_the_terminal_names(logs, sample_logs_dir, tmp_path):
    fails = logs == ("sweep",)
    if logs:
        config = RunConfig(mapping=wrong_sign(sample_logs_dir / "sweep.mcap", tmp_path) if fails else None)
        result = run_logs([str(sample_logs_dir / f"{n}.mcap") for n in logs], tmp_path / "out", config, report=False)
    else:  # a recorded estimate
        log = str(sample_logs_dir / "dlc.mcap")
        result = score_log(log, RunConfig(), estimates=("/rtk/odometry",), output=tmp_path / "out")
    said, run = told(result), open_run(tmp_path / "out")
    assert len(said) >= 2 and any(text.startswith("FAILED") for text in said) == fails
    sheet = text_of(pdf_page(run).partition(b'<section class="sheet">')[0])
    assert [text for text in said if text not in sheet] == []
    screens = [text_of(drive_page(log).html.partition(b'<dl class="facts"')[0]) for log in run.logs]
    assert [text for text in said if all(text not in screen for screen in screens)] == []


_SAMPLE = Path(__file__).parents[2] / "sample_logs/dlc.mcap"


@pytest.fixture(scope="module")
def estimates():
    with pdhef.read_drive(_SAMPLE, pdhef.Car.load("saloon")) as drive:
        return pdhef.estimate(drive, ["zero", "kinematic"])


def test_the_errors_have_the_rmse_of_the_figures(estimates):
    errors = estimates.frame(errors=True)
    assert errors.columns[:-5] == estimates.frame().columns
    figures = pdhef.score(estimates).filter(segment="all", metric="rmse")
    rmse = figures.filter(pl.format("error_{}", "signal").is_in(errors.columns))
    assert len(rmse) == 10
    for estimator, signal, value in rmse.select("estimator", "signal", "value").iter_rows():
        of_one = errors.filter(pl.col("estimator") == estimator).get_column(f"error_{signal}")
        assert (of_one**2).mean() ** 0.5 == pytest.approx(value, rel=1e-9)
    truth = errors.filter(pl.col("estimator") == "truth")
    assert truth.get_column("error_vy_m_s").null_count() == len(truth)


def test_records_print_as_one_line(estimates):
    records = (estimates, estimates.drive, estimates.drive.car, estimates.signals, *estimates.tracks.values())
    assert all(len(repr(record)) < 300 and "\n" not in repr(record) for record in records)
    assert "zero, kinematic" in repr(estimates)


def test_the_package_lists_its_public_names():
    assert dir(pdhef) == sorted(pdhef.__all__)


def test_the_plot_has_a_line_of_each_track_in_degrees(estimates):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    lines = estimates.plot().get_lines()
    assert [line.get_label() for line in lines] == ["truth", "zero", "kinematic"]
    assert lines[0].get_xdata()[0] == pytest.approx(0.0, abs=0.1) and max(abs(lines[0].get_ydata())) > 1.0


def test_a_car_that_no_drive_has_validated_is_calibrated_as_by_a_run(bare_vehicle, tmp_path):
    car = tmp_path / "car.toml"
    car.write_text(bare_vehicle)
    with pdhef.read_drive(_SAMPLE, car) as drive:
        figures = pdhef.score(pdhef.estimate(drive, ["physics"]))
    pdhef.run(_SAMPLE, tmp_path / "out", pdhef.RunConfig(car=car, estimators=("physics",), keep="metrics"))
    of_run = pl.read_parquet(tmp_path / "out/metrics.parquet").select(figures.columns).cast(dict(figures.schema))
    assert figures.equals(of_run)
