"""The sideslip reference on one simulated drive (truthsim) with faults of sensors, GNSS and vehicle file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from studies import reference as study
from studies.gates.tool import Tool
from studies.pages import ROOT

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("fault", ["", *study.FAULTS, study.WRONG_AXLE])
def test_a_fault_costs_little_and_the_interval_contains_the_error(tmp_path: Path, fault: str) -> None:
    road = replace(study.SIMULATED["road, 20 s"], duration_s=50.0)
    case = study.Case("road", study.MADE, spec=road, fault=fault)
    figures = study.figures(case, Tool(ROOT, tmp_path), with_filters=False)
    assert figures.used_gnss
    assert not figures.refused
    assert figures.rmse < 0.35
    assert figures.coverage > 0.9


def test_a_spin_is_followed_with_gnss_and_refused_without(tmp_path: Path) -> None:
    title = "spin, fishhook at 110 km/h"
    spin = study.SIMULATED[title]
    aided, alone = (
        study.figures(study.Case(title, gnss, spec=spin), Tool(ROOT, tmp_path), with_filters=False)
        for gnss in (study.MADE, study.NONE)
    )
    assert aided.rmse < 0.5
    assert not aided.refused
    assert alone.refused
