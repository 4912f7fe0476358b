"""The posterior of mistakes: constant factors are units, gains that change are the car's, and units are likelier."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.hypotheses import Law, Relation, known_hypotheses, posterior
from pdhef_logtool.drive.plan import plan_drive
from pdhef_logtool.drive.survey import scaled_source
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map
from pdhef_logtool.runs.inspection import inspect_drive_log

NAMES = ["ay_m_s2", "yaw_rate_rad_s", "speed_m_s"]
TURN = {"ay_m_s2": 1, "yaw_rate_rad_s": -1, "speed_m_s": -1}


def relation(*gains: float, powers: dict[str, int] = TURN, text: str = "a_y") -> Relation:
    size = math.exp(float(np.mean(np.log(np.abs(gains)))))
    return Relation(Law(text, powers, (0.55, 1.8)), 0.99, math.copysign(size, gains[0]), 200.0, blocks=gains)


def probabilities(*relations: Relation) -> dict[str, float]:
    found = posterior(relations, known_hypotheses((*NAMES,)))
    assert sum(p for p, _ in found.sets) == pytest.approx(1.0)
    return {n: sum(p for p, _ in found.of(n)) for n in NAMES}


@settings(max_examples=50, deadline=None, derandomize=True)
@given(gains=st.lists(st.floats(0.7, 1.5), min_size=3, max_size=8))
def test_plausible_gains_blame_nobody(gains):
    assert max(probabilities(relation(*gains)).values()) < 0.05


def test_a_unit_is_wrong_in_every_block_and_a_slide_in_some():
    sound = relation(1.0, 1.05, 0.95, 1.0, powers={"speed_m_s": 1}, text="another speed")
    degrees = np.pi / 180.0
    wrong = probabilities(sound, *(relation(*(g * degrees for g in (1.0, 1.1, 0.9, 1.0)), text=t) for t in "ab"))
    assert wrong["yaw_rate_rad_s"] > 0.85 and wrong["speed_m_s"] < 0.1
    assert max(probabilities(sound, relation(1.0, 0.6, 0.35, 0.2)).values()) < 0.05


def test_two_mistakes_are_found_that_are_worse_than_none_alone():
    """All that turns counts to the right, and only the path over ground shows it: IMU and steering are two mistakes."""
    steady, steer = (1.0, 1.1, 0.9, 1.0), {"steer_rad": 1}
    relations = [
        relation(*steady),
        relation(*steady, powers=steer | {"yaw_rate_rad_s": -1}, text="steering"),
        relation(*steady, powers=steer | {"ay_m_s2": -1}, text="steering and a_y"),
        relation(*(-g for g in steady), powers={"yaw_rate_rad_s": 1}, text="path"),
    ]
    imu = ("ay_m_s2", "yaw_rate_rad_s")
    found = posterior(relations, known_hypotheses((*NAMES, "steer_rad"), (imu,), (("steer_rad",),)))
    probability, chosen = found.sets[0]
    assert probability > 0.97 and {n for h in chosen for n in h.factors} == {*imu, "steer_rad"}


def test_scales_of_right_mappings_are_those_of_units():
    """A gain between km/h and mph fits both; only one of them corrects the mapping to the scale of a unit."""
    between = relation(2.8, 2.9, 2.85, powers={"speed_m_s": 1}, text="another speed")
    likeliest = {
        scale: posterior([between], known_hypotheses(("speed_m_s",)), {"speed_m_s": scale}).of("speed_m_s")[0]
        for scale in (3.6, 1.0 / 0.44704)
    }
    assert [h.factors["speed_m_s"] for _, h in likeliest.values()] == pytest.approx([1.0 / 3.6, 0.44704])
    assert all(p > 0.75 for p, _ in likeliest.values())
    counts = posterior([between], known_hypotheses(("speed_m_s",)), {"speed_m_s": 0.0123})
    assert counts == posterior([between], known_hypotheses(("speed_m_s",)))


def test_inspect_and_run_refuse_the_same_channels(sample_logs_dir):
    log = open_log(sample_logs_dir / "dlc.mcap")
    right = auto_map(log).mapping
    degrees = {"yaw_rate_rad_s": scaled_source(right.truth["yaw_rate_rad_s"], 180.0 / np.pi)}
    wrong = replace(right, truth={**right.truth, **degrees}, origin="file")
    inspection = inspect_drive_log(log, wrong)
    plan = plan_drive(log, wrong, default_vehicle(), log.start_ns, log.end_ns)
    log.close()
    assert inspection.refused == plan.refused
    assert set(plan.refused) == {"truth.yaw_rate_rad_s"}
    assert "physics" in inspection.estimators
