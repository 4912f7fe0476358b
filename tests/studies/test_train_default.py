"""``train_default``: the steps that the command line does not have, on a few drives."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from studies.defaults import train_default

pytestmark = [pytest.mark.fleet, pytest.mark.slow]

LOGS = ("dlc", "sweep")


def test_the_noise_of_a_car_is_tuned_on_its_validation_drives(
    sample_logs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    car, work = tmp_path / "car", tmp_path / "work"
    shutil.copytree(train_default.HOME, car)
    (work / "one_car").mkdir(parents=True)
    for name in LOGS:
        shutil.copy(sample_logs_dir / f"{name}.mcap", work / "one_car")
    entries = [{"file": f"{name}.mcap", "split": "validation"} for name in LOGS]
    (work / "one_car" / "manifest.json").write_text(json.dumps({"drives": entries}))
    (work / "mapping.toml").write_text(train_default.MAPPING)
    before = Car.load(car)

    options = ["-o", str(car), "--work", str(work), "--trials", "4", "--steps", "noise"]
    assert train_default.main(options) == 0
    assert "of 4" in capsys.readouterr().out
    after = Car.load(car)
    assert after.notes == (), "every part belongs to the physics of the car"
    noise = after.noise["phy-ukf:tuned"]
    assert noise.trial is not None and noise.trial < 4 and noise != before.noise["phy-ukf:tuned"]
    assert after.noise["physics"] == before.noise["physics"]
