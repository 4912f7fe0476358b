"""Verdicts on synthetic drives: they flip at the right limits, with the promised error rates, and say what to drive."""

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.evaluation import validation_plan
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.requirement_verdicts import DriveValue, JudgedDrive, judge
from pdhef_logtool.evaluation.statistics import least_drives
from pdhef_logtool.evaluation.validation_plan import Requirement, default_plan, example_plan, load_plan, plan_from_dict
from pdhef_logtool.records.errors import UsageError
from tests.run_report import follows

LIMIT = Requirement("A", "", "sideslip_rad", limit=0.02)
RATIO = Requirement("B", "", "sideslip_rad", baseline="run", max_ratio=1.0)


def drives(
    values: Sequence[float], others: Sequence[float] | None = None, n: Sequence[int] = (), **more: Any
) -> list[DriveValue]:
    return [
        DriveValue(
            JudgedDrive(f"d{i}", None), "pd-hef", float(v), int(n[i]) if len(n) else 1000,
            None if others is None else float(others[i]), 60.0, 1000.0, **more,
        )
        for i, v in enumerate(values)
    ]  # fmt: skip


def blocks(values: Sequence[float], baseline: Sequence[float] = (), std: Sequence[float] = ()) -> RequirementBlocks:
    k = len(values)
    return RequirementBlocks("x", 10.0, range(k), [1000] * k, [10.0] * k, [200.0] * k, values, baseline, std)


@pytest.mark.parametrize(("spread", "count"), [(0.3, 5), (0.8, 5), (0.5, 100)])
def test_the_bound_covers_the_true_value_as_often_as_it_says(spread, count):
    rng = np.random.default_rng(count)
    true = 0.01 * math.exp(spread**2)  # √ mean of squares of a lognormal
    covered = 0
    for _ in range(100):
        values, n = 0.01 * np.exp(rng.normal(0.0, spread, count)), rng.integers(2000, 30000, count)
        verdict = judge(LIMIT, drives(values, n=n))
        assert verdict.high is not None
        covered += verdict.high >= true
    assert 90 <= covered <= 100


@pytest.mark.parametrize(("limit", "outcome"), [(0.0130, "PASS"), (0.0100, "INCONCLUSIVE"), (0.0080, "FAIL")])
def test_the_verdict_flips_with_the_limit(limit, outcome):
    values = 0.01 * np.exp(np.random.default_rng(1).normal(0.0, 0.2, 20))
    verdict = judge(replace(LIMIT, limit=limit), drives(values))
    assert verdict.outcome == outcome and verdict.basis == "drives"
    assert verdict.margin == pytest.approx(limit - verdict.value)
    assert verdict.low is not None and verdict.high is not None and verdict.low < verdict.value < verdict.high
    if outcome == "PASS":
        assert (verdict.reason[:6], verdict.next) == ("0.596°", "") or verdict.next == ""


def test_an_inconclusive_verdict_says_how_much_driving_would_decide():
    values = 0.01 * np.exp(np.random.default_rng(1).normal(0.0, 0.3, 8))
    verdict = judge(replace(LIMIT, limit=0.0119), drives(values))
    assert verdict.outcome == "INCONCLUSIVE" and "includes the limit" in verdict.reason
    assert "times as much driving would decide" in verdict.next and re.search(r"\(\d+(\.\d)? min more\)", verdict.next)


@pytest.mark.parametrize(
    ("needs", "reason", "to_do"),
    [
        ({"exposure_drives": 40}, "20 of 40 drives", "drive 20 drives more, with ground truth"),
        ({"exposure_minutes": 30.0}, "20.0 of 30 minutes", "drive 10.0 minutes more"),
        ({"exposure_km": 100.0}, "20.0 of 100 km", "drive 80.0 km more"),
    ],
)
def test_too_little_driving_is_inconclusive_whatever_the_value(needs, reason, to_do):
    for value in (0.001, 1.0):
        verdict = judge(replace(LIMIT, **needs), drives([value] * 20))
        assert verdict.outcome == "INCONCLUSIVE"
        assert reason in verdict.reason and to_do in verdict.next
    unknown = [replace(d, seconds=math.nan) for d in drives([0.001] * 20)]
    assert judge(replace(LIMIT, exposure_minutes=1.0), unknown).outcome == "INCONCLUSIVE"
    assert judge(LIMIT, unknown).outcome == "PASS"


def test_below_five_drives_blocks_decide_and_the_verdict_says_so():
    rng = np.random.default_rng(2)
    values = 0.01 * np.exp(rng.normal(0.0, 0.2, 30))
    whole = float(np.sqrt(np.mean(values**2)))
    (drive,) = drives([whole], blocks=blocks(values.tolist()))
    verdict = judge(LIMIT, [drive])
    assert (verdict.outcome, verdict.basis, verdict.units, verdict.block_s) == ("PASS", "blocks", 30, 10.0)
    assert verdict.value == pytest.approx(whole)
    assert "blocks of 10 s within 1 drive: other drives may differ more" in verdict.notes[0]
    short = judge(LIMIT, [replace(drive, blocks=blocks(values[:3].tolist()))])
    assert short.outcome == "INCONCLUSIVE" and "from 3 blocks" in short.reason and "30 s more" in short.next
    none = judge(LIMIT, [replace(drive, blocks=None)])
    assert none.outcome == "INCONCLUSIVE" and none.next == "run the logs again with this plan"


def test_against_an_estimated_reference_no_small_margin_decides():
    values, std = [0.0100, 0.0101] * 10, 0.006
    near = drives(values, std=std)
    assert judge(replace(LIMIT, limit=0.0150), drives(values)).outcome == "PASS"
    verdict = judge(replace(LIMIT, limit=0.0150), near)
    assert verdict.outcome == "INCONCLUSIVE" and verdict.against == "estimated reference"
    assert "closer than 2 standard deviations of the estimated reference (0.344°)" in verdict.reason
    assert judge(replace(LIMIT, limit=0.0230), near).outcome == "PASS"
    ratio = replace(RATIO, baseline="zero", max_ratio=0.9)
    assert judge(ratio, drives(values, [0.02] * 20, std=std)).outcome == "INCONCLUSIVE"
    assert judge(ratio, drives(values, [0.06] * 20, std=std)).outcome == "PASS"


def test_minimum_bias_worst_drive_and_quantile():
    share = replace(LIMIT, metric="coverage95", limit=0.9)
    assert judge(share, drives([0.94, 0.95, 0.96] * 4)).outcome == "PASS"
    assert judge(share, drives([0.60, 0.65, 0.70] * 4)).outcome == "FAIL"
    bias = replace(LIMIT, metric="bias")
    assert judge(bias, drives([-0.031, -0.030, -0.029] * 4)).outcome == "FAIL"
    assert judge(bias, drives([-0.01, 0.0, 0.01] * 4)).outcome == "PASS"
    worst = replace(LIMIT, statistic="worst drive")
    verdict = judge(worst, drives([0.01] * 9 + [0.021]))
    assert (verdict.outcome, verdict.worst) == ("FAIL", "d9")
    assert "at least 69% of drives like these" in judge(worst, drives([0.01] * 10)).reason
    tenth = replace(LIMIT, statistic="quantile 0.9", quantile=0.9)
    assert "drive 26 more drives" in judge(tenth, drives([0.01] * 10)).next
    assert judge(tenth, drives([0.01] * least_drives(0.9, 0.95))).outcome == "PASS"


WHOLE = {"id": "A", "signal": "sideslip_rad", "limit_deg": 0.5}


def read(*tables: dict[str, Any]) -> Any:
    return plan_from_dict({"requirement": list(tables)}, where="plan.toml").requirements


def test_the_example_is_valid_and_is_read(tmp_path):
    follows(tomllib.loads(example_plan()), "plan.schema.json")
    (tmp_path / "plan.toml").write_text(example_plan(), encoding="utf-8")
    plan = load_plan(tmp_path / "plan.toml")
    assert (plan.file, [r.id for r in plan.requirements]) == ("plan.toml", [f"SR-{i}" for i in range(1, 6)])
    assert plan.requirements[0].limit == pytest.approx(math.radians(0.5))
    assert plan.requirements[2].label == "sideslip RMSE ≤ 0.5 × zero"
    assert plan.requirements[4].label == "sideslip in 95 % CI ≥ 90 %"
    assert not default_plan().file


def test_a_condition_contains_its_lower_edge_and_one_car():
    need = validation_plan.ExposureNeed(speed_m_s=[10.0, 20.0], car="a", minutes=1.0)
    space = {(5.0, 0.0): 1.0, (10.0, 0.0): 3.0, (20.0, 0.0): 5.0}
    assert (need.seconds_of(space, 0.9, "a"), need.seconds_of(space, 0.9, "b")) == (3.0, 0.0)


def test_degrees_manoeuvres_and_quantiles():
    rate, quantile = read(
        {"id": "A", "signal": "yaw_rate_rad_s", "limit_deg_s": 1.0, "manoeuvre": "slalom"},
        {**WHOLE, "id": "B", "metric": "p95_abs", "statistic": "quantile 0.9"},
    )
    assert (rate.limit, rate.segment) == (pytest.approx(math.radians(1.0)), "slalom")
    assert (quantile.quantile, quantile.statistic) == (0.9, "quantile 0.9")


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ({}, "requirement.0.id: is missing"),
        ({**WHOLE, "exposure": [{"speed_m_s": [3.0, 10.0], "drives": 1}]}, "multiples of 5"),
        ({**WHOLE, "exposure": [{"friction": [0.5, 0.4], "minutes": 1.0}]}, "should be [from, to]"),
        ({**WHOLE, "exposure": [{"car": "golf"}]}, "give drives or minutes"),
        ({**WHOLE, "id": "a b"}, "requirement.0.id"),
        ({**WHOLE, "limit": 0.1}, "give one of limit, limit_deg, limit_deg_s, or baseline"),
        ({**WHOLE, "signal": "vx_m_s"}, "vx_m_s rmse is in m/s, not in rad"),
        ({**WHOLE, "baseline": "zero", "max_ratio": 1.0}, "give limit_deg or baseline, not both"),
        ({"id": "A", "signal": "sideslip_rad", "baseline": "zero"}, "max_ratio: is missing"),
        ({**WHOLE, "max_ratio": 1.0}, "max_ratio: needs a baseline"),
        ({**WHOLE, "metric": "p95_abs"}, "p95_abs of several drives cannot be pooled; use 'worst drive'"),
        ({**WHOLE, "metric": "nees"}, "requirement.0.metric = nees: unknown"),
        ({**WHOLE, "segment": "curves"}, "requirement.0.segment = curves: unknown"),
        ({**WHOLE, "segment": "all", "manoeuvre": "slalom"}, "give segment or manoeuvre, not both"),
    ],
)
def test_a_wrong_entry_is_named(table, problem):
    with pytest.raises(UsageError, match=re.escape(problem)):
        read(table)


@pytest.mark.parametrize(
    ("given", "meant"),
    [("beta", "sideslip_rad"), ("slip_angle", "sideslip_rad"), ("psi_dot", "yaw_rate_rad_s"), ("ay", "ay_m_s2")],
)
def test_a_signal_by_its_symbol_is_told_its_name(given, meant):
    with pytest.raises(UsageError, match=rf"signal = {given}: unknown, did you mean {meant}\?"):
        read({**WHOLE, "signal": given})


def test_ids_are_unique_and_a_missing_file_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="id 'A' is used 2 times"):
        read(WHOLE, WHOLE)
    with pytest.raises(UsageError, match=r"pdhef plan init -o plan\.toml writes an example"):
        load_plan(tmp_path / "none.toml")
