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
def test_entries_as_users_write_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, key: str, value: object
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pdhef.toml").write_text(text)
    for file in (None, Path("pdhef.toml")):  # the file of the working directory is found
        assert getattr(load_config(file, {}), key) == value


def test_a_configuration_is_checked_wherever_it_is_made() -> None:
    config = RunConfig(friction=1)
    assert (config.friction, pickle.loads(pickle.dumps(config))) == (1.0, config)
    with pytest.raises(ValidationError, match="friction"):
        replace(config, friction=True)  # type: ignore[arg-type]


def test_configuration_in_outputs_holds_no_folders(tmp_path: Path) -> None:
    document = RunConfig(car=tmp_path / "car.toml").to_dict()
    assert document["car"] == "car.toml"
    assert str(tmp_path) not in str(document)
