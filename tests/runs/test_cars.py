"""A car a log: by name, by folder, by metadata, and never one by chance."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.open_log import log_metadata
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.cars import RunCars
from pdhef_logtool.runs.config import RunConfig, load_config
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows


@pytest.fixture
def fleet(sample_logs_dir: Path, tmp_path: Path) -> Path:
    """Return a folder with two cars, and a log of each in a separate folder."""
    for name in ("golf", "mini"):
        folder = tmp_path / "fleet" / name / "day"
        folder.mkdir(parents=True)
        shutil.copy(sample_logs_dir / "step.mcap", folder / f"{name}_1.mcap")
        text = (sample_logs_dir / "vehicle.toml").read_text()
        (tmp_path / f"{name}.toml").write_text(text.replace("truthsim saloon", name))
    return tmp_path


def cars_of(fleet: Path, table: str, **changes: Any) -> dict[str, str]:
    """Return the name of the vehicle of each log."""
    (fleet / "cars.toml").write_text(table)
    cars = RunCars.of(RunConfig(cars=fleet / "cars.toml", **changes), pytest.fail)
    return {log.path.stem: cars.of_log(log).vehicle.name for log in find_logs([str(fleet / "fleet")])}


EACH = {"golf_1": "golf", "mini_1": "mini"}


@pytest.mark.parametrize(
    "table",
    [
        '[folders]\n"fleet" = "mini.toml"\n"fleet/golf" = "golf.toml"\n',
        'default = "mini.toml"\n[logs]\n"golf_*.mcap" = "golf.toml"\n[folders]\n"fleet/golf" = "mini.toml"\n',
    ],
    ids=["the deepest folder", "a pattern before folders, and the default"],
)
def test_an_entry_names_the_car(fleet: Path, table: str) -> None:
    assert cars_of(fleet, table) == EACH


def test_the_metadata_of_a_log_names_its_car(fleet: Path, sample_logs_dir: Path) -> None:
    shutil.copy(sample_logs_dir / "dlc.mcap", fleet / "fleet/mini/day/mini_1.mcap")
    golf, mini = (log_metadata(fleet / f"fleet/{n}/day/{n}_1.mcap") for n in ("golf", "mini"))
    assert golf["truthsim.manoeuvre"] == golf["manoeuvre"] != mini["manoeuvre"]
    text = (
        f'[metadata."truthsim.manoeuvre"]\n"{golf["manoeuvre"]}" = "golf.toml"\n"{mini["manoeuvre"]}" = "mini.toml"\n'
    )
    assert cars_of(fleet, text) == EACH


def test_folder_and_metadata_that_contradict_each_other_are_refused(fleet: Path) -> None:
    manoeuvre = log_metadata(fleet / "fleet/golf/day/golf_1.mcap")["manoeuvre"]
    text = f'[folders]\n"fleet" = "mini.toml"\n[metadata.manoeuvre]\n"{manoeuvre}" = "golf.toml"\n'
    with pytest.raises(UsageError, match=r"mini\.toml by folder fleet; golf\.toml by manoeuvre"):
        cars_of(fleet, text)


def test_a_log_without_a_car_is_an_error_never_the_default_sedan(fleet: Path) -> None:
    with pytest.raises(UsageError, match="a car for every log"):
        cars_of(fleet, '[folders]\n"fleet/golf" = "golf.toml"\n')


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('[folder]\n"fleet" = "golf.toml"\n', "did you mean folders"),
        ('default = "polo.toml"\n', "polo.toml"),
        ("default = 1\n", "default"),
    ],
)
def test_a_wrong_table_is_told_before_any_log_is_opened(fleet: Path, table: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        cars_of(fleet, table)


def test_one_car_and_a_table_exclude_each_other_and_a_flag_wins_over_the_file(fleet: Path) -> None:
    with pytest.raises(UsageError, match="car or cars"):
        cars_of(fleet, 'default = "golf.toml"\n', car=fleet / "golf.toml")
    (fleet / "pdhef.toml").write_text('car = "golf.toml"\n')
    config = load_config(fleet / "pdhef.toml", {"cars": fleet / "cars.toml"})
    assert (config.car, config.cars) == (None, fleet / "cars.toml")


@pytest.mark.slow
def test_a_run_says_which_car_each_log_had_and_one_without_stops_no_other(fleet: Path) -> None:
    (fleet / "cars.toml").write_text('[folders]\n"fleet/golf" = "golf.toml"\n"fleet/mini" = "mini.toml"\n')
    shutil.copy(fleet / "fleet/golf/day/golf_1.mcap", fleet / "fleet/lost.mcap")
    config = RunConfig(cars=fleet / "cars.toml", keep="estimates", estimators=("zero",))
    said: list[str] = []
    result = run_logs([str(fleet / "fleet")], fleet / "out", config, report=False, reporter=Reporter(warn=said.append))
    assert result.exit_code == 3
    run = json.loads((fleet / "out/run.json").read_text())
    follows(run, "run.schema.json")
    cars = {log["log"]: log["car"] for log in run["logs"]}
    assert {name: car and car["file"] for name, car in cars.items()} == {
        "golf__day__golf_1": "golf.toml", "mini__day__mini_1": "mini.toml", "lost": None,
    }  # fmt: skip
    assert "lost.mcap failed, the others go on" in said
    assert any("a car for every log" in log["outcome"] for log in run["logs"] if log["log"] == "lost")
    report = json.loads((fleet / "out/logs/mini__day__mini_1/report.json").read_text())
    assert report["vehicle"]["file"] == "mini.toml"
