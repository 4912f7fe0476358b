"""The table of printed uncertainties."""

from __future__ import annotations

import numpy as np
import polars as pl

from studies.calibration import coverage_table


def test_a_calibrated_figure_is_accepted_and_others_are_not() -> None:
    errors = np.random.default_rng(0).normal(size=2000)
    scores = [
        {"figure": name, "drive": "road", "score": float(e) / sd}
        for name, sd in {"right": 1.0, "narrow": 0.5, "wide": 3.0}.items()
        for e in errors
    ]
    lines = [line.split("|") for line in coverage_table(pl.DataFrame(scores)).splitlines()[2:]]
    assert {line[1].strip(): line[-2].strip() for line in lines} == {"right": "yes", "narrow": "no", "wide": "too wide"}
