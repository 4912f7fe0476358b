"""The validation plan: strict reading, its JSON Schema, the example, and the conversion of earlier files."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.evaluation import validation_plan
from pdhef_logtool.evaluation.validation_plan import default_plan, example_plan, load_plan, plan_from_dict
from pdhef_logtool.records.errors import UsageError
from tests.run_report import follows

WHOLE = {"id": "A", "signal": "sideslip_rad", "limit_deg": 0.5}


def read(*tables: dict[str, Any]) -> Any:
    return plan_from_dict({"requirement": list(tables)}, where="plan.toml").requirements


def test_the_example_is_valid_and_is_read(tmp_path: Path) -> None:
    follows(tomllib.loads(example_plan()), "plan.schema.json")
    (tmp_path / "plan.toml").write_text(example_plan(), encoding="utf-8")
    plan = load_plan(tmp_path / "plan.toml")
    assert (plan.file, [r.id for r in plan.requirements]) == ("plan.toml", [f"SR-{i}" for i in range(1, 6)])
    assert plan.requirements[0].limit == pytest.approx(math.radians(0.5))
    assert plan.requirements[2].label == "sideslip RMSE ≤ 0.5 × zero"
    assert plan.requirements[4].label == "sideslip in 95 % CI ≥ 90 %"
    assert not default_plan().file


def test_a_condition_contains_its_lower_edge_and_one_car() -> None:
    need = validation_plan.ExposureNeed(speed_m_s=[10.0, 20.0], car="a", minutes=1.0)
    space = {(5.0, 0.0): 1.0, (10.0, 0.0): 3.0, (20.0, 0.0): 5.0}
    assert (need.seconds_of(space, 0.9, "a"), need.seconds_of(space, 0.9, "b")) == (3.0, 0.0)


def test_degrees_manoeuvres_and_quantiles() -> None:
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
def test_a_wrong_entry_is_named(table: dict[str, Any], problem: str) -> None:
    with pytest.raises(UsageError) as error:
        read(table)
    assert problem in str(error.value) and error.value.exit_code == 2


@pytest.mark.parametrize(
    ("given", "meant"),
    [("beta", "sideslip_rad"), ("slip_angle", "sideslip_rad"), ("psi_dot", "yaw_rate_rad_s"), ("ay", "ay_m_s2")],
)
def test_a_signal_by_its_symbol_is_told_its_name(given: str, meant: str) -> None:
    with pytest.raises(UsageError, match=rf"signal = {given}: unknown, did you mean {meant}\?"):
        read({**WHOLE, "signal": given})


def test_ids_are_unique_and_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="id 'A' is used 2 times"):
        read(WHOLE, WHOLE)
    with pytest.raises(UsageError, match=r"pdhef plan init -o plan\.toml writes an example"):
        load_plan(tmp_path / "none.toml")
