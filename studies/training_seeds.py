"""docs/training_seeds.md: how far the condition table hangs on the seed that a network was trained with.

    python -m studies.training_seeds OUT [OUT ...]

Each OUT is what ``python -m studies.conditions --car CAR --estimators physics,pd-hef --out OUT`` wrote for the car of
another seed (``python -m studies.defaults.train_default --seed N -o CAR``), on the drives of docs/conditions.md, which
is seed 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from studies.pages import DOCS, options, table, write

HYBRID, PHYSICS = "pd-hef", "physics"


def medians(out: Path, estimator: str) -> dict[str, float]:
    """Return the median sideslip RMSE over the drives of each row, in degrees."""
    figures = pl.read_parquet(out / "conditions" / "metrics.parquet").filter(
        pl.col("estimator") == estimator,
        pl.col("signal") == "sideslip_rad",
        pl.col("segment") == "all",
        pl.col("metric") == "rmse",
    )
    rows = figures.group_by("row", maintain_order=True).agg(pl.col("value").median())
    return dict(zip(rows["row"], np.degrees(rows["value"].to_numpy()).tolist(), strict=True))


def main() -> None:
    """Write the page."""
    parser = options("training_seeds", __doc__)
    parser.add_argument("outs", nargs="+", type=Path, metavar="OUT", help="condition tables of further seeds, in order")
    given = parser.parse_args()
    physics = medians(DOCS, PHYSICS)
    seeds = [medians(out, HYBRID) for out in (DOCS, *given.outs)]
    body, spreads = [], []
    for row, value in physics.items():
        found = [s[row] for s in seeds]
        spreads.append(max(found) / min(found) - 1.0)
        body.append([row, f"{value:.3f}", *(f"{f:.3f}" for f in found), f"{100.0 * spreads[-1]:.0f} %"])
    head = ["row", f"`{PHYSICS}`", *(f"`{HYBRID}`, seed {i}" for i in range(len(seeds))), "apart"]
    write(
        DOCS / "training_seeds.md",
        f"""# Training seeds

Written by `python -m studies.training_seeds`. The shipped network is of seed 0; the others are of the same drives and
recipe with other weights, order and dropout, each with the trust that its own evidence gave. Sideslip RMSE in degrees,
medians over the drives of [conditions.md](conditions.md); *apart*: the largest over the smallest, less one. The largest
of these is {100.0 * max(spreads):.0f} %, their median {100.0 * float(np.median(spreads)):.0f} %.

{table(head, body)}
""",
    )


if __name__ == "__main__":
    main()
