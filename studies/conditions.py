"""The condition table (docs/method.md#evaluation): every estimator on the same drives with one error in each row.

    python -m studies.conditions [--car CAR] [--network FOLDER] [--drives 30] [--jobs 2] [--rows NAME,...] [--render]

Simulates the drives, runs all estimators by ``pdhef run``, and writes the page ``conditions.md`` with two figures to
``--out``, and all tables to ``--results``. ``--work`` keeps logs and runs: a repeated call resumes where it stopped.
``--render`` renders the page from ``--results``. Friction is the only input of an estimator from the ground truth, and
only with the factor of the row. The runs of the independent simulator are a row if ``../shared`` is beside the
repository.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from pdhef_logtool import PdhefError, __version__
from studies.conditions_page import write_page
from studies.gates.tool import Tool
from studies.pages import DOCS, INDEPENDENT, RESULTS, ROOT, options, write, write_toml
from truthsim.conditions import ROW_NAMES, ROWS, write_conditions

INDEPENDENT_ROW = "independent-simulator"
INDEPENDENT_MAPPING = Path(__file__).with_name("independent_sim.toml")
ESTIMATORS = (
    "zero", "kinematic", "open-loop", "linear-regression", "phy-ukf", "phy-ukf:tuned", "physics", "pure-lstm",
    "pd-hef-paper", "pd-hef:fixed-r", "pd-hef", "pd-hef-smoothed",
)  # fmt: skip
COLUMNS = ("row", "drive", "estimator", "signal", "segment", "metric", "value", "unit", "n")
KEPT_METRICS = ("rmse", "availability", "coverage95", "lag_s", "nees", "nis", "nis_dof")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = options("conditions", __doc__)
    parser.add_argument("--car", default="saloon")
    parser.add_argument("--network", type=Path, help="instead of the car's")
    parser.add_argument("--estimators", default=",".join(ESTIMATORS))
    parser.add_argument("--rows", default=",".join((*ROW_NAMES, INDEPENDENT_ROW)))
    parser.add_argument("--drives", type=int, default=30, help="drives a row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "conditions")
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS / "conditions")
    parser.add_argument("--render", action="store_true", help="render the page from the stored results")
    given = parser.parse_args(arguments)
    given.rows = given.rows.split(",")
    unknown = [r for r in given.rows if r not in (*ROW_NAMES, INDEPENDENT_ROW)]
    if unknown:
        parser.error(f"--rows: expected names out of {', '.join((*ROW_NAMES, INDEPENDENT_ROW))}, got {unknown}")
    return given


def row_logs(work: Path, row: str, drives: int, seed: int = 1, jobs: int = 1) -> tuple[list[Path], dict[str, Any]]:
    """Simulate the drives of a row; return their logs and the changed inputs of the estimators."""
    folder = work / f"drives-{seed}-{drives}-{row}"
    manifest = write_conditions(folder, drives=drives, seed=seed, rows=[row], processes=jobs)
    (entry,) = (e for e in manifest["rows"] if e["name"] == row)
    return [folder / file for file in entry["files"]], entry["assume"]


def row_inputs(tool: Tool, name: str, log: Path, assume: dict[str, Any]) -> list[str | Path]:
    """Return the options of a run with the mapping and the friction of a row."""
    mapping = tool.mapping(log)
    # The exact ground truth has the clock of the sensors.
    if assume.get("friction") != "unknown":
        friction = {"topic": "/truth/perfect/state", "field": "friction", "stamp": "header.stamp"}
        mapping["signals"]["friction"] = friction | {"scale": assume.get("friction_factor", 1.0)}
    file = write_toml(tool.work / "mappings" / f"condition-{name}.toml", mapping)
    return ["--mapping", file, *(["--set", f"sensors={assume['sensors']}"] if "sensors" in assume else [])]


def runs_of(tool: Tool, row: str, given: argparse.Namespace) -> Iterator[Path]:
    """Run the estimators on the drives of a row and yield the output folders."""
    network = [] if given.network is None else ["--network", given.network]
    common = ["--car", given.car, *network, "--estimators", given.estimators, "--keep", "metrics", "--jobs", given.jobs]
    if row != INDEPENDENT_ROW:
        logs, assume = row_logs(given.work, row, given.drives, given.seed, given.jobs)
        yield tool.run(f"{row}-{given.seed}-{given.drives}", *logs, *common, *row_inputs(tool, row, logs[0], assume))
        return
    for log in sorted(INDEPENDENT.glob("*.parquet")):
        friction = json.loads(log.with_suffix(".json").read_text(encoding="utf-8"))["mu"]
        given_files = ("--mapping", INDEPENDENT_MAPPING, "--friction", str(friction))
        yield tool.run(f"{row}-{log.stem}", log, *common, *given_files)


def run(given: argparse.Namespace) -> None:
    """Run all rows, and write results and page."""
    tool, frames = Tool(ROOT, given.work.resolve()), []
    for row in given.rows:
        print(row, file=sys.stderr)
        frames += [
            pl.read_parquet(folder / "metrics.parquet").rename({"log": "drive"}).with_columns(row=pl.lit(row))
            for folder in runs_of(tool, row, given)
        ]
    metrics = pl.concat(frames).select(COLUMNS).filter(pl.col("metric").is_in(KEPT_METRICS))
    metrics = metrics.filter(pl.col("segment").is_in(("all", "linear", "nonlinear")))
    network = "" if given.network is None else f" --network {given.network.name}"
    command = f"python -m studies.conditions --car {given.car}{network} --drives {given.drives} --seed {given.seed}"
    rows = {r.name: r.description for r in ROWS} | {INDEPENDENT_ROW: "runs of another simulator, true friction"}
    facts = {
        "command": command,
        "car": given.car,
        "version": __version__,
        "rows": rows,
        "order": given.estimators.split(","),
    }
    given.results.mkdir(parents=True, exist_ok=True)
    metrics.write_parquet(given.results / "metrics.parquet", compression="zstd", compression_level=19)
    write(given.results / "facts.json", json.dumps(facts, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the table; 1 with one line where an input is wrong."""
    given = parse(arguments)
    try:
        if not given.render:
            run(given)
        write_page(given.out, given.results)
    except (PdhefError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
