"""What the figures of two versions have in common, drive by drive and block by block: ``docs/paired.md``.

    python -m studies.paired [--before studies/before] [--estimators pd-hef,pd-hef-smoothed] [--out docs]

``studies/before`` holds the sideslip RMSE of every drive of ``docs/conditions.md`` and of every block of 10 s of
``docs/real.md`` as they were before ``physics`` took the place of ``physics-plus``; what they are now stands in
``docs/conditions/metrics.parquet`` and ``docs/real/blocks.parquet``. A row is *worse* where the whole 95 % interval of
the paired ratio lies above 1, the median rises by more than 5 % and by more than 0.003°.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl

from studies.condition_drives import SIDESLIP
from studies.pages import DOCS, ROOT, options, table, write
from studies.table_maths import Bound, median, median_ratio, pooled_ratio, pooled_rmse

WORSE_RATIO, WORSE_DEG = 1.05, 0.003


_COLUMNS = ("sideslip_rmse_deg", "stamps", "sideslip_rmse_deg_after", "stamps_after")


def paired(before: pl.DataFrame, after: pl.DataFrame, on: Sequence[str]) -> pl.DataFrame:
    """Return the figures that both have, in the order of the first: ``value``, ``n`` and those ``_after``."""
    plain = [frame.with_columns(pl.col(c).cast(pl.String) for c in on) for frame in (before, after)]
    return plain[0].join(plain[1], on=list(on), suffix="_after", maintain_order="left")


def verdict(before_deg: float, after_deg: float, ratio: Bound) -> str:
    """Say what a row came to."""
    if not math.isfinite(ratio.low):
        return "–"
    if ratio.high < 1.0:
        return "better"
    is_more = after_deg > WORSE_RATIO * before_deg and after_deg - before_deg > WORSE_DEG
    return "**worse**" if ratio.low > 1.0 and is_more else "not worse"


def _line(name: str, before_deg: float, after_deg: float, ratio: Bound) -> list[str]:
    interval = f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"
    verdict_ = verdict(before_deg, after_deg, ratio)
    return [name, f"{before_deg:.3f}", f"{after_deg:.3f}", interval, str(ratio.drives), verdict_]


def conditions(before: pl.DataFrame, after: pl.DataFrame, estimator: str) -> list[list[str]]:
    """Return the lines of an estimator: medians over the drives of each row, in degrees, and their paired ratio."""
    both = paired(before, after, ("row", "drive", "estimator")).filter(pl.col("estimator") == estimator)
    lines = []
    for (row,), found in both.group_by("row", maintain_order=True):
        a, b = (np.degrees(found[c].to_numpy().astype(np.float64)) for c in ("value", "value_after"))
        lines.append(_line(str(row), median(a), median(b), median_ratio(b, a)))
    return lines


def recorded(before: pl.DataFrame, after: pl.DataFrame) -> list[list[str]]:
    """Return the lines of recorded drives: RMSE over all blocks in degrees, and its ratio paired by block."""
    lines = []
    both = paired(before, after, ("case", "estimator", "block"))
    for (case, estimator), found in both.group_by("case", "estimator", maintain_order=True):
        a, n_a, b, n_b = (found[c].to_numpy().astype(np.float64) for c in _COLUMNS)
        ratio = pooled_ratio(b, a, n_b, n_a)
        lines.append(_line(f"{case}: {estimator}", pooled_rmse(a, n_a), pooled_rmse(b, n_b), ratio))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page; the exit code is 1 where a row is worse."""
    parser = options("paired", __doc__)
    parser.add_argument("--before", type=Path, default=ROOT / "studies" / "before")
    parser.add_argument("--estimators", default="pd-hef,pd-hef-smoothed")
    parser.add_argument("--out", type=Path, default=DOCS)
    given = parser.parse_args(arguments)
    of_row = (pl.col("signal") == SIDESLIP) & (pl.col("segment") == "all") & (pl.col("metric") == "rmse")
    now = pl.read_parquet(given.out / "conditions" / "metrics.parquet").filter(of_row)
    was = pl.read_parquet(given.before / "conditions.parquet")
    lines = [
        "# Before and now, in pairs",
        "",
        "Written by `python -m studies.paired`; every figure comes from the files that it names. Before: the physics",
        "was `physics-plus`, `pd-hef` the network on `phy-ukf`. Worse: all of the 95 % interval of the ratio above 1,",
        f"and the figure more than {100 * (WORSE_RATIO - 1):.0f} % and more than {WORSE_DEG:g}° higher.",
        "",
    ]
    found = []
    head = ["row", "before, deg", "now, deg", "ratio", "pairs", ""]
    for estimator in given.estimators.split(","):
        body = conditions(was, now, estimator)
        found += body
        lines += [f"## `{estimator}` on the condition table", "", table(head, body), ""]
    blocks = given.out / "real" / "blocks.parquet"
    if blocks.is_file():
        body = recorded(pl.read_parquet(given.before / "real_blocks.parquet"), pl.read_parquet(blocks))
        lines += ["## Recorded drives, by blocks of 10 s", "", table(head, body), ""]
    write(given.out / "paired.md", "\n".join(lines))
    return int(any(line[-1] == "**worse**" for line in found))


if __name__ == "__main__":
    sys.exit(main())
