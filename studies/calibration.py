"""Calibration of cars without ground truth, their 95 % confidence intervals, and coverage of every printed ±.

    python -m studies.calibration [--cars 30] [--work out/calibration] [--out docs]

Each simulated car has random sensors and a right vehicle file, fitted to a ramp steer, and a wrong one: a stiffness
error of a factor 0.5 to 2 at each axle; inertia, roll gradient, IMU position and steering ratio are as wrong as the
prior of the calibration expects. All drives run by ``pdhef run`` with both files, with and without calibration.
"""

from __future__ import annotations

import copy
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from pdhef_logtool import Car, PdhefError
from studies.drawn_cars import KINDS, DrawnCar, draw_car
from studies.gates.tool import Tool, reports
from studies.pages import (
    DOCS,
    ROOT,
    SAMPLE_VEHICLE,
    number,
    options,
    table,
    template,
    write,
    write_toml,
    write_validated_car,
)
from truthsim.batch import sensor_noise
from truthsim.drive import simulate_drive, write_drive
from truthsim.vehicle import GRAVITY_M_S2
from truthsim.vehicle_choice import choose_vehicle

#: Manoeuvre, km/h, seconds (None: its own).
DRIVEN: tuple[tuple[str, float, float | None], ...] = (
    ("sine-sweep-wide", 90.0, None), ("road", 100.0, 120.0), ("dlc", 80.0, None), ("sine-with-dwell", 80.0, None),
    ("road", 60.0, 60.0),
)  # fmt: skip
CARS, SEED = 30, 99_005
FRICTIONS, WRONG = (0.85, 1.0), (0.5, 2.0)
#: Lowest and highest share of values that a ± with 95 % coverage may have.
ACCEPTED = (0.90, 0.98)
NORMAL_95 = 1.959964
RIGHT, WRONG_FILE = "right", "wrong"
_PRINTED = re.compile(r"(-?[\d.]+) \+- ([\d.]+)")
#: Half of the last printed decimal is added to a printed standard deviation.
_ROUNDED = {"ay_m_s2.delay": 0.05, "yaw_rate_rad_s.delay": 0.05, "yaw_rate_rad_s.gain": 0.0005}


class Run(NamedTuple):
    """One drive with one file: sideslip RMSE in degrees and d2 in m/s by estimator, and the report."""

    rmse: Mapping[str, float]
    d2: Mapping[str, float]
    report: dict[str, Any]
    coverage: float
    width: float


class Outcome(NamedTuple):
    """The runs of a drive by file and whether the car is calibrated, and the true values of the car."""

    manoeuvre: str
    runs: Mapping[tuple[str, bool], Run]
    true: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class StudiedCar:
    """A drawn car with its vehicle files, and the true values of the estimated parameters by name."""

    drawn: DrawnCar
    friction: float
    files: Mapping[str, dict[str, Any]]
    true: Mapping[str, float]


def studied_car(rng: np.random.Generator) -> StudiedCar:
    """Draw a car, its files and its true values."""
    drawn = draw_car(rng, Car.load(SAMPLE_VEHICLE).vehicle, (*KINDS, "hatchback"))
    friction = float(rng.choice(FRICTIONS))
    vehicle = drawn.vehicle.model_copy(update={"friction": friction})
    right = vehicle.model_dump(mode="json", exclude_none=True)
    wrong = wrong_file(right, rng)
    true = true_values(right, dict(drawn.sensors)["imu_x_m"])
    return StudiedCar(drawn, friction, {RIGHT: right, WRONG_FILE: wrong}, true)


def wrong_file(right: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return a vehicle file with errors as the prior of the calibration expects."""
    wrong = copy.deepcopy(dict(right))
    for tyre in wrong["tyres"].values():
        tyre["B"] *= math.exp(rng.uniform(*np.log(WRONG)))
    wheelbase_m = wrong["cg_to_front_axle_m"] + wrong["cg_to_rear_axle_m"]
    wrong["yaw_inertia_kg_m2"] *= math.exp(0.2 * rng.normal())
    wrong["steering_ratio"] *= math.exp(0.08 * rng.normal())
    roll = wrong["roll_gradient_rad_per_m_s2"] + 0.03 / GRAVITY_M_S2 * rng.normal()
    wrong["roll_gradient_rad_per_m_s2"] = max(0.0, roll)
    wrong["imu_position_m"] = [0.4 * wheelbase_m * rng.normal(), 0.0, 0.0]
    return wrong


def true_values(right: Mapping[str, Any], imu_x_m: float) -> dict[str, float]:
    """Return the true values of calibrated parameters, and of the figures in checks, by name.

    The ground truth of the runs is the state of the simulator at the CG.
    """
    gain = 1.0 + GRAVITY_M_S2 * right["roll_gradient_rad_per_m_s2"]
    return {
        "rear cornering stiffness": math.prod(right["tyres"]["rear"][name] for name in ("B", "C", "D_n")),
        "yaw inertia": right["yaw_inertia_kg_m2"],
        "steering ratio": right["steering_ratio"],
        "lever of a_y": imu_x_m,
        "roll gain": gain,
        "truth.sideslip_rad.offset": 0.0,
        "ay_m_s2.place": imu_x_m,
        "ay_m_s2.gain": gain,
        "ay_m_s2.delay": 0.0,
        "yaw_rate_rad_s.gain": 1.0,
        "yaw_rate_rad_s.delay": 0.0,
    }


def errors_over_sd(report: Mapping[str, Any], true: Mapping[str, float]) -> Iterator[tuple[str, float]]:
    """Yield name and error over standard deviation of the calibrated parameters and printed figures of a report."""
    for p in (report["self_calibration"] or {}).get("parameters", ()):
        if p["name"] in true:
            value, right = float(p["value"]), true[p["name"]]
            error = math.log(value / right) if p.get("log") else value - right
            yield f"calibrated {p['name']}", error / float(p["sd"])
    for check in report["checks"]:
        if check["name"] in true and (shown := _PRINTED.search(check["evidence"])):
            sd = float(shown[2]) + _ROUNDED.get(check["name"], 0.005)
            yield f"check `{check['name']}`", (float(shown[1]) - true[check["name"]]) / sd


def outcomes(tool: Tool, index: int) -> Iterator[Outcome]:
    """Simulate the drives of a car and run them with both files, with and without calibration."""
    rng = np.random.default_rng([SEED, index])
    car = studied_car(rng)
    logs: dict[str, Path] = {}
    for manoeuvre, speed, duration_s in DRIVEN:
        log = tool.work / "logs" / f"{index}-{manoeuvre}-{speed:.0f}.mcap"
        log.parent.mkdir(parents=True, exist_ok=True)
        noise = sensor_noise(dict(car.drawn.sensors) | {"steer_gain": 0.0})
        try:
            drive = simulate_drive(
                manoeuvre, speed_km_h=speed, friction=car.friction, seed=int(rng.integers(2**31)),
                duration_s=duration_s, vehicle=choose_vehicle(car.drawn.text), vehicle_name=car.drawn.text, noise=noise,
            )  # fmt: skip
        except PdhefError as error:  # it would spin
            print(f"car {index}, {manoeuvre} is left out: {error}", file=sys.stderr)
            continue
        log.unlink(missing_ok=True)
        write_drive(drive, log, steering_wheel=True)
        logs[log.stem] = log
    runs = {
        (file, is_calibrated): runs_of(tool, f"{index}-{file}", document, list(logs.values()), is_calibrated)
        for file, document in car.files.items()
        for is_calibrated in (False, True)
    }
    for stem in logs:
        yield Outcome(stem.split("-", 1)[1], {key: of[stem] for key, of in runs.items()}, car.true)


def runs_of(
    tool: Tool, name: str, vehicle: Mapping[str, Any], logs: Sequence[Path], is_calibrated: bool
) -> dict[str, Run]:
    """Run the estimators on the drives of a car; return the results by log."""
    place = tool.work / "cars" / name
    file = write_toml(place.parent / f"{name}.toml", vehicle) if is_calibrated else write_validated_car(place, vehicle)
    names = "zero,open-loop,phy-ukf,physics"
    given = ("--car", file, "--keep", "estimates", "--estimators", names)
    folder = tool.run(f"{name}-{is_calibrated}", *logs, *given)
    metrics = pl.read_parquet(folder / "metrics.parquet").filter(segment="all")
    runs = {}
    for log, report in reports(folder).items():
        of = {
            metric: dict(metrics.filter(log=log, signal=signal, metric=metric).select("estimator", "value").iter_rows())
            for signal, metric in (("sideslip_rad", "rmse"), ("vy_m_s", "d2"), ("sideslip_rad", "coverage95"))
        }
        rmse = {estimator: math.degrees(value) for estimator, value in of["rmse"].items()}
        tracks = pl.read_parquet(folder / "logs" / log / "estimates.parquet")
        stds = tracks.filter(pl.col("valid"), estimator="physics")["sideslip_std_rad"].to_numpy()
        width = 2.0 * NORMAL_95 * math.degrees(float(np.nanmean(stds))) / rmse["physics"]
        runs[log] = Run(rmse, of["d2"], report, of["coverage95"]["physics"], width)
    return runs


# ------------------------------------------------------------------------------------------------ tables


def by_manoeuvre(done: Sequence[Outcome]) -> Iterator[tuple[str, list[Outcome]]]:
    """Yield the outcomes of each manoeuvre, and all."""
    for name in (*dict.fromkeys(o.manoeuvre for o in done), "all"):
        yield name, [o for o in done if name in (o.manoeuvre, "all")]


def error_table(done: Sequence[Outcome]) -> str:
    """Return the median errors, a line a manoeuvre."""
    columns = {
        f"{file} file{', calibrated' if is_calibrated else ''}: {name}": (file, is_calibrated, name)
        for file, is_calibrated, names in (
            (RIGHT, False, ("phy-ukf", "physics")), (WRONG_FILE, False, ("phy-ukf", "physics")),
            (WRONG_FILE, True, ("physics",)), (RIGHT, True, ("physics",)),
        )
        for name in names
    }  # fmt: skip
    body = []
    for manoeuvre, some in by_manoeuvre(done):
        cells = [number(float(np.median([o.runs[f, c].rmse[n] for o in some]))) for f, c, n in columns.values()]
        ratio = [o.runs[WRONG_FILE, True].rmse["physics"] / o.runs[RIGHT, False].rmse["physics"] for o in some]
        low, middle, high = np.percentile(ratio, [10, 50, 90])
        refused = sum(bool((o.runs[WRONG_FILE, True].report["self_calibration"] or {}).get("refused")) for o in some)
        body.append([manoeuvre, str(len(some)), str(refused), *cells, f"{middle:.2f} ({low:.2f} to {high:.2f})"])
    return table(["drive", "cars", "refused", *columns, "physics calibrated / right file"], body, right_from=1)


def interval_table(done: Sequence[Outcome]) -> str:
    """Return coverage and width of the 95 % intervals of calibrated cars."""
    body = []
    for manoeuvre, some in by_manoeuvre(done):
        runs = [o.runs[file, True] for o in some for file in (RIGHT, WRONG_FILE)]
        coverage = np.array([r.coverage for r in runs])
        shares = [f"{x:.0%}" for x in (np.mean(coverage), *np.percentile(coverage, [10, 50, 90]))]
        body.append([manoeuvre, str(len(runs)), *shares, number(float(np.median([r.width for r in runs])), 2)])
    head = ["drive", "intervals", "coverage: mean", "10 %", "median", "90 %", "width / RMSE: median"]
    return table(head, body, right_from=1)


def d2_table(done: Sequence[Outcome]) -> str:
    """Return the RMSE ratio of an estimate to the estimate with the lowest d2."""
    pairs = []
    for o in done:
        runs = (o.runs[WRONG_FILE, False], o.runs[WRONG_FILE, True])
        both = {(i, n): (d2, r.rmse[n]) for i, r in enumerate(runs) for n, d2 in r.d2.items() if n in r.rmse}
        for key, (d2, error) in both.items():
            best = min((v for k, v in both.items() if k != key), default=None)
            if best is not None:
                pairs.append((d2 / best[0], error / best[1]))
    values, body = np.array(pairs), []
    for low, high in pairwise((0.0, 0.9, 1.0, 1.05, 1.1, 1.2, 1.5, 2.0, np.inf)):
        inside = values[(values[:, 0] >= low) & (values[:, 0] < high), 1]
        if inside.size:
            cells = [f"{x:.2f}" for x in np.percentile(inside, [0, 10, 50, 100])]
            body.append([f"{low:g} to {high:g}", str(inside.size), *cells])
    head = ["v̇_y residual / lowest of the others", "estimates", "RMSE ratio: lowest", "10 %", "median", "most"]
    return table(head, body, right_from=1)


def coverage_table(scores: Sequence[tuple[str, str, float]]) -> str:
    """Return the share of true values within ± 1.96 sd: of quantity, manoeuvre, and error over standard deviation."""
    body, (lowest, highest) = [], ACCEPTED
    for name in sorted({quantity for quantity, _, _ in scores}):
        of: dict[str, list[float]] = {}
        for _, manoeuvre, score in (s for s in scores if s[0] == name):
            of.setdefault(manoeuvre, []).append(score)
        values = np.concatenate(list(of.values()))
        shares = {m: float(np.mean(np.abs(v) <= NORMAL_95)) for m, v in of.items()}
        share, least = float(np.mean(np.abs(values) <= NORMAL_95)), min(shares, key=lambda m: shares[m])
        word = "yes" if lowest <= share <= highest else "too wide" if share > highest else "no"
        rms = f"{np.sqrt(np.mean(values**2)):.2f}"
        body.append([name, str(len(values)), f"{share:.0%}", rms, f"{shares[least]:.0%} ({least})", word])
    head = ["figure", "values", "within ± 1.96 sd", "RMS error / sd", "lowest of a manoeuvre", "90 to 98 %"]
    return table(head, body, right_from=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate, calibrate, and write the page."""
    parser = options("calibration", __doc__)
    parser.add_argument("--cars", type=int, default=CARS)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "calibration")
    parser.add_argument("--out", type=Path, default=DOCS)
    given = parser.parse_args(arguments)
    done: list[Outcome] = []
    for index in range(given.cars):
        done += outcomes(Tool(ROOT, given.work.resolve()), index)
        print(f"car {index}", file=sys.stderr)
    scores = [
        (name, o.manoeuvre, score)
        for o in done
        for name, score in errors_over_sd(o.runs[WRONG_FILE, True].report, o.true)
    ]
    texts = {"errors": error_table(done), "intervals": interval_table(done), "d2": d2_table(done)}
    texts["plus_minus"] = coverage_table(scores)
    write(
        given.out / "calibration.md",
        template(__file__, cars=given.cars, seed=SEED, low=WRONG[0], high=WRONG[1], **texts),
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
