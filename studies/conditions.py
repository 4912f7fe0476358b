"""The condition table (docs/method.md#evaluation): every estimator on the same drives with one error in each row.

    python -m studies.conditions [--car CAR] [--network FOLDER] [--drives 30] [--jobs 2] [--rows NAME,...] [--render]

Simulates the drives, runs all estimators that can run, and writes the page
``conditions.md`` with two figures to ``--out``, and all tables to ``--results``. ``--work`` keeps logs and rows: a
repeated call computes the rows whose drives, car, network, settings or sources have changed. ``--render`` renders the
page from ``--results``. The runs of the independent simulator are a row if ``../shared`` is beside the repository.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path

from pdhef_logtool.estimators.table import SPECS, check_names
from pdhef_logtool.records.errors import PdhefError
from studies.condition_drives import independent_runs
from studies.condition_runs import Setup, Task, as_frame, progress, run_rows
from studies.conditions_page import Facts, write_page, write_results
from studies.pages import DOCS, RESULTS, ROOT, options
from truthsim.conditions import ROW_NAMES, ROWS, write_conditions

INDEPENDENT_ROW = "independent-simulator"
#: The estimator of interest, and the references of its RMSE ratios.
SUBJECT = "pd-hef"
REFERENCES = ("physics", "phy-ukf", "pd-hef-paper")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = options("conditions", __doc__)
    parser.add_argument("--car", type=Path, default=Path("saloon"), help="default: the shipped one")
    parser.add_argument("--network", type=Path, help="instead of the car's; none: no hybrid filter runs")
    parser.add_argument("--estimators", default=",".join(s.name for s in SPECS), help="names, default all")
    parser.add_argument("--rows", default=",".join((*ROW_NAMES, INDEPENDENT_ROW)))
    parser.add_argument("--drives", type=int, default=30, help="drives a row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "conditions")
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS / "conditions")
    parser.add_argument("--render", action="store_true", help="render the page from the stored results")
    given = parser.parse_args(arguments)
    given.estimators = tuple(given.estimators.split(","))
    given.rows = given.rows.split(",")
    check_names(given.estimators)
    unknown = [r for r in given.rows if r not in (*ROW_NAMES, INDEPENDENT_ROW)]
    if unknown:
        parser.error(f"--rows: expected names out of {', '.join((*ROW_NAMES, INDEPENDENT_ROW))}, got {unknown}")
    return given


def simulated(given: argparse.Namespace, drives: int, seed: int) -> dict[str, list[Task]]:
    """Simulate the rows asked for and return their drives as tasks."""
    rows = [r for r in given.rows if r != INDEPENDENT_ROW]
    if not rows:
        return {}
    # A manifest contains the requested rows: one of some rows must not take the place of that of all.
    part = "" if set(rows) == set(ROW_NAMES) else "-" + hashlib.sha256(",".join(rows).encode()).hexdigest()[:8]
    folder = given.work / f"drives-{seed}-{drives}{part}"
    manifest = write_conditions(folder, drives=drives, seed=seed, rows=rows, processes=given.jobs)
    progress(f"simulated (seed {seed}): {len(manifest['drives'])} drives")
    entries = {e["file"]: e for e in manifest["drives"]}
    return {
        row["name"]: [Task(row["name"], folder / file, entries[file]["sha256"], row["assume"]) for file in row["files"]]
        for row in manifest["rows"]
    }


def independent(work: Path) -> list[Task]:
    """Return the independent simulator's runs as tasks, converted to logs; none where they are not there."""
    folder = work / INDEPENDENT_ROW
    folder.mkdir(parents=True, exist_ok=True)
    return [
        Task(INDEPENDENT_ROW, log, hashlib.sha256(source.read_bytes()).hexdigest(), {}, friction=friction)
        for source, log, friction in independent_runs(folder)
    ]


def run(given: argparse.Namespace) -> None:
    """Do everything."""
    setup = Setup(given.car, given.network, given.estimators)
    tasks = simulated(given, given.drives, given.seed)
    absent = ""
    if INDEPENDENT_ROW in given.rows:
        tasks[INDEPENDENT_ROW] = independent(given.work)
        if not tasks[INDEPENDENT_ROW]:
            absent = f"{INDEPENDENT_ROW} is left out: it needs ../shared beside the repository"
            progress(absent)
    scored = run_rows(setup, tasks, given.work / "rows", jobs=given.jobs, title="estimators")
    if not scored:
        raise SystemExit("no drives to score")
    metrics = as_frame(scored)
    ran = set(metrics["estimator"].unique())
    facts = Facts(
        command=_command(given),
        car=setup.loaded.vehicle.name,
        setup=setup.identity,
        rows={r.name: r.description for r in ROWS} | {INDEPENDENT_ROW: "runs of another simulator, true friction"},
        subject=SUBJECT if SUBJECT in ran else None,
        references=REFERENCES,
        order=given.estimators,
        notes=tuple(dict.fromkeys([*([absent] if absent else []), *(n for r in scored.values() for n in r.notes)])),
    )
    write_results(given.results, facts, metrics)
    write_page(given.out, given.results)


def _command(given: argparse.Namespace) -> str:
    """Return the command line that makes the page again; files by name only."""
    network = "" if given.network is None else f" --network {given.network.name}"
    return f"python -m studies.conditions --car {given.car.name}{network} --drives {given.drives} --seed {given.seed}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the table; 1 with one line where an input is wrong."""
    try:
        given = parse(arguments)
        if given.render:
            write_page(given.out, given.results)
        else:
            run(given)
    except PdhefError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
