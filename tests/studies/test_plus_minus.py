"""The table of printed uncertainties."""

from __future__ import annotations

import numpy as np

from studies.plus_minus import Printed, coverage_table


def test_a_calibrated_figure_is_accepted_and_others_are_not() -> None:
    errors = np.random.default_rng(0).normal(size=2000)
    kinds = {"right": 1.0, "narrow": 0.5, "wide": 3.0}
    printed = [Printed(name, "road", float(e), sd) for name, sd in kinds.items() for e in errors]
    rows = {
        line.split("|")[1].strip(): line.split("|")[-2].strip() for line in coverage_table(printed).splitlines()[2:]
    }
    assert rows == {"right": "yes", "narrow": "no", "wide": "too wide"}
