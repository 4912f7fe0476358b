"""The figures of a fleet: exact intervals, rankings that need evidence, and no score without ground truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.results.fleet import ANSWER, Breakdown, Fleet, breakdowns, read_fleet
from pdhef_logtool.results.opened_run import open_run
from tests.results.made_run import entry, row, write_run
from tests.run_report import TRUTH, report, truth

LOST = {"kind": "truncated", "where": "a.mcap", "severity": "lost", "start_ns": None, "end_ns": None}
LOST |= {"what": "ends at byte 3; what follows is gone (a.mcap)"}
CELL = {"speed": 4, "ay": 1, "seconds": 5.0, "scored": 100, "sideslip_mse_rad2": 1e-4}
SPACE = {"speed_edges_m_s": [0, 5, 10, 15, 20], "ay_edges_m_s2": [0, 1, 2], "cells": [CELL]}


class Run:
    """A run's folder that a test fills."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.logs: list[dict[str, Any]] = []
        self.rows: list[MetricRow] = []
        self.reports: dict[str, dict[str, Any]] = {}

    def add(self, label: str, errors: Mapping[str, float] | None = None, outcome: str = "ok", **changes: Any) -> None:
        self.logs.append(entry(label, outcome=outcome))
        if outcome.startswith("failed"):
            return
        self.reports[label] = report(None, **{"operating_space": SPACE, "metadata": {}, **changes})
        independent = "sideslip_rad" not in self.reports[label]["truth"]["not_independent"]
        for name, value in (errors or {}).items():
            self.rows += [
                row(label, figure, estimator=name, segment=segment, independent=independent)
                for segment, figure in (("all", value), ("linear", 99.0))
            ]

    def read(self, **options: Any) -> Fleet:
        write_run(self.folder, {}, entries=self.logs, rows=self.rows, reports=self.reports)
        return read_fleet(open_run(self.folder), **options)


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


def test_six_drives_rank_nobody_and_seven_can(run):
    for i in range(6):
        run.add(f"d{i}", {"pd-hef": 0.01 + 0.001 * i, "physics": 0.02, "zero": 0.2})
    found = run.read()
    assert found.ranking == () and found.least_to_rank == 7
    run.add("d6", {"pd-hef": 0.01, "physics": 0.02, "zero": 0.2})
    assert [(r.place, r.estimator) for r in run.read().ranking] == [(1, "pd-hef"), (2, "physics"), (3, "zero")]


def test_drives_without_independent_truth_stand_apart_and_score_nothing(run):
    run.add("good", {"pd-hef": 0.01})
    run.add("none", truth=truth())
    run.add("own", {"pd-hef": 0.0}, truth=TRUTH | {"not_independent": ["sideslip_rad"]})
    for name, d2 in (("pd-hef", 0.3), ("zero", 0.1)):
        run.rows.append(row("none", d2, estimator=name, signal="vy_m_s", metric="d2"))
    found = run.read()
    assert [d.label for d in found.scored] == ["good"]
    assert [(d.label, d.unscored) for d in found.without_truth] == [
        ("none", "the log has no ground truth"),
        ("own", "its ground truth is not independent"),
    ]
    (answer, _) = found.distributions
    assert (answer.estimator, answer.median.units) == (ANSWER, 1)


def test_failures_are_told_by_reason(run):
    run.add("ok", {"pd-hef": 0.01}, outcome="lost: 2 things", losses=[LOST, {**LOST, "severity": "note"}])
    for i in range(12):
        run.add(f"f{i}", outcome=f"failed: /x/{i}.mcap: expected a log, got {i} bytes; copy it again")
    found = run.read()
    first = found.failed[0]
    assert (first.count, first.reason) == (12, "expected a log, got 0 bytes; copy it again")
    assert len(found.failed[0].labels) == 10
    assert len(found.failed) == 1 and found.logs == 13 and len(found.drives) == 1
    assert [f.reason for f in found.losses] == ["ends at byte 3; what follows is gone"]


def test_effects_have_intervals_and_keys_without_one_are_not_significant(run):
    rng = np.random.default_rng(2)
    for i in range(40):
        wet = i % 2
        metadata = {"road": "wet" if wet else "dry", "water": str(wet), "odometer": str(1000 + i)}
        metadata |= {"driver": f"x{i}", "tyre": "ab"[i % 3 == 0], "same": "1"}
        run.add(f"d{i}", {"pd-hef": float((3.0 if wet else 1.0) * rng.lognormal(0.0, 0.2))}, metadata=metadata)
    found = run.read()
    by_key = {b.key: b for b in found.breakdowns}
    assert found.breakdowns[0].key == "road" and found.breakdowns[0].also == ("water",)
    dry, wet = found.breakdowns[0].groups
    assert (dry.value, dry.drives, wet.value, wet.drives) == ("dry", 20, "wet", 20)
    assert wet.effect.share == pytest.approx(2.0, abs=0.5) and wet.effect.low > 1.0 and wet.effect.significant
    assert 1.0 + dry.effect.share == pytest.approx(1.0 / (1.0 + wet.effect.share))
    assert not {"same", "driver", "odometer"} & set(by_key) and by_key["tyre"].p > 0.05
    (only,) = run.read(by=["same"]).breakdowns
    assert [(g.value, g.scored, g.effect) for g in only.groups] == [("1", 40, None)]
    assert run.read(by=["driver"]).breakdowns[0].groups[0].value == "28 others"
    (nothing,) = run.read(by=["no such key"]).breakdowns
    assert [g.value for g in nothing.groups] == ["not given"]


def test_the_operating_space_adds_up_and_empty_cells_are_empty(run):
    space = SPACE | {"cells": [{"speed": 0, "ay": 2, "seconds": 1.0, "scored": 300, "sideslip_mse_rad2": 9e-4}]}
    run.add("a", {"pd-hef": 0.1})
    run.add("b", {"pd-hef": 0.1})
    run.add("c", {"pd-hef": 0.1}, operating_space=space)
    run.add("older", {"pd-hef": 0.1}, operating_space=None)
    found = run.read().space
    assert found is not None and found.drives == 3
    assert found.seconds[4, 1] == 10.0 and found.seconds.sum() == 11.0
    assert found.rmse_rad[4, 1] == pytest.approx(0.01) and found.rmse_rad[0, 2] == pytest.approx(0.03)
    assert np.isnan(found.rmse_rad[1, 1])


def found(errors: list[float], days: list[int] | None = None, **keys: list[str]) -> tuple[Breakdown, ...]:
    of_drives = [dict(zip(keys, values, strict=True)) for values in zip(*keys.values(), strict=True)]
    return breakdowns(np.array(errors), of_drives, {"day": days or [None] * len(errors), "car": [None] * len(errors)})


def test_an_effect_is_that_of_welch():
    rng = np.random.default_rng(0)
    a, b = rng.lognormal(0.0, 0.3, 12), rng.lognormal(0.4, 0.5, 9)
    (only,) = found([*a, *b], k=["a"] * 12 + ["b"] * 9)
    reference = stats.ttest_ind(np.log(b), np.log(a), equal_var=False)
    effect = only.groups[1].effect
    assert effect is not None and effect.p == pytest.approx(reference.pvalue)
    low, high = reference.confidence_interval()
    assert (effect.low, effect.high) == pytest.approx((np.expm1(low), np.expm1(high)))


def test_of_fleets_without_effects_few_show_any():
    rng = np.random.default_rng(1)
    wrong = naive = 0
    for _ in range(40):
        keys = rng.integers(0, 3, (8, 40))
        errors = rng.lognormal(size=40)
        shown = found([*errors], **{f"k{k}": [*map(str, v)] for k, v in enumerate(keys)})
        effects = [g.effect for b in shown for g in b.groups if g.effect is not None]
        assert all(e.significant == (e.low > 0.0 or e.high < 0.0) for e in effects)
        wrong += any(e.significant for e in effects)
        logs = np.log(errors)
        naive += any(stats.ttest_ind(logs[v == x], logs[v != x]).pvalue < 0.05 for v in keys for x in range(3))
    assert wrong <= 5 and naive >= 16


def test_days_that_differ_are_no_effect_of_the_weather():
    rng = np.random.default_rng(3)
    wrong = 0
    for _ in range(100):
        day = np.repeat(np.arange(12), 8)
        errors = np.exp(rng.normal(size=12)[day] + 0.3 * rng.normal(size=96))
        (weather,) = found([*errors], day.tolist(), weather=["wet" if d % 2 else "dry" for d in day])
        wrong += weather.p < 0.05
    assert wrong <= 10  # nominal 5
