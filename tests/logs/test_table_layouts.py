"""Layouts of texts and documents: blocks, sentences, lines of programs, lists of objects, hemispheres, units."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_columns import split_unit

ROWS = range(20)
NMEA = "".join(
    f"$GPRMC,1200{i:02d}.00,A,3330.{i:04d},S,15112.{i:04d},E,10.0,{i},010126,,,A*6A\r\n" for i in ROWS
)  # fmt: skip
LOG = "".join(f"2026-01-01 12:00:{i:02d}.500 INFO [imu] ax={i}.25 gz=-0.5\n" for i in ROWS)
BLOCKS = "Version\t2\n\n{Block}\nTime\tvCar[kph]\n" + "".join(f"{i}\t{i}\n" for i in ROWS)
BLOCKS += "\n{Block}\nTime\taSteer[deg]\n" + "".join(f"{i}\t{2 * i}\n" for i in ROWS)
RATED = "# Sampling frequency: 50 Hz\nSample,Speed\n" + "".join(f"{i},{i * i}\n" for i in ROWS)
SENSORS = json.dumps([{"sensor": s, "time": 1.5e9 + i, "x": f"{i}"} for i in ROWS for s in ("acc", "gyro")])
REPORT = '"Device","Date","Diagnostic","Value","Unit of measure"\n' + "".join(
    f'"Car 3","01/01/2026 12:00:{i:02d}","Vehicle speed","{i}","km/h"\n' for i in ROWS
)
KEYS = "".join(
    json.dumps({"data": [{"key": "VehicleSpeed", "value": {"doubleValue": i}}], "time": 1.5e9 + i}) + "\n" for i in ROWS
)
CHANNELS = json.dumps({"channels": [{"name": "Speed", "unit": "km/h", "samplerate": 10, "data": [*ROWS]}]})


@pytest.mark.parametrize(
    ("name", "text", "topic", "field", "values"),
    [
        ("a.nmea", NMEA, "GPRMC", "latitude", -33.5 - np.arange(20) / 6e5),
        ("a.log", LOG, "csv", "imu_ax", np.arange(20) + 0.25),
        ("a.txt", BLOCKS, "csv", "vCar", np.arange(20)),
        ("a.txt", BLOCKS, "csv_2", "aSteer", 2 * np.arange(20)),
        ("a.csv", RATED, "csv", "Speed", np.arange(20) ** 2),
        ("a.json", SENSORS, "gyro", "x", np.arange(20)),
        ("a.json", CHANNELS, "channels", "Speed", np.arange(20)),
        ("a.csv", REPORT, "csv", "Vehicle_speed", np.arange(20)),
        ("a.jsonl", KEYS, "json", "data_VehicleSpeed", np.arange(20)),
    ],
)
def test_layouts(name: str, text: str, topic: str, field: str, values: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with closing(open_log(tmp_path / name)) as log:
        columns = log.read({topic: [field]})[topic]
        np.testing.assert_allclose(columns.fields[field], values, atol=1e-9)


@pytest.mark.parametrize(
    ("title", "name", "unit"),
    [
        ("v / (km/h)", "v", "km/h"),
        ("Gierrate in °/s", "Gierrate", "°/s"),
        ("Скорость, км/ч", "Скорость", "км/ч"),
        ("Speed (km/h)", "Speed", "km/h"),
        ("Brake in use", "Brake in use", ""),
        ("a, b", "a, b", ""),
    ],
)
def test_units_in_titles(title: str, name: str, unit: str) -> None:
    assert split_unit(title) == (name, unit)
