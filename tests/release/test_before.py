"""What the version before wrote still opens: runs, datasets, cars and networks (``make_before.py`` wrote them)."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.learning.network.dataset import read_dataset
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.opened_run import open_run
from tests.command_line import pdhef, said

HERE = Path(__file__).parent
DLC = HERE.parents[1] / "sample_logs/dlc.mcap"
SLICE = ("--start", "2", "--end", "4.5")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("before")
    shutil.unpack_archive(HERE / "before.zip", folder)
    return folder


@pytest.fixture
def before(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "before"))


def test_a_run_opens_and_has_its_page_its_events_and_its_comparison(
    before: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (log,) = open_run(before / "run").logs
    assert (log.label, log.report()["log"]["file"]) == ("dlc", "dlc.mcap")
    pdhef("report", before / "run")
    assert "dlc" in (before / "run/logs/dlc/report.html").read_text()
    assert said(capsys, "events", before / "run", "--where", "abs(ay_m_s2) > 1")["events"]
    compared = said(capsys, "compare", before / "run", before / "again")
    assert compared["pairs"] == {"signals": 1}
    assert len(compared["figures"]) == 1


def test_a_car_opens_with_all_of_its_parts(before: Path) -> None:
    car = Car.load(before / "car", network=before / "bundle")
    assert car.notes == ()
    assert car.fitted_physics is not None
    assert car.noise and car.intervals is not None and car.network is not None


@pytest.mark.slow
def test_a_car_and_a_network_run(before: Path, tmp_path: Path) -> None:
    car = ("--car", before / "car", "--network", before / "bundle")
    pdhef("run", DLC, "-o", tmp_path / "out", *car, "-e", "pd-hef,zero", "--annotate", "none", "--no-report", *SLICE)


@pytest.mark.slow
def test_a_run_is_gone_on_with(before: Path) -> None:
    car = ("--car", before / "car", "--network", before / "bundle")
    pdhef(
        "run", DLC, "-o", before / "run", *car, "-e", "pd-hef,physics,zero", "--annotate", "none", "--resume",
        "--no-report", *SLICE,
    )  # fmt: skip
    (log,) = open_run(before / "run").logs
    assert log.label == "dlc"


def test_a_dataset_opens(before: Path) -> None:
    dataset = read_dataset(before / "dataset")
    assert sorted((d.name, d.split) for d in dataset.drives) == [("dlc.2-3.2", "train"), ("step.2-3.2", "validation")]


@pytest.mark.slow
def test_a_dataset_is_trained_on_from_a_network_and_what_cannot_go_into_it_is_told(
    before: Path, tmp_path: Path
) -> None:
    logs = ("--car", before / "car", "--split", "train", "--start", "2", "--end", "3.2")
    with pytest.raises(UsageError, match="choose another"):  # it has no cells of driving
        pdhef("extract", DLC, *logs, "-o", before / "dataset", "--resume")
    pdhef("train", before / "dataset", "-o", tmp_path / "network", "--init", before / "bundle", "--epochs", 1)
    assert (tmp_path / "network/model.json").is_file()
