"""report.json: at most 120 paths, and 40 kB of a drive of 10 s; terminal, page and PDF say the same of it first."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import pdhef_logtool as pdhef
from pdhef_logtool import RunConfig, open_run
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.reports.drive import drive_page
from pdhef_logtool.reports.pdf import pdf_page
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.recorded_estimates import score_log
from pdhef_logtool.runs.run_result import RunResult
from tests.command_line import rendered
from tests.run_report import follows, text_of
from tests.runs.wrong_mapping import wrong_sign

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
