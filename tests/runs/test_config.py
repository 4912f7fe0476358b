import datetime as dt
import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from pdhef_logtool.drive.options import ReadOptions, parse_time, time_slice
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.logs.open_log import log_metadata
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.runs.cars import RunCars
from pdhef_logtool.runs.config import RunConfig, load_config
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows

START = 1_700_000_000_000_000_000
END = START + 300_000_000_000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("12.5", START + 12_500_000_000),
        ("+10s", START + 10_000_000_000),
        ("0", START),
        ("end", END),
        ("end-5s", END - 5_000_000_000),
        ("end - 0.25", END - 250_000_000),
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("2023-11-14T22:13:20Z", START),
        ("2023-11-14T22:13:20.5+00:00", START + 500_000_000),
        ("2023-11-14T23:13:20+01:00", START),
        ("2023-11-14T22:13:20", START),
    ],
)
def test_times_as_users_write_them(text, expected):
    assert parse_time(text, START, END, option="--start") == expected


@pytest.mark.parametrize("text", ["", "abc", "-5", "10m", "end+5", "2023-13-01T00:00:00Z", "nan", "1e3"])
def test_other_times_are_refused_with_the_option(text):
    with pytest.raises(UsageError, match=r"--end.*2026-01-31T12:00:00Z"):
        parse_time(text, START, END, option="--end")


@settings(derandomize=True)
@given(st.datetimes(dt.datetime(1971, 1, 1), dt.datetime(2200, 1, 1)))
def test_rfc_3339_is_exact_to_the_microsecond(when):
    microseconds = (when - dt.datetime(1970, 1, 1)) // dt.timedelta(microseconds=1)
    assert parse_time(when.isoformat() + "Z", 0, 0, option="--start") == microseconds * 1000


def test_slice_is_cut_to_the_log():
    assert time_slice(ReadOptions(start="10", end="end-10s"), START, END) == (START + 10**10, END - 10**10)
    assert time_slice(ReadOptions(), START, END) == (START, END)
    assert time_slice(ReadOptions(end="1e9".replace("e9", "000")), START, END) == (START, END)


@pytest.mark.parametrize(("start", "end"), [("400", None), ("20", "10"), ("10", "10"), (None, "1000000000000000")])
def test_empty_slice_is_a_usage_error(start, end):
    with pytest.raises(UsageError, match="300"):
        time_slice(ReadOptions(start=start, end=end), START, END)


def test_flags_win_over_file_and_paths_are_relative_to_it(tmp_path):
    file = tmp_path / "pdhef.toml"
    file.write_text('estimators = ["zero", "zero:no-lateral"]\ncar = "car.toml"\nannotate = "sidecar"\nstart = 10\n')
    config = load_config(file, {"annotate": "none", "mapping": None})
    assert config.estimators == ("zero", "zero:no-lateral")
    assert config.car == tmp_path / "car.toml"
    assert config.annotate == "none"
    assert config.start == "10"
    assert config.mapping is None


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('estimators = ["zero", "ukf"]', "ukf"),
        ('estimators = ["zero", "zero"]', "zero"),
        ("estimators = []", "none"),
        ('end = "later"', "later"),
        ("estimators = 3", r"estimators: should be a list, got 3"),
        ("max_memory_mb = true", r"max_memory_mb: should be a valid integer, got True"),
        ("end = [1]", "end: should be a valid string"),
        (f'end = "{"9" * 400}"', "end: String should have at most 64 characters"),
        ("annotate = 3", "annotate: should be 'full', 'sidecar' or 'none', got 3"),
        ("friction = 0.0", "friction: "),
        ("friction = true", "friction: "),
        ('estimators = 3\ngnss = true\nanotate = "full"', r"c\.toml.*estimators: .*; gnss: .*; anotate: unknown"),
    ],
)
def test_wrong_files_name_what_is_wrong(tmp_path, text, named):
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=named):
        load_config(file, {})


def test_a_wrong_option_is_no_fault_of_the_file(tmp_path):
    (tmp_path / "c.toml").write_text('annotate = "none"\n')
    with pytest.raises(UsageError, match=r"^options: .*annotate: should be .*, got 'all'"):
        load_config(tmp_path / "c.toml", {"annotate": "all"})


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("end = 10", "end", "10"),
        ("end = 2.5", "end", "2.5"),
        ('end = "end-5s"', "end", "end-5s"),
        ("end = 2026-01-31T12:00:00Z", "end", "2026-01-31 12:00:00+00:00"),
        ('estimators = "zero, pd-hef:gain=0.5"', "estimators", ("zero", "pd-hef:gain=0.5")),
        ('network = "none"', "network", Path("none")),
        ('car = "saloon"', "car", Path("saloon")),
        ('waived = ["ay_m_s2.unit"]', "waived", ("ay_m_s2.unit",)),
        ("friction = 0.4", "friction", 0.4),
        ('friction = "file"', "friction", "file"),
    ],
)
def test_entries_as_users_write_them(tmp_path, monkeypatch, text, key, value):
    monkeypatch.chdir(tmp_path)
    Path("pdhef.toml").write_text(text)
    for file in (None, Path("pdhef.toml")):  # the file of the working directory is found
        assert getattr(load_config(file, {}), key) == value


def test_a_configuration_is_checked_wherever_it_is_made():
    config = RunConfig(friction=1)
    assert (config.friction, pickle.loads(pickle.dumps(config))) == (1.0, config)
    with pytest.raises(ValidationError, match="friction"):
        replace(config, friction=True)


def test_configuration_in_outputs_holds_no_folders(tmp_path):
    document = RunConfig(car=tmp_path / "car.toml").to_dict()
    assert document["car"] == "car.toml"
    assert str(tmp_path) not in str(document)


@pytest.fixture
def fleet(sample_logs_dir, tmp_path):
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
def test_an_entry_names_the_car(fleet, table):
    assert cars_of(fleet, table) == EACH


def test_the_metadata_of_a_log_names_its_car(fleet, sample_logs_dir):
    shutil.copy(sample_logs_dir / "dlc.mcap", fleet / "fleet/mini/day/mini_1.mcap")
    golf, mini = (log_metadata(fleet / f"fleet/{n}/day/{n}_1.mcap") for n in ("golf", "mini"))
    assert golf["truthsim.manoeuvre"] == golf["manoeuvre"] != mini["manoeuvre"]
    named = f'"{golf["manoeuvre"]}" = "golf.toml"\n"{mini["manoeuvre"]}" = "mini.toml"'
    text = f'[metadata."truthsim.manoeuvre"]\n{named}\n'
    assert cars_of(fleet, text) == EACH


def test_folder_and_metadata_that_contradict_each_other_are_refused(fleet):
    manoeuvre = log_metadata(fleet / "fleet/golf/day/golf_1.mcap")["manoeuvre"]
    text = f'[folders]\n"fleet" = "mini.toml"\n[metadata.manoeuvre]\n"{manoeuvre}" = "golf.toml"\n'
    with pytest.raises(UsageError, match=r"mini\.toml by folder fleet; golf\.toml by manoeuvre"):
        cars_of(fleet, text)


def test_a_log_without_a_car_is_an_error_never_the_default_sedan(fleet):
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
def test_a_wrong_table_is_told_before_any_log_is_opened(fleet, table, said):
    with pytest.raises(UsageError, match=said):
        cars_of(fleet, table)


def test_one_car_and_a_table_exclude_each_other_and_a_flag_wins_over_the_file(fleet):
    with pytest.raises(UsageError, match="car or cars"):
        cars_of(fleet, 'default = "golf.toml"\n', car=fleet / "golf.toml")
    (fleet / "pdhef.toml").write_text('car = "golf.toml"\n')
    config = load_config(fleet / "pdhef.toml", {"cars": fleet / "cars.toml"})
    assert (config.car, config.cars) == (None, fleet / "cars.toml")


@pytest.mark.slow
def test_a_run_says_which_car_each_log_had_and_one_without_stops_no_other(fleet):
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
