"""Choose the process noise of the filters that have the network's residual (docs/method.md#residual-noise).

    python -m studies.defaults.residual_noise [-o FOLDER] [--work out/residual-noise] [--jobs 2]

On drives of all rows of the condition table, with a seed that no page reports: of all pairs of a factor on the noise of
``physics`` and a growth beyond the linear range, the one with the lowest error in the paper's scenarios, if it raises
the error in no row by more than 5 %. An error is the geometric mean of the sideslip RMSE of ``pd-hef`` over the drives.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import FIT_FILE, SHIPPED_CARS, Car, read_fit
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import Options, spec_of
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping.mapping_file import load_mapping
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.conditions import row_inputs, row_logs
from studies.defaults.fit_physics import HEAD
from studies.defaults.noise import error_rad
from studies.gates.tool import Tool
from studies.pages import ROOT, options
from truthsim.conditions import ROW_NAMES

SEED, DRIVES = 7, 10
ESTIMATOR = "pd-hef"
PAPER_ROWS, MOST_WORSE = ("paper-a", "paper-b"), 1.05
#: Factors on the process noise of ``physics``, and growths beyond the linear range; the first pair is its own noise.
PAIRS = ((1.0, 0.0), *product((0.6, 0.5, 0.45, 0.4, 0.35), (3.0, 4.0, 5.0)))


def read_row(car: Car, row: str, work: Path, jobs: int) -> Iterator[tuple[Signals, StateTrack]]:
    """Yield corrected signals and ground truth of the drives of a row."""
    logs, assume = row_logs(work, row, DRIVES, SEED, jobs)
    _, mapping, *_ = row_inputs(Tool(ROOT, work), f"{row}-{SEED}", logs[0], assume)
    for log in logs:
        with read_drive(LogInput(log, log.stem), car, load_mapping(mapping)) as drive:
            whole = drive.whole()
            assert whole.truth is not None
            yield DriveModel.fit(drive).apply(whole.signals).of_estimator(ESTIMATOR), whole.truth


def errors(car: Car, drives: list[tuple[Signals, StateTrack]]) -> list[float]:
    """Return the error on a row with each pair, in rad."""
    slow, found = car.vehicle.low_speed_blend_m_s, []
    for pair in PAIRS:
        assert car.fitted_physics is not None
        quieter = replace(car, fitted_physics=car.fitted_physics.model_copy(update={"beside_residual": pair}))
        estimator = spec_of(ESTIMATOR).make(quieter, Options())
        rmse = [error_rad(run_estimator(estimator, signals), truth, slow) for signals, truth in drives]
        found.append(math.exp(float(np.mean(np.log(rmse)))))
    return found


def main(arguments: list[str] | None = None) -> int:
    """Choose and write the pair of a car."""
    parser = options("defaults.residual_noise", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=SHIPPED_CARS["saloon"], help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/residual-noise"), help="logs; kept")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args(arguments)
    car, ratios = Car.load(given.output), {}
    for row in ROW_NAMES:
        of_row = errors(car, list(read_row(car, row, given.work, given.jobs)))
        ratios[row] = np.array(of_row) / of_row[0]
        print(f"{row}: {math.degrees(of_row[0]):.4f}°, " + " ".join(f"{r:.3f}" for r in ratios[row][1:]), flush=True)
    allowed = np.max(list(ratios.values()), axis=0) <= MOST_WORSE
    best = int(np.argmin(np.where(allowed, np.prod([ratios[row] for row in PAPER_ROWS], axis=0), np.inf)))
    of_all = np.exp(np.mean([np.log(r[best]) for r in ratios.values()]))
    print(
        f"factor and growth {PAIRS[best]}: {of_all:.3f} of the error with the noise of physics, in the geometric mean"
    )
    fit = read_fit(given.output / FIT_FILE)
    assert fit.physics is not None
    fit = fit.model_copy(update={"physics": fit.physics.model_copy(update={"beside_residual": PAIRS[best]})})
    (given.output / FIT_FILE).write_text(part_toml(fit, HEAD), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
