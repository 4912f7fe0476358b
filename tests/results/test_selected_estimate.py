"""The selected estimate of a run in words: every claim has a figure that supports it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from run_report import GNSS, MAIN, MODEL, TRUTH, errors_deg, figures, ran, report, truth

from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.validation_plan import SIDESLIP
from pdhef_logtool.results.selected_estimate import MainFacts

UNKNOWN = {"file": None, "proven": False}


def texts(main: MainFacts = MAIN, **changes: Any) -> dict[str, str]:
    found: dict[str, str] = report(main, **changes)["answer"]["texts"]
    return found


def test_the_result_says_how_good_against_which_truth_and_against_whom() -> None:
    said = texts(metrics=errors_deg(pd_hef=0.1, physics=0.12, zero=1.0))["result"]
    assert said == (
        "Sideslip RMSE of pd-hef: 0.100° (ground truth: /ins), 17 % lower than physics (0.120°), "
        "1/10 of zero sideslip (1.00°)"
    )


def test_the_interval_of_the_error_needs_six_blocks_of_time() -> None:
    def said(count: int) -> str:
        value = np.deg2rad(np.linspace(0.08, 0.12, count)).tolist()
        blocks = RequirementBlocks(SIDESLIP.measured, 10.0, range(count), [9] * count, (), (), value)
        return texts(metrics=errors_deg(pd_hef=0.1), requirement_blocks=[blocks])["result"]

    assert "0.100° (95 % CI 0.085° to 0.119°; ground truth: /ins)" in said(6)
    assert "CI" not in said(5)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        (1.0, "equal to zero sideslip"),
        (0.99, "equal within 3 % to zero sideslip"),
        (1.5, "50 % higher than zero sideslip"),
        (3.0, "3.0 times zero sideslip"),
    ],
)
def test_an_estimate_that_is_worse_than_none_is_said_to_be_of_no_use(own: float, said: str) -> None:
    result = texts(metrics=errors_deg(pd_hef=own, zero=1.0))["result"]
    assert said in result
    assert ("worse than a constant" in result) == (own > 1.1)


def test_a_truth_that_is_an_input_is_no_independent_check() -> None:
    metrics = errors_deg(pd_hef=0.1)
    assert (
        "not an independent check"
        in texts(metrics=metrics, truth=TRUTH | {"not_independent": ["sideslip_rad"]})["result"]
    )
    assert "not an independent check" not in texts(metrics=metrics)["result"]


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (1.0, "(nominal 95 %), wider than necessary"),
        (0.95, "(nominal 95 %) ("),
        (0.91, "(nominal 95 %), slightly too narrow"),
        (0.7, "(nominal 95 %), too narrow"),
    ],
)
def test_whether_the_band_holds(share: float, said: str) -> None:
    band = texts(metrics=[*errors_deg(pd_hef=0.1), *figures(("pd-hef", "sideslip_rad", "coverage95", share))])["band"]
    assert band.startswith(f"coverage {100 * share:.0f} % {said}")
    assert band.endswith("(intervals: own, parameters and sensors)")


def test_a_truth_of_gnss_alone_says_why_there_is_no_figure() -> None:
    said = texts(truth=GNSS, metrics=figures(("pd-hef", "vx_m_s", "rmse", 0.05)))
    assert "not the heading" in said["result"]
    assert "v_x 0.05 m/s" in said["result"]
    assert said["band"].startswith("coverage unknown")


@pytest.mark.parametrize(("d2", "proof"), [(0.1, "not a proof"), (0.95, "inconclusive")])
def test_without_truth_the_consistency_is_put_in_words(d2: float, proof: str) -> None:
    metrics = figures(
        ("pd-hef", "vy_m_s", "d2", d2), ("zero", "vy_m_s", "d2", 1.0),
        ("pd-hef", "state", "nis", 6.0), ("pd-hef", "state", "nis_dof", 2.0),
    )  # fmt: skip
    said = texts(truth=truth(), metrics=metrics)
    assert "is unknown" in said["result"]
    assert proof in said["consistency"]
    assert "NIS per degree of freedom 3.00 (expected value 1): model or noise are wrong" in said["consistency"]
    assert texts(metrics=metrics)["consistency"] == ""


def test_what_was_assumed_of_car_friction_and_network() -> None:
    assert texts()["assumed"] == (
        "car golf, validated on drives with ground truth; friction given (option, 0.9); "
        "residual gain 0.5 within the region of validity"
    )
    unknown = texts(vehicle=UNKNOWN)
    assert unknown["assumed"].startswith("default sedan (no car given)")
    assert unknown["next"].startswith("give your car")
    assumed = texts(friction={"source": "no value given", "value": 1.0, "topic": None, "given": False})
    assert "friction assumed (no value given, 1);" in assumed["assumed"]
    assert "--friction" in assumed["next"]
    assert texts(replace(MAIN, name="zero"))["assumed"] == "no vehicle model (zero needs none)"
    without = {**MODEL, "algorithm": "adaptive-physics", "options": {}}
    unused = {n: texts(replace(MAIN, name=n), estimators=[ran(n, algorithm=without)]) for n in ("pd-hef", "physics")}
    assert {n: "no network was trained" in said["assumed"] for n, said in unused.items()} == {
        "pd-hef": True, "physics": False,
    }  # fmt: skip


def test_the_next_steps_are_few_and_the_most_important_first() -> None:
    lacking = [
        ran("physics", outcome="skipped", reason="the log has no steer_rad", algorithm=None),
        ran("zero", algorithm=None),
    ]
    said = texts(replace(MAIN, name="zero"), estimators=lacking, vehicle=UNKNOWN)["next"]
    assert said.startswith("map the missing signals (the log has no steer_rad)")
    assert said.count("; ") == 1
    distrusted = replace(MAIN, name="open-loop", why="pd-hef contradicts", distrusted=True)
    estimators = [ran("open-loop")]
    said = texts(distrusted, estimators=estimators)
    assert "pd-hef contradicts" in said["assumed"]
    assert said["next"].startswith("check the vehicle file")
    assert texts()["next"] == ""


@pytest.mark.parametrize(("own", "zero"), [(0.3, 0.0), (0.0, 0.3), (0.0, 0.0)])
def test_an_error_of_nothing_is_no_division(own: float, zero: float) -> None:
    result = texts(metrics=errors_deg(pd_hef=own, zero=zero))["result"]
    assert ("the sideslip of the ground truth is 0 throughout" in result) == (zero == 0.0)
