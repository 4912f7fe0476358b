"""Source of the friction of a run."""

from __future__ import annotations

import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.friction import friction_source, parse_friction
from pdhef_logtool.records.errors import UsageError

VEHICLE = default_vehicle().model_copy(update={"name": "golf"})
NO_FRICTION = VEHICLE.model_copy(update={"friction": None})
ALL = frozenset({"steer_rad", "ay_m_s2", "friction"})


@pytest.mark.parametrize(
    ("choice", "vehicle", "available", "label"),
    [
        ("auto", VEHICLE, ALL, "topic /road.mu"),
        ("auto", VEHICLE, ALL - {"friction"}, "vehicle file, 0.85"),
        ("auto", default_vehicle(), ALL - {"friction"}, "default sedan, 0.85"),
        ("auto", NO_FRICTION, ALL - {"friction"}, "no value given, 1"),
        ("file", VEHICLE, ALL, "vehicle file, 0.85"),
        (0.4, VEHICLE, ALL, "option, 0.4"),
    ],
)
def test_the_source_is_named(choice, vehicle, available, label):
    source = friction_source(choice, vehicle, available, "/road.mu")
    assert source.label == label
    assert bool(source.note) == label.startswith("assumed")
    assert source.is_given is not label.startswith(("assumed", "default sedan"))


def test_a_file_without_friction_is_refused():
    with pytest.raises(UsageError, match="friction"):
        friction_source("file", NO_FRICTION, ALL)


@pytest.mark.parametrize("text", ["wet", "", "nan", "-0.3", "0", "6", "inf", "estimate"])
def test_other_texts_are_refused(text):
    with pytest.raises(UsageError, match="--friction"):
        parse_friction(text)
