"""Recorded drives: identify and train on one part, score on another part (docs/method.md#evaluation).

    python -m studies.real [--network NETWORK] [--out docs] [--trials 64] [--cases 250lm,...]

Each case scores the published vehicle file, the same file calibrated on the scored part without ground truth (as
``pdhef run`` does), and, where there is a part to learn from, the car that ``pdhef learn`` identifies there, without
and with its other stages. RMSE has an interval by bootstrap of blocks. The drives are in ``../shared`` and may not be
redistributed. Without them, the command ends with 0 and writes nothing.

``studies/results/real/looks.json`` counts the evaluations of each scored part: repeated evaluation makes figures
optimistic.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import WholeDrive, read_drive
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.self_calibrated import OPEN_LOOP
from pdhef_logtool.estimators.table import SPECS, runnable
from pdhef_logtool.evaluation.bootstrap import block_sums
from pdhef_logtool.evaluation.comparison import Errors, compare, shown_interval
from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.learning.drives import IDENTIFY, STAGES, LearnSettings
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.estimating import calibrator
from pdhef_logtool.runs.self_calibrating import calibrate_drive, checked, self_calibrated
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.files import PendingFile, write_bytes
from studies.condition_drives import SIDESLIP
from studies.condition_runs import source_digest
from studies.pages import DOCS, DRIVES, RESULTS, ROOT, number, options, table, table_rows, write

REFERENCE = ROOT / "tests" / "reference"
#: Share of the fit part that the network learns from; the rest, behind a guard, stops its training.
TRAIN_SHARE, GUARD_S = 0.8, 5.0
#: Against which all others are judged, the first that ran.
YARDSTICKS = ("phy-ukf:tuned, identified", "phy-ukf, datasheet")


#: What needs no car; what needs no network; what may have one.
FREE = ("zero", "kinematic")
PHYSICAL = tuple(s.name for s in SPECS if not s.network and s.name not in (*FREE, "zero:no-lateral", OPEN_LOOP))
NETWORKS = tuple(s.name for s in SPECS if s.network)
#: Versions of this page, and of the published files on docs/calibration.md, before evaluations were counted.
LOOKS_BEFORE = 6
LOOKS_BEFORE_PUBLISHED = {"250lm": 9, "gti": 8, "tts": 8, "v40": 8}
LOOKS_FILE = "looks.json"
#: Columns of the page, with patterns of the names in the tables.
SUMMARY = {
    "zero": "zero",
    "open-loop, datasheet": "open-loop, datasheet",
    "phy-ukf, datasheet": "phy-ukf, datasheet",
    "physics, datasheet": "physics, datasheet",
    "physics, self-calibrated": "physics .*self-calibrated",
    "physics, identified": "physics, identified",
    "pd-hef, learn": "pd-hef( at gain limit .*)?, learn",
}
EVALUATED = "Number of evaluations on this part, at least:"
PAGE = """# Recorded drives

This page shows the sideslip error on recorded drives of real cars and a scale model. {command}

Sideslip RMSE in degrees with the 95 % CI of a bootstrap of 10 s blocks. *datasheet*: published vehicle file.
*self-calibrated*: calibrated on the scored part without ground truth, not causal. *identified*: stage `identify` of
`pdhef learn` on the training part. *learn*: all stages. A dash: not possible with the data of this drive.
*evaluations*: how often the scored part was evaluated during development, at least; many evaluations make the
figures optimistic.

{summary}

`studies/results/real/tables.md` contains all estimators, networks and 95 % intervals; `blocks.parquet` contains the
errors of each block. The drives may not be redistributed.
"""


def say(text: str) -> None:
    """Print progress."""
    print(text, file=sys.stderr)


@dataclass(frozen=True, slots=True)
class Part:
    """A slice of a log, in seconds from its start; None to its end."""

    log: str
    start_s: float = 0.0
    end_s: float | None = None

    @property
    def config(self) -> RunConfig:
        """The slice as a configuration."""
        end = None if self.end_s is None else f"{self.end_s:g}"
        return RunConfig(start=f"{self.start_s:g}", end=end)


@dataclass(frozen=True, slots=True)
class Case:
    """One table: where to fit (None: nothing is fitted) and where to score; sideslip above ``min_speed_m_s``."""

    name: str
    title: str
    score: Part
    mapping: str
    vehicle: str
    fit: Part | None = None
    min_speed_m_s: float = 3.0
    remark: str = ""


def load_cases() -> tuple[Case, ...]:
    """Return the cases of ``real.toml``."""
    cases = []
    for name, entry in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")).items():
        for key in {"score", "fit"} & entry.keys():
            entry[key] = Part(*entry[key])
        cases.append(Case(name=name, **entry))
    return tuple(cases)


CASES = load_cases()


def files(case: Case) -> tuple[Path, Path]:
    """Return the mapping file and the datasheet vehicle file of a case."""
    return REFERENCE / "mappings" / f"{case.mapping}.toml", REFERENCE / "vehicles" / f"{case.vehicle}.toml"


def read_part(part: Part, mapping_file: Path, car: Car) -> WholeDrive:
    """Read a slice as ``pdhef run`` does, with the car's offsets and biases taken off."""
    options = replace(part.config.read_options, friction=None)
    with read_drive(DRIVES / part.log, car, load_mapping(mapping_file), options) as drive:
        return drive.whole()


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """Errors of one line of a table, and the mean width of the 95 % interval over the RMSE (NaN: none)."""

    errors: Errors
    width: float = float("nan")


def scored(case: Case, label: str, car: Car, names: Sequence[str]) -> list[Row]:
    """Run estimators of a car on the scored part, with the intervals of ``pdhef run``."""
    part = read_part(case.score, files(case)[0], car)
    assert part.truth is not None
    ready, skipped = runnable(names, car, part.plan.alignment.available)
    for s in skipped:
        say(f"{case.name}: {s.name}, {label} is skipped: {s.reason}")
    rows = []
    for e in ready:
        say(f"{case.name}: {e.name}, {label}")
        track, _ = run_window(e, part.signals)
        track = calibrator(car, [e]).add(track, part.signals)
        error = signal_error(track, part.truth, SIDESLIP, case.min_speed_m_s)
        shown = e.name if e.causal else f"{e.name} (not causal)"
        if e.name in ("pd-hef", "pd-hef-smoothed"):
            shown += f" at gain limit {car.allowed_trust.cap:g}"
        half = NORMAL_95 * track.sideslip_std_rad
        finite = np.isfinite(error) & np.isfinite(half)
        inside = np.abs(error) <= half if finite.any() else None
        width = 2.0 * np.mean(half[finite]) / np.sqrt(np.mean(error[finite] ** 2)) if finite.any() else np.nan
        name = f"{shown}, {label}" if label else shown
        rows.append(Row(Errors(name, error, part.truth.stamps_ns, inside), float(width)))
    return rows


def run_case(case: Case, network: Path, trials: int) -> tuple[list[Row], list[str]]:
    """Fit what is to be fitted; return the rows of everything on the scored part, and remarks."""
    parts = [given_car(case, network), self_calibrated_car(case)]
    if case.fit is not None:
        parts += [identified_car(case), trained_car(case, network, trials)]
    return [row for rows, _ in parts for row in rows], [remark for _, remark in parts if remark]


def given_car(case: Case, network: Path) -> tuple[list[Row], str]:
    """Score the unchanged datasheet car."""
    datasheet = Car.load(files(case)[1], network=network)
    rows = scored(case, "", datasheet, FREE) + scored(case, "datasheet", datasheet, PHYSICAL)
    return rows + (scored(case, "datasheet, given network", datasheet, NETWORKS) if datasheet.network else []), ""


def self_calibrated_car(case: Case) -> tuple[list[Row], str]:
    """Score the datasheet car after the scored part has calibrated it, without ground truth."""
    mapping_file, vehicle_file = files(case)
    car, options = Car.load(vehicle_file), replace(case.score.config.read_options, friction=None)
    with read_drive(DRIVES / case.score.log, car, load_mapping(mapping_file), options) as drive:
        calibration = checked(drive, calibrate_drive(drive, RunConfig()))
        if calibration is None:
            return [], "The log lacks a sensor that self-calibration needs."
        if calibration.refused:
            return [], f"Self-calibration: {calibration.text}."
        rows = scored(case, "self-calibrated", self_calibrated(drive, calibration), (OPEN_LOOP, "physics"))
    return rows, f"Self-calibration: {calibration.text}."


def trained_car(case: Case, network: Path, trials: int) -> tuple[list[Row], str]:
    """Score the car that ``pdhef learn`` makes of the datasheet car on the training part."""
    assert case.fit is not None
    mapping_file, vehicle_file = files(case)
    given = None if str(network) == NO_MODEL else network
    config = replace(case.fit.config, mapping=mapping_file, car=vehicle_file, network=given)
    # The scored part is the test split: the training part has none of its own.
    settings = LearnSettings(config=config, stages=STAGES, trials=trials, holdout=0.0)
    with tempfile.TemporaryDirectory() as name:
        car = Path(name) / "car"
        say(f"{case.name}: learn")
        try:
            learned = learn([str(DRIVES / case.fit.log)], car, settings, reporter=Reporter(warn=say))
        except PdhefError as error:
            return [], f"The car could not be trained: expected {error.expected}, got {error.got}."
        rows = scored(case, "learn", Car.load(car), ("physics", "pd-hef", "pd-hef-smoothed"))
    return rows, f"learn: {', '.join(f'{s.name} {s.status}' for s in learned.stages)}."


def identified_car(case: Case) -> tuple[list[Row], str]:
    """Score the car that is identified on the training part, without a network."""
    assert case.fit is not None
    mapping_file, vehicle_file = files(case)
    config = replace(case.fit.config, mapping=mapping_file, car=vehicle_file)
    with tempfile.TemporaryDirectory() as name:
        car = Path(name) / "identified"
        say(f"{case.name}: identification")
        try:
            learn([str(DRIVES / case.fit.log)], car, LearnSettings(config=config, stages=(IDENTIFY,), holdout=0.0))
        except PdhefError as error:
            return [], f"The car could not be identified: expected {error.expected}, got {error.got}."
        return scored(case, "identified", Car.load(car, network=NO_MODEL), PHYSICAL), ""


def blocks(case: Case, results: Sequence[Row]) -> list[tuple[str, str, int, int, float]]:
    """Return case, estimator, block, stamps and RMSE in degrees of each block, for comparisons in pairs."""
    rows = []
    for r in (row.errors for row in results):
        (sums,), counts, block_ids = block_sums([r.error], r.stamps_ns)
        rmse = np.degrees(np.sqrt(sums / counts))
        rows += [
            (case.name, r.name, *row) for row in zip(block_ids.tolist(), counts.tolist(), rmse.tolist(), strict=True)
        ]
    return rows


def case_table(results: Sequence[Row]) -> str:
    """Return a case's table: RMSE, how much was scored, the difference to the yardstick, and the 95 % intervals."""
    errors, widths = [r.errors for r in results], {r.errors.name: r.width for r in results}
    yard = next((n for n in YARDSTICKS if n in widths), None)
    body = []
    for line in compare(errors, yard):
        versus = "–" if line.difference is None else shown_interval(line.difference, "+")
        covered = "–" if line.covered is None else f"{100 * line.covered:.0f} %"
        cells = [shown_interval(line.rmse), f"{100 * line.share:.0f} %", versus, covered, number(widths[line.name], 1)]
        body.append([line.name, *cells])
    head = ["estimator", "sideslip RMSE, deg", "of the stamps", f"minus that of {yard or '–'}, deg"]
    return table([*head, "inside 95 %", "width / RMSE"], body)


def count_look(file: Path, case: Case, basis: str) -> int:
    """Count a look at a scored part, unless it is the same that was counted last, and return how many there were."""
    looks = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    entry = looks.get(case.name, {"looks": LOOKS_BEFORE + LOOKS_BEFORE_PUBLISHED.get(case.name, 0), "basis": ""})
    if entry["basis"] != basis:
        entry = {"looks": entry["looks"] + 1, "basis": basis}
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, (json.dumps({**looks, case.name: entry}, indent=1, sort_keys=True) + "\n").encode())
    return int(entry["looks"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases and write the page."""
    parser = options("real", __doc__)
    parser.add_argument("--network", type=Path, default=Path(NO_MODEL), help="a folder, or a shipped one's name")
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--cases", default=",".join(c.name for c in CASES))
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS / "real")
    given = parser.parse_args(arguments)
    if not DRIVES.is_dir():
        print("needs ../shared beside the repository (recorded drives that may not be redistributed); nothing is done")
        return 0
    wanted, case_names = given.cases.split(","), [c.name for c in CASES]
    if set(wanted) - set(case_names):
        parser.error(f"--cases: expected names out of {', '.join(case_names)}, got {given.cases}")

    network = Car.load(network=given.network).network
    used = "none" if network is None else f"sha256 {network.sha256[:12]}"
    command = "python -m studies.real" + ("" if network is None else f" --network {given.network.name}")
    lines = [
        "# Tables of the recorded drives",
        "",
        f"Command: `{command} --trials {given.trials}`. Given network: {used}.",
        "",
    ]
    stored: list[tuple[str, str, int, int, float]] = []
    source = source_digest()
    for case in (c for c in CASES if c.name in wanted):
        lines += [f"## {case.title}", "", f"Scored above {case.min_speed_m_s:g} m/s. {case.remark}", ""]
        basis = digest([case.name, repr(case), used, given.trials, source])
        results, remarks = run_case(case, given.network, given.trials)
        looks = count_look(given.results / LOOKS_FILE, case, basis)
        remarks.append(f"{EVALUATED} {looks}.")
        lines += [case_table(results), "", *(line for remark in remarks for line in (remark, ""))]
        stored += blocks(case, results)
    columns = ("case", "estimator", "block", "stamps", "sideslip_rmse_deg")
    with PendingFile(given.results / "blocks.parquet") as pending:
        pl.DataFrame(stored, schema=columns, orient="row").write_parquet(pending.path, compression="zstd")
    tables = "\n".join(lines)
    write(given.results / "tables.md", tables)
    write(given.out / "real.md", page(tables))
    return 0


def page(tables: str) -> str:
    """Return the page: command, one summary table, and where the tables are."""
    rows, body = table_rows(tables), []
    counts = re.findall(rf"{EVALUATED} (\d+)\.", tables)
    for (title, lines), count in zip(rows.items(), counts, strict=True):
        errors = {line[0]: line[1].replace(" [", "<br>[") for line in lines}
        cells = [next((e for n, e in errors.items() if re.fullmatch(pattern, n)), "–") for pattern in SUMMARY.values()]
        body.append([title, *cells, count])
    head = ["drive", *SUMMARY, "evaluations"]
    return PAGE.format(command=tables.splitlines()[2], summary=table(head, body))


if __name__ == "__main__":
    sys.exit(main())
