"""Before and now: only what both have is compared, drive by drive, and what counts as worse."""

from __future__ import annotations

import numpy as np
import polars as pl

from studies import paired


def table(factor: float, drives: range) -> pl.DataFrame:
    rng = np.random.default_rng(1)
    base = np.radians(0.05) * np.exp(rng.normal(0.0, 0.5, 40))
    rows = [("in-domain", f"{d:03d}", "pd-hef", float(base[d] * factor), 1000) for d in drives]
    return pl.DataFrame(rows, schema=("row", "drive", "estimator", "value", "n"), orient="row")


def test_only_drives_that_both_have_count_and_a_tenth_more_is_worse():
    lines = paired.conditions(table(1.0, range(30)), table(1.1, range(5, 40)), "pd-hef")
    assert [line[3:] for line in lines] == [["1.10 [1.10, 1.10]", "25", "**worse**"]]
    assert paired.conditions(table(1.0, range(30)), table(1.04, range(30)), "pd-hef")[0][-1] == "not worse"
    assert paired.conditions(table(1.0, range(30)), table(0.9, range(30)), "pd-hef")[0][-1] == "better"


def test_a_tenth_more_of_hardly_anything_is_not_worse():
    small = table(0.1, range(30))
    more = small.with_columns(pl.col("value") * 1.1)
    assert paired.conditions(small, more, "pd-hef")[0][-1] == "not worse"


def test_blocks_are_weighed_by_their_stamps():
    columns = ("case", "estimator", "block", "stamps", "sideslip_rmse_deg")
    before = pl.DataFrame([("a", "x", 0, 100, 1.0), ("a", "x", 1, 300, 2.0)], schema=columns, orient="row")
    after = pl.DataFrame([("a", "x", 0, 100, 2.0), ("a", "x", 1, 300, 1.0)], schema=columns, orient="row")
    (line,) = paired.recorded(before, after)
    assert line[:3] == ["a: x", f"{np.sqrt(13 / 4):.3f}", f"{np.sqrt(7 / 4):.3f}"]
