"""Reports of runs whose figures a test makes up."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.results.run_report import (
    EstimatorFacts,
    FrictionFacts,
    LogFacts,
    ReportFacts,
    SourceFacts,
    TruthFacts,
    build_report,
)
from pdhef_logtool.results.selected_estimate import MainFacts

SHA = "ab" * 32
MODEL = {"physics_sha256": SHA, "options": {"trust": 0.5}}
MAIN = MainFacts("pd-hef", "evidence", "", False, "zero", ("pd-hef", "physics", "zero"), named=False)
TRUTH = TruthFacts(
    quantities=[
        SourceFacts("vx_m_s", "/ins.vx", "m/s", 9),
        SourceFacts("vy_m_s", "/ins.vy", "m/s", 9),
        SourceFacts("sideslip_rad", "derived", "rad", 0, "atan2(v_y, v_x)"),
    ]
)
GNSS = TruthFacts(
    quantities=[SourceFacts("vx_m_s", "derived", "m/s", 0, "ground speed of /fix.{a,b} taken as v_x, no heading known")]
)


def figures(*given: tuple[str, str, str, float]) -> list[MetricRow]:
    return [MetricRow("drive", e, s, "all", m, v, "", 9) for e, s, m, v in given]


def errors_deg(**by_name: float) -> list[MetricRow]:
    return figures(*((n.replace("_", "-"), "sideslip_rad", "rmse", np.deg2rad(v)) for n, v in by_name.items()))


def report(main: MainFacts = MAIN, **changes: Any) -> dict[str, Any]:
    facts = ReportFacts(
        log=LogFacts("drive", "drive.mcap", "mcap", SHA, 0, 10_000_000_000),
        signals=[],
        missing_signals=[],
        vehicle_name="sedan",
        vehicle_sha256=SHA,
        vehicle_file="golf",
        vehicle_proven=True,
        estimators=[
            EstimatorFacts("zero", causal=True, algorithm={"physics_sha256": None, "options": {}}),
            EstimatorFacts("physics", causal=True, intervals=["intervals calibrated on x"], algorithm=MODEL),
            EstimatorFacts("pd-hef", causal=True, intervals=["intervals calibrated on x"], algorithm=MODEL),
        ],
        truth=TRUTH,
        friction=FrictionFacts("option, 0.9"),
        main=main,
    )
    return build_report(replace(facts, **changes))
