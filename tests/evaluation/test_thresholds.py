"""Limits: strict reading, units, and what counts as evaluated."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.segments import SEGMENTS, segment_masks
from pdhef_logtool.evaluation.thresholds import Verdict, check_thresholds, load_thresholds, thresholds_from_dict
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Signals


def _row(estimator: str, signal: str, metric: str, value: float, unit: str = "rad", **more: Any) -> MetricRow:
    return MetricRow("drive", estimator, signal, more.pop("segment", "all"), metric, value, unit, 100, **more)


ROWS = [
    _row("phy-ukf", "sideslip_rad", "rmse", math.radians(0.4)),
    _row("phy-ukf", "sideslip_rad", "bias", math.radians(-0.3)),
    _row("phy-ukf", "sideslip_rad", "lag_s", float("nan"), "s"),
    _row("phy-ukf", "sideslip_rad", "coverage95", 0.9, "1"),
    _row("zero", "sideslip_rad", "rmse", math.radians(2.0)),
    _row("zero", "vx_m_s", "rmse", 0.1, "m/s", independent=False),
    _row("sensors", "vx_m_s", "residual_rms", 0.2, "m/s"),
]


def _check(*tables: dict[str, Any]) -> list[Verdict]:
    return check_thresholds(thresholds_from_dict({"threshold": list(tables)}, where="t.toml"), ROWS, log="drive")


def _limit(**entries: Any) -> dict[str, Any]:
    return {"signal": "sideslip_rad", "metric": "rmse", **entries}


def test_one_verdict_an_estimator_with_value_and_margin_in_the_limits_unit() -> None:
    verdicts = _check(_limit(max=0.5, unit="deg"))
    assert [(v.estimator, v.outcome) for v in verdicts] == [("phy-ukf", "pass"), ("zero", "fail")]
    assert [v.value for v in verdicts] == pytest.approx([0.4, 2.0])
    assert [v.margin for v in verdicts] == pytest.approx([0.1, -1.5])
    assert [v.failed for v in verdicts] == [False, True]


@pytest.mark.parametrize(
    ("limit", "passes"),
    [
        ({"max": math.radians(0.4)}, True),
        ({"max": math.radians(0.39)}, False),
        ({"max": math.radians(0.41), "unit": "rad"}, True),
        ({"min": 0.3, "unit": "deg"}, True),
        ({"min": 0.5, "unit": "deg"}, False),
        ({"min": 0.3, "max": 0.5, "unit": "deg"}, True),
        ({"metric": "bias", "min": -0.35, "max": 0.35, "unit": "deg"}, True),
        ({"metric": "bias", "min": -0.25, "max": 0.25, "unit": "deg"}, False),
        ({"metric": "coverage95", "min": 85.0, "unit": "%"}, True),
        ({"metric": "coverage95", "min": 0.95}, False),
    ],
)
def test_limits_are_inclusive_and_converted(limit: dict[str, Any], passes: bool) -> None:
    (verdict,) = _check(_limit(estimator="phy-ukf", **limit))
    assert (verdict.outcome == "pass") is passes


def test_globs_choose_estimators_and_spare_what_is_none() -> None:
    assert [v.estimator for v in _check(_limit(estimator="phy-*", max=1.0))] == ["phy-ukf"]
    table = {"signal": "vx_m_s", "metric": "residual_rms", "max": 1.0}
    assert [v.outcome for v in _check(table)] == ["not evaluated"]  # sensors are no estimator
    assert [v.outcome for v in _check({**table, "estimator": "sensors"})] == ["pass"]


@pytest.mark.parametrize(
    "limit",
    [{"estimator": "pd-hef"}, {"segment": "slalom"}, {"metric": "nees"}, {"estimator": "phy-ukf", "metric": "lag_s"}],
)
def test_what_is_not_evaluated_fails_unless_optional(limit: dict[str, Any]) -> None:
    (verdict,) = _check(_limit(max=1.0, **limit))
    assert (verdict.outcome, verdict.failed, verdict.value) == ("not evaluated", True, None)
    assert verdict.reason
    (verdict,) = _check(_limit(max=1.0, optional=True, **limit))
    assert (verdict.outcome, verdict.failed) == ("skipped", False)


def test_optional_excuses_no_figure_beyond_its_limit() -> None:
    (verdict,) = _check(_limit(estimator="zero", max=0.1, unit="deg", optional=True))
    assert verdict.outcome == "fail"


def test_what_is_not_independent_is_said() -> None:
    (verdict,) = _check({"signal": "vx_m_s", "metric": "rmse", "max": 1.0})
    assert not verdict.independent
    assert "not independent" in verdict.reason


def test_all_problems_come_at_once() -> None:
    tables = [
        {"signal": "sideslip", "metric": "rsme", "segment": "al", "max": 1.0},
        {"signal": "sideslip_rad", "metric": "rmse"},
        {"signal": "sideslip_rad", "metric": "rmse", "max": 1.0, "unit": "m"},
        {"signal": "sideslip_rad", "metric": "rmse", "max": 1.0, "maxx": 2.0},
        {"signal": "vx_m_s", "metric": "rmse", "max": float("nan")},
        {"signal": "vx_m_s", "metric": "mae", "max": 1.0, "min": 2.0},
        {"metric": "mae", "max": "1"},
        {"signal": "vy_m_s", "metric": "mae", "max": 1.0},
        {"signal": "vy_m_s", "metric": "mae", "max": 2.0},
    ]
    with pytest.raises(UsageError) as caught:
        thresholds_from_dict({"threshold": tables, "treshold": []}, where="t.toml")
    text = str(caught.value)
    for said in (
        "treshold: unknown, did you mean threshold?",
        "threshold[0].signal = sideslip: unknown, did you mean sideslip_rad?",
        "threshold[0].metric = rsme: unknown, did you mean rmse?",
        "threshold[0].segment = al: unknown, did you mean all?",
        "threshold[1]: give min, max or both",
        "threshold[2].unit: sideslip_rad rmse is in rad or deg, not 'm'",
        "threshold[3].maxx: unknown, did you mean threshold[3].max?",
        "threshold[4].max:",
        "threshold[5]: min must not be above max",
        "threshold[6].signal: is missing",
        "threshold[6].max:",
        "threshold[8]: limits the same figure as threshold[7]",
    ):
        assert said in text
    assert "\n" not in text


@pytest.mark.parametrize("text", ["", "threshold = 3", "[[threshold]]\nmax = ", "[threshold]\nmax = 1.0"])
def test_files_without_a_threshold_are_usage_errors(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.toml").write_text(text)
    with pytest.raises(UsageError, match=r"t\.toml"):
        load_thresholds(tmp_path / "t.toml")


def test_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        load_thresholds(tmp_path / "none.toml")


def test_segments_that_a_threshold_may_name_are_those_that_there_are() -> None:
    stamps = np.arange(3, dtype=np.int64) * 10_000_000
    nan = np.full(3, np.nan)
    signals = Signals(stamps, stamps, nan, nan, nan, nan, nan, nan, np.full((3, 4), np.nan))
    assert tuple(segment_masks(signals, None, default_vehicle())) == SEGMENTS
