"""The verdict of a drive, one sentence per signal, from the interval or with the reason why it is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from run_report import MAIN, TRUTH, VELOCITY, errors_deg, follows, report, truth

from pdhef_logtool.evaluation.bootstrap import Interval
from pdhef_logtool.evaluation.operating_space import Cell, OperatingSpace
from pdhef_logtool.evaluation.reasons import Interval as Span
from pdhef_logtool.evaluation.reasons import SensorFault
from pdhef_logtool.evaluation.standing import Standing

NAN = float("nan")
METRICS = errors_deg(pd_hef=0.1, physics=0.12, zero=1.0)


def interval(value: float, low: float = NAN, high: float = NAN) -> Interval:
    return Interval(*np.deg2rad([value, low, high]).tolist(), blocks=30)


def standing(difference: Interval | None, rival: str | None = "physics", own: Interval | None = None) -> Standing:
    own = own or interval(0.1, 0.09, 0.11)
    rival_rmse = None if rival is None else float(np.deg2rad(0.12))
    return Standing("sideslip_rad", "pd-hef", own, rival, rival_rmse, difference, 10.0)


def verdicts(*standings: Standing, **changes: Any) -> list[dict[str, Any]]:
    return list(valid(standings, **{"metrics": METRICS, **changes})["verdicts"])


def valid(standings: Sequence[Standing] = (), **changes: Any) -> dict[str, Any]:
    document = report(MAIN, standings, **changes)
    follows({**document, "estimators": []})
    return document


@pytest.mark.slow
@pytest.mark.parametrize(
    ("difference", "outcome", "said"),
    [
        (interval(-0.02, -0.03, -0.01), "better", "17 % lower than physics (0.12°): 95 % CI of the difference -0.03°"),
        (interval(0.02, 0.01, 0.03), "worse", "17 % higher than physics (0.12°): 95 % CI of the difference"),
        (interval(-0.02, -0.05, 0.01), "undecided", "17 % lower than physics (0.12°), difference not significant: "),
        (interval(-0.02), "undecided", "17 % lower than physics (0.12°), difference not tested"),
        (interval(0.001, 0.0005, 0.002), "same", "no relevant difference to physics (0.12°)"),
        (interval(0.0, 0.0, 0.0), "same", "equal to physics (0.12°)"),
    ],
)  # fmt: skip
def test_the_sentence_claims_what_the_interval_holds(difference: Interval, outcome: str, said: str) -> None:
    first = verdicts(standing(difference))[0]
    assert (first["signal"], first["outcome"]) == ("sideslip_rad", outcome)
    assert first["text"].startswith("RMSE of pd-hef: 0.1° (95 % CI 0.09° to 0.11°); " + said)


def test_without_a_rival_or_an_interval_that_is_said() -> None:
    first = verdicts(standing(None, None, interval(0.1)))[0]
    assert first["outcome"] == "alone"
    assert "no CI: it needs 6 blocks of 10 s" in first["text"]
    assert first["text"].endswith("no other filter without a network ran for comparison")
    assert first["rmse"]["low"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"truth": truth()}, "the log contains no ground truth"),
        ({"truth": TRUTH | {"not_independent": ["sideslip_rad"]}}, "is an input of the estimator"),
        ({"truth": truth(*VELOCITY)}, "the ground truth does not contain it"),
        ({}, "its ground truth and pd-hef are never valid at the same time"),
    ],
)
def test_no_verdict_without_independent_truth_and_why(changes: dict[str, Any], why: str) -> None:
    first = verdicts(**changes)[0]
    assert first["outcome"] == "none" and first["rmse"] is None
    assert first["text"] == f"no verdict: {why}" or why in first["text"]


def test_a_truth_that_never_slips_gives_no_verdict() -> None:
    first = verdicts(standing(None), metrics=errors_deg(pd_hef=0.1, zero=1e-6))[0]
    assert first["outcome"] == "none" and "0 throughout" in first["text"]


def test_records_of_a_drive_follow_the_schema() -> None:
    fault = SensorFault("ay_m_s2", "spike", 70, 1.0, (Span(1, 2),))
    space = OperatingSpace([Cell(3, 2, 1.5, 0, NAN)], 0.9)
    document = valid(faults=[fault], metadata={"vehicle": "a"}, operating_space=space)
    assert document["operating_space"]["cells"][0]["sideslip_mse_rad2"] is None
    assert valid(faults=None)["faults"] is None
