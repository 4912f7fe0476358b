"""Teaching on recorded drives: taught on one drive with ground truth, scored on another one of the same car.

    python -m studies.teaching [--cars GTI,...] [--out docs] [--stored]

Each drive calibrates its car on its own sensors, without ground truth. Columns: ``physics`` of the untaught car, of the
taught car, and ``pd-hef`` of the taught car with its residual, also of a car that the sideslip reference taught, where
it is independent, in place of ground truth. The drives are in ``../shared`` and may not be
redistributed. Without them, the command ends with 0 and writes nothing. Simulated cars have a file with a stiffness
error of a factor 0.5 to 2 at each axle; a drive with a simulated RTK teaches, and the exact sideslip scores.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Literal

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.taught import Taught
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.calibration.calibration import self_calibrate
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.reference.drive import refer
from pdhef_logtool.estimators.reference.estimator import ReferenceEstimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.learning.car.taught_prior import taught_driving
from pdhef_logtool.learning.stages.teach import LEAST_S, OpenedDrive, learn_from, open_drive
from pdhef_logtool.learning.truth import independent
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.residual_model.bundle import open_model
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.estimating import calibrator
from pdhef_logtool.runs.referencing import prior_of
from pdhef_logtool.runs.self_calibrating import driven_d2, self_calibrated
from pdhef_logtool.storage.files import write_bytes
from studies.pages import DOCS, DRIVES, RESULTS, number, options, table, write
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, vehicle_of
from studies.reference import MADE, RECEIVERS, ScoredDrive, with_gnss
from studies.self_calibration import simulated_drives
from truthsim.drive import write_drive

RESULTS_FILE = RESULTS / "teaching.json"
#: No pair may be worse than untaught by more than the larger of this share and this many degrees.
WORSE_SHARE, WORSE_DEG = 0.05, 0.03
#: Intervals run six filters, and longer drives have none here.
MOST_STAMPS = 20_000
#: Driving counts as alike where the residual is active on so much of it.
ALIKE = 0.5
#: The paper's network, trained in simulation, in the sigma points of the paper's filter.
PAPER = "pd-hef-paper"


@dataclass(frozen=True, slots=True)
class TeachPart:
    """A slice of a log, in seconds from its start; ``steering_gain`` makes a road-wheel angle of its channel."""

    log: str
    start: str | None = None
    end: str | None = None
    steering_gain: float = 1.0

    @property
    def name(self) -> str:
        """Log and slice."""
        span = "" if self.start is None and self.end is None else f" {self.start or '0'} to {self.end or 'end'} s"
        return f"{self.log.partition('.')[0]}{span}"


@dataclass(frozen=True, slots=True)
class TeachCar:
    """A car: its parts; pairs of them, in which one or several teach; the drive whose vehicle file all have."""

    name: str
    parts: tuple[TeachPart, ...]
    taught_on: int = 1


_F1TENTH = sorted(p.log for p in PEER_DRIVES if p.car == "1:10 F1TENTH")
CARS = (
    TeachCar("250 LM", (TeachPart("revs_250lm_a.mcap", None, "150"), TeachPart("revs_250lm_a.mcap", "150"))),
    TeachCar("GTI", (
        TeachPart("gti_pole_aa.mcap"), TeachPart("gti_low_speed.mcap"), TeachPart("niki_gti_1khz.mcap", None, "50"),
        TeachPart("stanford_wet_1.mcap", steering_gain=1.0 / 13.9),
    )),
    TeachCar("V40", (TeachPart("v40_slalom.mcap"), TeachPart("v40_swd_gnss.mcap"))),
    TeachCar("TT-S", (TeachPart("tts_kk.mcap", None, "62"), TeachPart("tts_kk.mcap", "62"))),
    TeachCar("Polaris", (TeachPart("polaris_a.mcap"), TeachPart("polaris_b.mcap"))),
    TeachCar("1:10 DART", (TeachPart("dart_circles_fast.mcap"), TeachPart("dart_steer_rate.mcap"))),
    TeachCar("1:10 F1TENTH", tuple(map(TeachPart, _F1TENTH)), taught_on=5),
)  # fmt: skip
SIMULATED = "simulated"
#: Manoeuvre, km/h, seconds of the drives of a simulated car; seeds of the cars, and cars of each seed. The settings
#: were chosen on the first seed.
SIMULATED_DRIVES = (
    ("road", 90.0, 120.0), ("sine-sweep", 90.0, 30.0), ("dlc", 80.0, 26.0), ("fishhook", 70.0, 24.0),
    ("sine-with-dwell", 80.0, 24.0),
)  # fmt: skip
SEEDS, CARS_PER_SEED, LEAST_SPEED_M_S = (29, 31), 4, 3.0

PAGE = """# Teaching on recorded drives

This page shows what a car that was taught on one drive with ground truth is worth on another drive of the same car.
Command: `python -m studies.teaching`.

Sideslip RMSE in degrees; in brackets without the constant of each drive, which may be an offset of the ground truth.
Each drive calibrates its car on its own sensors, not causal. *untaught* and *taught*: `physics` without and with the
prior from the teaching drive. *pd-hef*: with the residual as well. *active*: share of the scored stamps at which the
residual acts. *paper*: `pd-hef-paper`, the ST-ResNet of the simulated saloon in the sigma points, on the vehicle file;
it is not taught. *95 %*: coverage of the confidence intervals of untaught `physics` and of `pd-hef`.
*reference*: the ratio if the [sideslip reference](reference.md) teaches (below).

These are development figures: the settings were chosen on these pairs and on the simulated cars of seed {seed}; one
variant was also seen on the second seed.

{pairs}

{summary}

Simulated cars with wrong files, each taught on the drive of a row: geometric mean of the ratio (largest ratio; pairs
worse by more than max(5 %, 0.03°)).

{simulated}

## Taught by the reference
With `--set reference=on`, `learn` takes the [sideslip reference](reference.md) of drives without ground truth, weighted
by its standard deviation, where GNSS makes it independent of the other sensors. Pairs with at least {least_s:.0f} s of
that are in the table above, others have –. GNSS of the V40 is recorded, that of the others is made from ground truth
(Doppler 10 Hz). The default is off: it is not validated with a recorded receiver. The simulated drives are too short.
"""


@dataclass(frozen=True, slots=True)
class Score:
    """RMSE in degrees, also without the constant; shares with an active residual and inside 95 % intervals."""

    rmse_deg: float
    without_constant_deg: float
    active: float
    covered: float | None


@dataclass(frozen=True, slots=True)
class PairResult:
    """A pair: taught on ``taught``, scored on ``scored``."""

    car: str
    taught: str
    scored: str
    untaught: Score
    prior: Score
    hybrid: Score
    kinematic_deg: float
    paper_deg: float
    rung: str
    reference: Score | None = None

    @property
    def worse(self) -> bool:
        """Whether teaching costs more than it may."""
        limit = max((1.0 + WORSE_SHARE) * self.untaught.rmse_deg, self.untaught.rmse_deg + WORSE_DEG)
        return self.hybrid.rmse_deg > limit

    @property
    def ratio(self) -> float:
        """RMSE of ``pd-hef`` of the taught car over that of untaught ``physics``."""
        return self.hybrid.rmse_deg / self.untaught.rmse_deg

    @property
    def referred(self) -> PairResult | None:
        """The same if the reference teaches, None if it cannot."""
        return None if self.reference is None else replace(self, hybrid=self.reference)


def peer_of(part: TeachPart) -> PeerDrive:
    """Return the recorded drive of a part."""
    return next(p for p in PEER_DRIVES if p.log == part.log)


def opened(part: TeachPart, car: Car) -> OpenedDrive:
    """Read a part for a car."""
    mapping = mapping_of(peer_of(part))
    if part.steering_gain != 1.0:
        wheel = mapping.signals["steering_wheel_rad"]
        assert isinstance(wheel.scale, float)
        angle = replace(wheel, name="steer_rad", scale=wheel.scale * part.steering_gain)
        others = {k: v for k, v in mapping.signals.items() if k != "steering_wheel_rad"}
        mapping = Mapping({**others, "steer_rad": angle}, mapping.truth)
    config = RunConfig(start=part.start, end=part.end)
    with read_drive(DRIVES / part.log, car, mapping, config.read_options) as drive:
        record, found = open_drive(drive, config)
    if found is None:
        raise SystemExit(f"{part.name}: {record.left_out}")
    return found


def by_reference(drive: OpenedDrive, received: Signals | None = None) -> OpenedDrive:
    """Return a drive that the reference teaches, of signals with a receiver, else with GNSS made from ground truth."""
    truth, car = drive.truth, drive.drive.car
    prior = prior_of(car, self_calibrate([drive.taught.driving], car.vehicle))
    heading = np.cumsum(np.nan_to_num(truth.yaw_rate_rad_s) * np.gradient(truth.stamps_ns * 1e-9))
    made = ScoredDrive(drive.whole.signals, prior, truth.vx_m_s, truth.vy_m_s, heading, np.zeros(len(truth)))
    span = refer(with_gnss(made, RECEIVERS[MADE]) if received is None else received, prior)
    track = independent(ReferenceEstimator(() if span.refused else (span,)).at(truth.stamps_ns))
    return replace(drive, whole=replace(drive.whole, truth=track), taught=taught_driving(drive.taught.driving, track))


def received(part: TeachPart, car: Car) -> Signals | None:
    """Return the signals of a part with those of its receiver, None if it has none."""
    if not part.log.startswith("v40_"):
        return None
    with read_drive(DRIVES / part.log, car, mapping_of(peer_of(part), receiver=True), ReadOptions()) as drive:
        return drive.whole().signals


def score(
    drive: OpenedDrive, car: Car, name: str, taught: Taught | None, least_speed_m_s: float, most_stamps: int = 0
) -> Score:
    """Calibrate a car on a drive and score an estimator, with its intervals up to ``most_stamps``."""
    prior = () if taught is None else taught.parameters
    calibration = self_calibrate([drive.taught.driving], car.vehicle, taught=prior)
    wanted = len(drive.whole.signals) <= most_stamps
    bare = replace(calibration, varied=())
    if wanted:
        d2_m_s = driven_d2([drive.whole.signals], self_calibrated(drive.drive, bare), calibration)
        calibration = replace(calibration, driven_d2_m_s=d2_m_s)
    calibrated = replace(self_calibrated(drive.drive, calibration if wanted else bare), taught=taught)
    estimator = make_estimator(name, replace(calibrated, network=car.network))
    track, _ = run_window(estimator, drive.whole.signals)
    track = calibrator(calibrated, [estimator]).add(track, drive.whole.signals)
    error = signal_error(track, drive.truth, "sideslip_rad", least_speed_m_s)
    kept = np.isfinite(error)
    degrees = np.degrees(error[kept])
    covered = float(np.mean(np.abs(error[kept]) <= NORMAL_95 * track.sideslip_std_rad[kept])) if wanted else None
    active = float(np.mean(track.network_trust[kept] > 0.0))
    return Score(float(np.sqrt(np.mean(degrees**2))), float(np.std(degrees)), active, covered)


def pairs_of(car: TeachCar) -> Iterator[PairResult]:
    """Yield the results of a car's pairs."""
    of_file = Car.of(vehicle_of(peer_of(car.parts[0])))
    drives = [opened(part, of_file) for part in car.parts]
    choices: list[tuple[tuple[int, ...], int]] = [((a,), b) for a, b in permutations(range(len(drives)), 2)]
    if car.taught_on > 1:
        choices = [(tuple(range(car.taught_on)), k) for k in range(car.taught_on, len(drives))]
    names, least = [part.name for part in car.parts], peer_of(car.parts[0]).least_speed_m_s
    references = [by_reference(d, received(part, of_file)) for d, part in zip(drives, car.parts, strict=True)]
    yield from taught_pairs(car.name, of_file, names, (drives, references, drives), choices, least, MOST_STAMPS)


def taught_pairs(
    car_name: str, car: Car, names: Sequence[str], drives: tuple[Sequence[OpenedDrive], ...],
    choices: Sequence[tuple[tuple[int, ...], int]], least: float, most_stamps: int = 0,
) -> Iterator[PairResult]:  # fmt: skip
    """Yield the results of pairs; ``drives`` : that ground truth and reference (or none) teach, and that score."""
    *teaching, scored = drives
    untaught = [score(d, car, "physics", None, least, most_stamps) for d in scored]
    paper = replace(car, network=open_model(None))
    kinematic = [score(d, car, "kinematic", None, least).rmse_deg for d in scored]
    of_paper = [score(d, paper, PAPER, None, least).rmse_deg for d in scored]
    learned: dict[tuple[int, ...], tuple[Taught, Taught | None]] = {}
    for teachers, k in choices:
        if teachers not in learned:
            by_truth, referred = ([d[i] for i in teachers if d] for d in teaching)
            enough = sum(d.seconds for d in referred) >= LEAST_S
            learned[teachers] = learn_from(by_truth).part(car), learn_from(referred).part(car) if enough else None
        taught, of_reference = learned[teachers]
        reference = None if of_reference is None else score(scored[k], car, "pd-hef", of_reference, least)
        prior, hybrid = (score(scored[k], car, n, taught, least, most_stamps) for n in ("physics", "pd-hef"))
        taught_on = ", ".join(names[i] for i in teachers) if len(teachers) == 1 else f"{len(teachers)} runs"
        rung = "none" if taught.residual is None else taught.residual.rung
        others = (kinematic[k], of_paper[k], rung, reference)
        yield PairResult(car_name, taught_on, names[k], untaught[k], prior, hybrid, *others)


def simulated_pairs(seed: int) -> Iterator[PairResult]:
    """Yield the results of the pairs of simulated cars."""
    driven = list(simulated_drives(CARS_PER_SEED, seed, SIMULATED_DRIVES))
    for index in range(CARS_PER_SEED):
        of_car = [(simulated, drive) for simulated, drive, _ in driven if simulated.car == index]
        car = Car.of(of_car[0][0].file.with_stiffness(*of_car[0][0].factors))
        drives: dict[Literal["rtk", "perfect"], list[OpenedDrive]] = {"rtk": [], "perfect": []}
        with tempfile.TemporaryDirectory() as folder:
            for simulated, drive in of_car:
                path = Path(folder) / f"{simulated.manoeuvre}.mcap"
                write_drive(drive, path)
                for source, found in drives.items():
                    with read_drive(path, car, options=ReadOptions(friction=None, prefer_truth=source)) as read:
                        drive_opened = open_drive(read, RunConfig())[1]
                    assert drive_opened is not None
                    found.append(drive_opened)
        names = [simulated.manoeuvre for simulated, _ in of_car]
        choices = [((a,), b) for a, b in permutations(range(len(names)), 2)]
        both = (drives["rtk"], (), drives["perfect"])
        yield from taught_pairs(f"{SIMULATED} {seed}-{index}", car, names, both, choices, LEAST_SPEED_M_S)


def simulated_table(results: Sequence[PairResult]) -> str:
    """Return a table of the simulated pairs by seed and the manoeuvre that teaches."""
    names = [name for name, _, _ in SIMULATED_DRIVES]

    def cell(ratios: Sequence[float], more: str = "") -> str:
        return f"{geometric_mean(ratios)} ({max(ratios):.2f}{more})" if ratios else "–"

    body = []
    for seed in SEEDS:
        of = {s: [r for r in results if r.car.startswith(f"{SIMULATED} {seed}-") and r.scored == s] for s in names}
        for taught in names:
            pairs = [[r for r in of[s] if r.taught == taught] for s in names]
            cells = [cell([r.ratio for r in p], f"; {sum(r.worse for r in p)}") for p in pairs]
            body.append([str(seed), taught, *cells])
        of_paper = [cell([r.paper_deg / r.untaught.rmse_deg for r in of[s]]) for s in names]
        body.append([str(seed), "(paper's network)", *of_paper])
    return table(["seed", "taught on", *names], body, right_from=2)


def pair_table(results: Sequence[PairResult]) -> str:
    """Return one line per pair."""

    def cell(s: Score) -> str:
        return f"{s.rmse_deg:.3f} ({s.without_constant_deg:.3f})"

    body = [[
            r.car, r.taught, r.scored, cell(r.untaught), cell(r.prior), cell(r.hybrid),
            number(r.ratio, 2) + (" worse" if r.worse else ""), geometric_mean([p.ratio] if (p := r.referred) else []),
            number(r.paper_deg, 3), r.rung, f"{r.hybrid.active:.0%}",
            " / ".join("–" if s.covered is None else f"{s.covered:.0%}" for s in (r.untaught, r.hybrid)),
        ] for r in results]  # fmt: skip
    head = "car, taught on, scored on, untaught, taught, pd-hef, ratio, reference, paper, residual, active, 95 %"
    return table(head.split(", "), body, right_from=3)


def summary(results: Sequence[PairResult]) -> str:
    """Return the figures that the targets are about."""

    def mean(ratios: Sequence[float]) -> str:
        return f"{geometric_mean(ratios)} ({len(ratios)} pairs)" if ratios else "–"

    alike = [r for r in results if r.hybrid.active >= ALIKE]
    unlike = [r for r in results if r.hybrid.active < ALIKE]
    small = [r for r in results if r.car == "1:10 F1TENTH"]
    pairs = [(r, p) for r in results if (p := r.referred) is not None]
    lines = [
        ["pairs worse than untaught by more than max(5 %, 0.03°)", str(sum(r.worse for r in results))],
        ["geometric mean of the ratios, residual active on at least 50 %", mean([r.ratio for r in alike])],
        ["geometric mean of the ratios, residual active on less", mean([r.ratio for r in unlike])],
        ["the same with the prior alone, all pairs", mean([r.prior.rmse_deg / r.untaught.rmse_deg for r in results])],
        ["the same with the paper's network, all pairs", mean([r.paper_deg / r.untaught.rmse_deg for r in results])],
        ["1:10 cars, pd-hef over kinematic", mean([r.hybrid.rmse_deg / r.kinematic_deg for r in small])],
        ["geometric mean of the ratios, taught by the reference", mean([p.ratio for _, p in pairs])],
        ["the same pairs, taught by ground truth", mean([r.ratio for r, _ in pairs])],
        ["pairs worse than untaught by more than that, taught by the reference", str(sum(p.worse for _, p in pairs))],
    ]
    return table(["figure", "value"], lines)


def geometric_mean(ratios: Sequence[float]) -> str:
    """Return the geometric mean of ratios, a dash without any."""
    return f"{math.exp(float(np.mean(np.log(ratios)))):.2f}" if ratios else "–"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the pairs and write the page."""
    parser = options("teaching", __doc__)
    parser.add_argument("--cars", default=",".join((*(c.name for c in CARS), SIMULATED)))
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS_FILE)
    parser.add_argument("--stored", action="store_true", help="write the page of the stored results")
    given = parser.parse_args(arguments)
    if given.stored:
        write_page(given.out, stored_results(given.results))
        return 0
    if not DRIVES.is_dir():
        print("needs ../shared beside the repository (recorded drives that may not be redistributed); nothing is done")
        return 0
    wanted = given.cars.split(",")
    if unknown := set(wanted) - {SIMULATED, *(c.name for c in CARS)}:
        parser.error(f"--cars: expected names out of {', '.join(c.name for c in CARS)}, got {', '.join(unknown)}")
    results = []
    studied = [pairs_of(c) for c in CARS if c.name in wanted]
    if SIMULATED in wanted:
        studied += map(simulated_pairs, SEEDS)
    for pairs in studied:
        for result in pairs:
            results.append(result)
            print(pair_table([result]).splitlines()[-1], file=sys.stderr)
    write_bytes(given.results, (json.dumps([asdict(r) for r in results], indent=1) + "\n").encode())
    write_page(given.out, results)
    return 0


def stored_results(file: Path) -> list[PairResult]:
    """Return the results of a stored run."""
    scores = ("untaught", "prior", "hybrid", "reference")
    documents = json.loads(file.read_text(encoding="utf-8"))
    return [PairResult(**{**d, **{name: Score(**d[name]) for name in scores if d.get(name)}}) for d in documents]


def write_page(folder: Path, results: Sequence[PairResult]) -> None:
    """Write the page of results."""
    recorded = [r for r in results if not r.car.startswith(SIMULATED)]
    parts = {"pairs": pair_table(recorded), "summary": summary(recorded), "simulated": simulated_table(results)}
    write(folder / "teaching.md", PAGE.format(seed=SEEDS[0], least_s=LEAST_S, **parts))


if __name__ == "__main__":
    sys.exit(main())
