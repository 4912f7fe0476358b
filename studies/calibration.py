"""Calibration of cars without ground truth, their 95 % confidence intervals, and coverage of every printed ±.

    python -m studies.calibration [--cars 30] [--work out/calibration] [--out docs]

Each simulated car has random sensors and a right vehicle file, fitted to a ramp steer, and a wrong one: a stiffness
error of a factor 0.5 to 2 at each axle; inertia, roll gradient, IMU position and steering ratio are as wrong as the
prior of the calibration expects. All drives run by ``pdhef run`` with both files, with and without calibration.
"""

import copy
import math
import re
import sys
from collections.abc import Iterator, Mapping
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool import Car, PdhefError
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.signals import FloatArray
from studies.drawn_cars import KINDS, draw_car
from studies.gates.tool import Tool, metrics, reports
from studies.pages import ROOT, SAMPLE_VEHICLE, blocks, options, update, write_toml, write_validated_car
from truthsim.batch import sensor_noise
from truthsim.drive import simulate_drive
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
RIGHT, WRONG_FILE = "right", "wrong"
ESTIMATORS = ("zero", "open-loop", "phy-ukf", "physics")
_PRINTED = re.compile(r"(-?[\d.]+) \+- ([\d.]+)")
#: Half of the last printed decimal is added to a printed standard deviation.
_ROUNDED = {"ay_m_s2.delay": 0.05, "yaw_rate_rad_s.delay": 0.05, "yaw_rate_rad_s.gain": 0.0005}


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


def outcomes(tool: Tool, index: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Simulate the drives of a car and run them with both files, with and without calibration.

    Returns a row a drive, file, calibration and estimator, and the errors over standard deviation with the wrong file.
    """
    rng = np.random.default_rng([SEED, index])
    car = draw_car(rng, Car.load(SAMPLE_VEHICLE).vehicle, (*KINDS, "hatchback"))
    friction, sensors = float(rng.choice(FRICTIONS)), dict(car.sensors)
    vehicle = car.vehicle.model_copy(update={"friction": friction})
    right = vehicle.model_dump(mode="json", exclude_none=True)
    files, true = {RIGHT: right, WRONG_FILE: wrong_file(right, rng)}, true_values(right, sensors["imu_x_m"])
    logs: dict[str, Path] = {}
    for manoeuvre, speed, duration_s in DRIVEN:
        name = f"{manoeuvre}-{speed:.0f}"
        noise = sensor_noise(sensors | {"steer_gain": 0.0})
        try:
            drive = simulate_drive(
                manoeuvre, speed_km_h=speed, friction=friction, seed=int(rng.integers(2**31)),
                duration_s=duration_s, vehicle=choose_vehicle(car.text), vehicle_name=car.text, noise=noise,
            )  # fmt: skip
        except PdhefError as error:  # it would spin
            print(f"car {index}, {manoeuvre} is left out: {error}", file=sys.stderr)
            continue
        logs[name] = tool.log(f"{index}-{name}", drive, steering_wheel=True)
    runs, scores = list[dict[str, Any]](), list[dict[str, Any]]()
    for (file, document), is_calibrated in product(files.items(), (False, True)):
        name, folder = f"{index}-{file}", tool.work / "cars"
        writer, path = (write_toml, f"{name}.toml") if is_calibrated else (write_validated_car, name)
        given = writer(folder / path, document)
        keep = ("--car", given, "--keep", "estimates", "--estimators", ",".join(ESTIMATORS))
        run = tool.run(f"{name}-{is_calibrated}", *logs.values(), *keep)
        found = reports(run)
        about = {"car": index, "file": file, "calibrated": is_calibrated}
        for drive_name, log in logs.items():
            refused = bool((found[log.stem]["self_calibration"] or {}).get("refused"))
            runs += [about | {"drive": drive_name, "refused": refused} | row for row in figures_of(run, log.stem)]
            if is_calibrated and file == WRONG_FILE:
                errors = errors_over_sd(found[log.stem], true)
                scores += [{"figure": figure, "drive": drive_name, "score": score} for figure, score in errors]
    return runs, scores


def figures_of(run: Path, log: str) -> Iterator[dict[str, Any]]:
    """Yield RMSE in degrees, d2 in m/s, coverage and width of the 95 % intervals of each estimator on a drive."""
    of_log = metrics(run, log=log)
    tracks = pl.read_parquet(run / "logs" / log / "estimates.parquet").filter("valid")
    for name in ESTIMATORS:
        rows = of_log.filter(estimator=name).select("signal", "metric", "value").iter_rows()
        of = {(signal, metric): value for signal, metric, value in rows}
        std, rmse = tracks.filter(estimator=name)["sideslip_std_rad"].to_numpy(), of["sideslip_rad", "rmse"]
        yield {
            "estimator": name,
            "rmse": math.degrees(rmse),
            "d2": of.get(("vy_m_s", "d2")),
            "coverage": of.get(("sideslip_rad", "coverage95")),
            "width": 2.0 * NORMAL_95 * float(np.nanmean(std)) / rmse if np.isfinite(std).any() else None,
        }


# ------------------------------------------------------------------------------------------------ tables


#: Columns of the errors: vehicle file, whether it is calibrated, estimator.
COLUMNS = (
    *((file, False, name) for file in (RIGHT, WRONG_FILE) for name in ("phy-ukf", "physics")),
    (WRONG_FILE, True, "physics"), (RIGHT, True, "physics"),
)  # fmt: skip


def figures_of_drives(runs: pl.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield the figures of each manoeuvre and of all: errors (medians, ratio) and intervals of calibrated cars."""
    for (name,), of in (*runs.group_by("drive", maintain_order=True), (("all",), runs)):
        rmse = [of.filter(file=f, calibrated=c, estimator=n)["rmse"].to_numpy() for f, c, n in COLUMNS]
        calibrated = of.filter(calibrated=True, estimator="physics")
        coverage = calibrated["coverage"].to_numpy()
        yield {
            "name": name,
            "cars": len(rmse[0]),
            "refused": calibrated.filter(file=WRONG_FILE)["refused"].sum(),
            "errors": [float(np.median(values)) for values in rmse],
            "ratio": np.percentile(rmse[4] / rmse[1], [50, 10, 90]),
            "intervals": len(coverage),
            "coverage": (np.mean(coverage), *np.percentile(coverage, [10, 50, 90])),
            "width": float(np.median(calibrated["width"].to_numpy())),
        }


def d2_ratios(runs: pl.DataFrame) -> Iterator[tuple[float, float, int, FloatArray]]:
    """Yield bins of d2 over the lowest one of the other estimates, with quantiles of the RMSE ratios."""
    pairs = []
    for _, some in runs.filter(pl.col("d2").is_not_null(), file=WRONG_FILE).group_by("car", "drive"):
        both = some.select("d2", "rmse").rows()
        for i, (d2, error) in enumerate(both):
            best = min((pair for k, pair in enumerate(both) if k != i), default=None)
            if best is not None:
                pairs.append((d2 / best[0], error / best[1]))
    values = np.array(pairs)
    for low, high in pairwise((0.0, 0.9, 1.0, 1.05, 1.1, 1.2, 1.5, 2.0, np.inf)):
        inside = values[(values[:, 0] >= low) & (values[:, 0] < high), 1]
        if inside.size:
            yield low, high, inside.size, np.percentile(inside, [0, 10, 50, 100])


def coverages(scores: pl.DataFrame) -> Iterator[tuple[str, int, float, float, float, str, str]]:
    """Yield the share of true values within ± 1.96 sd by figure; ``scores``: errors over standard deviation.

    Figure, count, share, RMS, lowest share of a manoeuvre, this manoeuvre, and whether the share is accepted.
    """
    lowest, highest = ACCEPTED
    within = scores.with_columns(within=pl.col("score").abs() <= NORMAL_95)
    for (name,), of in within.sort("figure").group_by("figure", maintain_order=True):
        shares = of.group_by("drive", maintain_order=True).agg(pl.col("within").mean())
        drive, least = shares.sort("within", maintain_order=True).row(0)
        share, rms = float(of["within"].to_numpy().mean()), float(np.sqrt(np.mean(of["score"].to_numpy() ** 2)))
        word = "yes" if lowest <= share <= highest else "too wide" if share > highest else "no"
        yield str(name), len(of), share, rms, least, drive, word


def main() -> None:
    """Simulate, calibrate, and write the page."""
    given = options("calibration", __doc__, "work out", cars=CARS).parse_args()
    runs, scores = list[dict[str, Any]](), list[dict[str, Any]]()
    for index in range(given.cars):
        of_car = outcomes(Tool(ROOT, given.work.resolve()), index)
        runs += of_car[0]
        scores += of_car[1]
        print(f"car {index}", file=sys.stderr)
    done, plus_minus = pl.DataFrame(runs), coverages(pl.DataFrame(scores))
    about = {"cars": given.cars, "seed": SEED, "columns": COLUMNS, "drives": [*figures_of_drives(done)]}
    made = blocks(__file__, d2=d2_ratios(done), plus_minus=plus_minus, **about)
    update(given.out, "calibration.md", made)


if __name__ == "__main__":
    main()
