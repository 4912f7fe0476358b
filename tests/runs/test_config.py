from __future__ import annotations

import datetime as dt
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pdhef_logtool.drive.options import ReadOptions, parse_time, time_slice
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.config import RunConfig, load_config

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
def test_times_as_users_write_them(text: str, expected: int) -> None:
    assert parse_time(text, START, END, option="--start") == expected


@pytest.mark.parametrize("text", ["", "abc", "-5", "10m", "end+5", "2023-13-01T00:00:00Z", "nan", "1e3"])
def test_other_times_are_refused_with_the_option(text: str) -> None:
    with pytest.raises(UsageError, match=r"--end.*2026-01-31T12:00:00Z"):
        parse_time(text, START, END, option="--end")


@settings(derandomize=True)
@given(st.datetimes(dt.datetime(1971, 1, 1), dt.datetime(2200, 1, 1)))
def test_rfc_3339_is_exact_to_the_microsecond(when: dt.datetime) -> None:
    microseconds = (when - dt.datetime(1970, 1, 1)) // dt.timedelta(microseconds=1)
    assert parse_time(when.isoformat() + "Z", 0, 0, option="--start") == microseconds * 1000


def test_slice_is_cut_to_the_log() -> None:
    assert time_slice(ReadOptions(start="10", end="end-10s"), START, END) == (START + 10**10, END - 10**10)
    assert time_slice(ReadOptions(), START, END) == (START, END)
    assert time_slice(ReadOptions(end="1e9".replace("e9", "000")), START, END) == (START, END)


@pytest.mark.parametrize(("start", "end"), [("400", None), ("20", "10"), ("10", "10"), (None, "1000000000000000")])
def test_empty_slice_is_a_usage_error(start: str | None, end: str | None) -> None:
    with pytest.raises(UsageError, match="300"):
        time_slice(ReadOptions(start=start, end=end), START, END)


def test_flags_win_over_file_and_paths_are_relative_to_it(tmp_path: Path) -> None:
    file = tmp_path / "pdhef.toml"
    file.write_text('estimators = ["zero", "zero:no-lateral"]\ncar = "car.toml"\nannotate = "sidecar"\nstart = 10\n')
    config = load_config(file, {"annotate": "none", "mapping": None})
    assert config.estimators == ("zero", "zero:no-lateral")
    assert config.car == tmp_path / "car.toml"
    assert config.annotate == "none"
    assert config.start == "10"
    assert config.mapping is None


def test_file_of_the_working_directory_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pdhef.toml").write_text('sensors = "esp"\n')
    monkeypatch.chdir(tmp_path)
    assert load_config(None, {}).sensors == "esp"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('estimater = ["zero"]', "estimater"),
        ('estimators = ["zero", "ukf"]', "ukf"),
        ('estimators = ["zero", "zero"]', "zero"),
        ("estimators = []", "none"),
        ('annotate = "all"', "all"),
        ("start = soon", "TOML"),
        ('end = "later"', "later"),
        ("estimators = 3", r"estimators: should be a list, got 3"),
        ("estimators = [3]", r"estimators\.0: should be a valid string, got 3"),
        ("max_memory_mb = true", r"max_memory_mb: should be a valid integer, got True"),
        ("start = true", r"start: should be a valid string, got True"),
        ("end = [1]", "end: should be a valid string"),
        (f'end = "{"9" * 400}"', "end: String should have at most 64 characters"),
        ("car = 3", r"car: should be a path, got 3"),
        ("annotate = 3", "annotate: should be 'full', 'sidecar' or 'none', got 3"),
        ('friction = "0.4"', "friction: "),
        ("friction = 0.0", "friction: "),
        ("friction = true", "friction: "),
        ('network = ["none"]', "network: should be a path"),
        ("frictions = 3", r"frictions: unknown, did you mean friction\?"),
        ('netwrok = "car"', r"netwrok: unknown, did you mean network\?"),
    ],
)
def test_wrong_files_name_what_is_wrong(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(UsageError, match=named) as caught:
        load_config(file, {})
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)


def test_all_problems_of_a_file_come_at_once(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text('estimators = 3\ngnss = true\nanotate = "full"\n')
    with pytest.raises(UsageError, match=r"c\.toml.*estimators: .*; gnss: .*; anotate: unknown"):
        load_config(file, {})


def test_a_wrong_option_is_no_fault_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('annotate = "none"\n')
    with pytest.raises(UsageError, match=r"^options: .*annotate: should be .*, got 'all'"):
        load_config(tmp_path / "c.toml", {"annotate": "all"})


@pytest.mark.parametrize(
    ("text", "said"),
    [("10", "10"), ("2.5", "2.5"), ('"end-5s"', "end-5s"), ("2026-01-31T12:00:00Z", "2026-01-31 12:00:00+00:00")],
)
def test_a_time_is_a_number_a_text_or_a_date(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "c.toml").write_text(f"end = {text}\n")
    assert load_config(tmp_path / "c.toml", {}).end == said


def test_estimators_may_be_a_text_with_commas(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('estimators = "zero, pd-hef:gain=0.5,fixed-r"\n')
    assert load_config(tmp_path / "c.toml", {}).estimators == ("zero", "pd-hef:gain=0.5,fixed-r")


def test_a_configuration_is_checked_wherever_it_is_made() -> None:
    config = RunConfig(friction=1)
    assert (config.friction, pickle.loads(pickle.dumps(config))) == (1.0, config)
    with pytest.raises(ValidationError, match="friction"):
        replace(config, friction=True)  # type: ignore[arg-type]


def test_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.toml"):
        load_config(tmp_path / "none.toml", {})


def test_configuration_in_outputs_holds_no_folders(tmp_path: Path) -> None:
    document = RunConfig(car=tmp_path / "car.toml").to_dict()
    assert document["car"] == "car.toml"
    assert str(tmp_path) not in str(document)


def test_words_that_stand_for_files_stay_words(tmp_path: Path) -> None:
    file = tmp_path / "pdhef.toml"
    file.write_text('network = "none"\nintervals = "unsure"\ncar = "none"\n')
    config = load_config(file, {})
    assert (config.network, config.intervals) == (Path("none"), Path("unsure"))
    assert config.car == tmp_path / "none"


def test_a_car_and_a_network_may_be_named_by_word(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('car = "saloon"\nnetwork = "none"\n')
    config = load_config(tmp_path / "c.toml", {})
    assert (config.car, config.network) == (Path("saloon"), Path("none"))
