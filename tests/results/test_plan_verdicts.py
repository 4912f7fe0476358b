"""A plan on the figures of a run: which drives count, against what, with how much driving, and why none does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl
import pytest

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.requirement_verdicts import RequirementVerdict
from pdhef_logtool.evaluation.validation_plan import Requirement, ValidationPlan
from pdhef_logtool.results.plan_verdicts import (
    JudgedDrive,
    figures_of_file,
    figures_of_rows,
    plan_verdicts,
)

BETA = Requirement("A", "", "sideslip_rad", limit=0.02)
SIX = tuple("abcdef")


def row(log: str, metric: str, value: float, n: int = 1000, **changes: str) -> MetricRow:
    of = {"estimator": "pd-hef", "signal": "sideslip_rad", "segment": "all", "unit": "rad", **changes}
    return MetricRow(log, of["estimator"], of["signal"], of["segment"], metric, value, of["unit"], n)


def scored(logs: Sequence[str] = SIX, value: float = 0.01, **changes: str) -> list[MetricRow]:
    exposed = [row(log, m, v, 2000, estimator="sensors", signal="state")
               for log in logs for m, v in (("exposure_s", 120.0), ("exposure_m", 3000.0))]  # fmt: skip
    return [*(row(log, "rmse", value * (1.0 + 0.01 * i), **changes) for i, log in enumerate(logs)), *exposed]


def judged(rows: list[MetricRow], requirement: Requirement = BETA, **options: Any) -> RequirementVerdict:
    logs = list(dict.fromkeys(r.log for r in rows))
    drives = options.pop("drives", None) or [JudgedDrive(log, options.get("main", "pd-hef")) for log in logs]
    options.pop("main", None)
    (verdict,) = plan_verdicts(ValidationPlan((requirement,)), figures_of_rows(rows), drives, **options).verdicts
    return verdict


def test_drives_are_pooled_with_the_exposure_of_their_scored_stamps() -> None:
    verdict = judged(scored())
    assert (verdict.outcome, verdict.basis, verdict.units, verdict.worst) == ("PASS", "drives", 6, "f")
    assert (verdict.exposure.minutes, verdict.exposure.km) == (6.0, 9.0)  # half of the stamps are scored
    assert verdict.estimators == ("pd-hef",)


def test_a_file_gives_the_same_verdict_as_the_rows() -> None:
    rows = scored() + scored(value=0.5, estimator="zero")
    plan = ValidationPlan((BETA,))
    frame = pl.DataFrame([{k: getattr(r, k) for k in MetricRow.__dataclass_fields__} for r in rows]).lazy()
    drives = [JudgedDrive(log, "pd-hef") for log in SIX]
    of_file = plan_verdicts(plan, figures_of_file(frame, plan, ["pd-hef"] * 6), drives)
    assert of_file == plan_verdicts(plan, figures_of_rows(rows), drives)


def test_dependent_ground_truth_does_not_count() -> None:
    dependent = [row(log, "not_independent", 1.0, unit="1") for log in SIX]
    verdict = judged(scored() + dependent)
    assert verdict.outcome == "INCONCLUSIVE" and "not an independent check" in verdict.reason
    assert judged(scored() + dependent[:1]).exposure.drives == 5


def test_the_estimated_reference_counts_only_without_ground_truth() -> None:
    reference = [r for log in SIX for r in (row(log, "reference_rms", 0.001), row(log, "reference_std", 0.0005))]
    alone = judged(reference)
    assert (alone.against, alone.outcome) == ("estimated reference", "PASS")
    both = judged(scored() + reference)
    assert both.against == "ground truth" and both.value == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize(
    ("requirement", "reason"),
    [
        (Requirement("A", "", "vx_m_s", limit=1.0), "no ground truth of vx_m_s"),
        (Requirement("A", "", "sideslip_rad", segment="slalom", limit=1.0), "no scored driving in slalom"),
        (Requirement("A", "", "sideslip_rad", estimator="ekf", limit=1.0), "ekf did not run: add it to --estimators"),
        (Requirement("A", "", "sideslip_rad", baseline="ekf", max_ratio=1.0), "ekf has no such value"),
        (Requirement("A", "", "sideslip_rad", baseline="run", max_ratio=1.0), "pdhef compare A B --plan PLAN"),
    ],
)
def test_the_reason_for_no_value_is_given(requirement: Requirement, reason: str) -> None:
    verdict = judged(scored(), requirement)
    assert (verdict.outcome, verdict.exposure.drives) == ("INCONCLUSIVE", 0)
    assert reason in verdict.reason


def test_a_recorded_estimate_is_judged_where_it_is_the_only_one() -> None:
    recorded = scored(estimator="esc")
    drives = [JudgedDrive(log, None) for log in SIX]
    assert judged(recorded, drives=drives).estimators == ("esc",)
    several = judged(recorded + scored(estimator="other"), drives=drives)
    assert several.reason == "there are several recorded estimates: name one with estimator"


def test_run_a_is_the_baseline_of_a_comparison_with_its_own_selected_estimate() -> None:
    requirement = Requirement("A", "", "sideslip_rad", baseline="run", max_ratio=1.05)
    a = figures_of_rows(scored(value=0.02, estimator="physics"))
    partners = {log: JudgedDrive(log, "physics") for log in SIX}
    verdict = judged(scored(), requirement, against=(a, partners))
    assert (verdict.outcome, verdict.value) == ("PASS", pytest.approx(0.5))
    del partners["a"]
    assert judged(scored(), requirement, against=(a, partners)).exposure.drives == 5


def test_blocks_are_read_only_where_fewer_than_five_drives_are_scored() -> None:
    read: list[str] = []

    def blocks(log: str) -> list[RequirementBlocks]:
        read.append(log)
        k = 8
        return [RequirementBlocks(BETA.measured, "pd-hef", 10.0, range(k), [99] * k, [10.0] * k, [9.0] * k, [0.01] * k)]

    def drives(logs: Sequence[str]) -> list[JudgedDrive]:
        return [JudgedDrive(log, "pd-hef", lambda log=log: blocks(log)) for log in logs]  # type: ignore[misc]

    assert judged(scored(), drives=drives(SIX)).basis == "drives" and read == []
    few = judged(scored("ab"), drives=drives("ab"))
    assert (few.basis, few.units, read) == ("blocks", 16, ["a", "b"])
    assert few.exposure.minutes == pytest.approx(160.0 / 60.0)


def test_only_a_users_plan_closes_the_gate() -> None:
    rows = scored(value=0.5)
    for file, strict, closed in (("", True, False), ("plan.toml", False, True)):
        plan = ValidationPlan((BETA,), file=file)
        verdicts = plan_verdicts(plan, figures_of_rows(rows), [JudgedDrive(x, "pd-hef") for x in SIX], strict=strict)
        assert verdicts.closes_gate is closed
    nothing = plan_verdicts(ValidationPlan((BETA,), file="plan.toml"), figures_of_rows([]), [], strict=True)
    assert nothing.closes_gate and not plan_verdicts(nothing.plan, figures_of_rows([]), []).closes_gate
    assert nothing.to_dict()["requirements"][0]["value"] is None
