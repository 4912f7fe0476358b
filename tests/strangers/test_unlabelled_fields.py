"""Columns without names: what physics alone tells, and what it must not tell."""

from __future__ import annotations

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.mapping import auto_map
from pdhef_logtool.records.signals import FloatArray
from studies.strangers.cars import drive

DEG = np.pi / 180.0
#: Order of the columns; what is none of the signals stands between them.
ORDER = ("pitch rate", "k", "lateral", "steering wheel", "speed", "noise", "yaw rate", "up", "along")


def columns(rate: float = 1.0, angle: float = 1.0, speed: float = 1.0) -> dict[str, FloatArray]:
    car = drive("other")
    clock = car.force
    noise = np.random.default_rng(1).normal(size=len(clock.stamps_ns))
    return {
        "pitch rate": car.rate.values[:, 1] / rate,
        "k": np.arange(len(noise)) % 256.0,
        "lateral": car.force.values[:, 1],
        "steering wheel": car.steering_wheel.along(clock).values / angle,
        "speed": car.speed.along(clock).values / speed,
        "noise": noise,
        "yaw rate": car.rate.values[:, 2] / rate,
        "up": car.force.values[:, 2],
        "along": car.force.values[:, 0],
    }


def numbered(values: dict[str, FloatArray]) -> FakeLog:
    stamps = drive("other").force.stamps_ns
    fields = {f"data[{i}]": values[name] for i, name in enumerate(ORDER) if name in values}
    return FakeLog({"/array": FakeTopic("std_msgs/msg/Float32MultiArray", stamps, fields)})


def taken(log: FakeLog) -> dict[str, tuple[str, float]]:
    signals = auto_map(log).mapping.signals
    return {n: (ORDER[int(str(s.field)[5:-1])], round(float(s.scale), 5)) for n, s in signals.items()}  # type: ignore[arg-type]


@pytest.mark.parametrize(("rate", "angle"), [(1.0, 1.0), (DEG, DEG)])
def test_columns_are_told_by_how_they_move_together(rate: float, angle: float) -> None:
    log = numbered(columns(rate, angle))
    assert taken(log) == {
        "speed_m_s": ("speed", 1.0),
        "yaw_rate_rad_s": ("yaw rate", round(rate, 5)),
        "ay_m_s2": ("lateral", 1.0),
        "ax_m_s2": ("along", 1.0),
        "steering_wheel_rad": ("steering wheel", round(angle, 5)),
    }
    auto = auto_map(log)
    assert "mapping.names" in {c.name for c in auto.mapping.checks if c.verdict == "undecided"}
    assert any("left and right may be exchanged" in note for note in auto.mapping.notes)


def test_a_steering_angle_is_no_yaw_rate_and_a_yaw_rate_no_acceleration() -> None:
    values = columns(DEG, DEG)
    del values["lateral"]
    log = numbered(values)
    assert taken(log) == {}
    assert auto_map(log).candidates == ()


def test_a_speed_in_another_unit_may_be_a_wheel() -> None:
    found = taken(numbered(columns(speed=1 / 3.6)))
    assert "speed_m_s" not in found
    assert found["yaw_rate_rad_s"] == ("yaw rate", 1.0)


def test_what_does_not_turn_is_not_guessed() -> None:
    values = columns()
    for name in ("yaw rate", "lateral", "steering wheel"):
        values[name] = 0.001 * values["noise"]
    assert taken(numbered(values)) == {}
