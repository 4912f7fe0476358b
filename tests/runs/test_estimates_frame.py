"""Estimates as a person sees them in a notebook: names, short texts, errors that agree with the figures."""

from pathlib import Path

import polars as pl
import pytest

import pdhef_logtool as pdhef

_SAMPLE = Path(__file__).parents[2] / "sample_logs/dlc.mcap"


@pytest.fixture(scope="module")
def estimates():
    with pdhef.read_drive(_SAMPLE, pdhef.Car.load("saloon")) as drive:
        return pdhef.estimate(drive, ["zero", "kinematic"])


def test_the_errors_have_the_rmse_of_the_figures(estimates) -> None:
    errors = estimates.frame(errors=True)
    assert errors.columns[:-5] == estimates.frame().columns
    figures = pdhef.score(estimates).filter(segment="all", metric="rmse")
    rmse = figures.filter(pl.format("error_{}", "signal").is_in(errors.columns))
    assert len(rmse) == 10
    for estimator, signal, value in rmse.select("estimator", "signal", "value").iter_rows():
        of_one = errors.filter(pl.col("estimator") == estimator).get_column(f"error_{signal}")
        assert (of_one**2).mean() ** 0.5 == pytest.approx(value, rel=1e-9)
    assert errors.filter(pl.col("estimator") == "truth").get_column("error_vy_m_s").null_count() == len(
        errors.filter(pl.col("estimator") == "truth")
    )


def test_records_print_as_one_line(estimates) -> None:
    records = (estimates, estimates.drive, estimates.drive.car, estimates.signals, *estimates.tracks.values())
    assert all(len(repr(record)) < 300 and "\n" not in repr(record) for record in records)
    assert "zero, kinematic" in repr(estimates)


def test_the_package_lists_its_public_names() -> None:
    assert dir(pdhef) == sorted(pdhef.__all__)


def test_the_plot_has_a_line_of_each_track_in_degrees(estimates) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    lines = estimates.plot().get_lines()
    assert [line.get_label() for line in lines] == ["truth", "zero", "kinematic"]
    assert lines[0].get_xdata()[0] == pytest.approx(0.0, abs=0.1) and max(abs(lines[0].get_ydata())) > 1.0


def test_a_car_that_no_drive_has_validated_is_calibrated_as_by_a_run(bare_vehicle: str, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text(bare_vehicle)
    with pdhef.read_drive(_SAMPLE, car) as drive:
        figures = pdhef.score(pdhef.estimate(drive, ["physics"]))
    pdhef.run(_SAMPLE, tmp_path / "out", pdhef.RunConfig(car=car, estimators=("physics",), keep="metrics"))
    of_run = pl.read_parquet(tmp_path / "out/metrics.parquet").select(figures.columns).cast(dict(figures.schema))
    assert figures.equals(of_run)
