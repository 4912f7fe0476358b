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
from collections.abc import Iterator, Mapping
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool import Car, PdhefError
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from studies.drawn_cars import KINDS, draw_car
from studies.gates.tool import Tool, metrics, reports
from studies.pages import ROOT, SAMPLE_VEHICLE, number, options, table, update, write_toml, write_validated_car
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


def by_manoeuvre(runs: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the runs of each manoeuvre, and all."""
    for (name,), some in runs.group_by("drive", maintain_order=True):
        yield str(name), some
    yield "all", runs


def error_table(runs: pl.DataFrame) -> str:
    """Return the median errors, a line a manoeuvre."""
    columns = {
        f"{file} file{', calibrated' if is_calibrated else ''}: {name}":
            {"file": file, "calibrated": is_calibrated, "estimator": name}
        for file, is_calibrated, names in (
            (RIGHT, False, ("phy-ukf", "physics")), (WRONG_FILE, False, ("phy-ukf", "physics")),
            (WRONG_FILE, True, ("physics",)), (RIGHT, True, ("physics",)),
        )
        for name in names
    }  # fmt: skip
    body = []
    for manoeuvre, some in by_manoeuvre(runs):
        rmse = {title: some.filter(**of)["rmse"].to_numpy() for title, of in columns.items()}
        ratio = rmse["wrong file, calibrated: physics"] / rmse["right file: physics"]
        low, middle, high = np.percentile(ratio, [10, 50, 90])
        refused = some.filter(file=WRONG_FILE, calibrated=True, estimator="physics")["refused"].sum()
        cells = [number(float(np.median(values))) for values in rmse.values()]
        body.append([manoeuvre, str(len(ratio)), str(refused), *cells, f"{middle:.2f} ({low:.2f} to {high:.2f})"])
    return table(["drive", "cars", "refused", *columns, "physics calibrated / right file"], body, right_from=1)


def interval_table(runs: pl.DataFrame) -> str:
    """Return coverage and width of the 95 % intervals of calibrated cars."""
    body = []
    for manoeuvre, some in by_manoeuvre(runs.filter(calibrated=True, estimator="physics")):
        coverage = some["coverage"].to_numpy()
        shares = [f"{x:.0%}" for x in (np.mean(coverage), *np.percentile(coverage, [10, 50, 90]))]
        width = number(float(np.median(some["width"].to_numpy())), 2)
        body.append([manoeuvre, str(len(coverage)), *shares, width])
    head = "drive, intervals, coverage: mean, 10 %, median, 90 %, width / RMSE: median"
    return table(head, body, right_from=1)


def d2_table(runs: pl.DataFrame) -> str:
    """Return the RMSE ratio of an estimate to the estimate with the lowest d2."""
    pairs = []
    for _, some in runs.filter(pl.col("d2").is_not_null(), file=WRONG_FILE).group_by("car", "drive"):
        both = some.select("d2", "rmse").rows()
        for i, (d2, error) in enumerate(both):
            best = min((pair for k, pair in enumerate(both) if k != i), default=None)
            if best is not None:
                pairs.append((d2 / best[0], error / best[1]))
    values, body = np.array(pairs), []
    for low, high in pairwise((0.0, 0.9, 1.0, 1.05, 1.1, 1.2, 1.5, 2.0, np.inf)):
        inside = values[(values[:, 0] >= low) & (values[:, 0] < high), 1]
        if inside.size:
            cells = [f"{x:.2f}" for x in np.percentile(inside, [0, 10, 50, 100])]
            body.append([f"{low:g} to {high:g}", str(inside.size), *cells])
    return table("v̇_y residual / lowest of the others, estimates, RMSE ratio: lowest, 10 %, median, most", body,
                 right_from=1)  # fmt: skip


def coverage_table(scores: pl.DataFrame) -> str:
    """Return the share of true values within ± 1.96 sd by figure; ``scores``: errors over standard deviation."""
    body, (lowest, highest) = [], ACCEPTED
    within = scores.with_columns(within=pl.col("score").abs() <= NORMAL_95)
    for (name,), of in within.sort("figure").group_by("figure", maintain_order=True):
        shares = of.group_by("drive", maintain_order=True).agg(pl.col("within").mean())
        drive, least = shares.sort("within", maintain_order=True).row(0)
        share, rms = float(of["within"].to_numpy().mean()), float(np.sqrt(np.mean(of["score"].to_numpy() ** 2)))
        word = "yes" if lowest <= share <= highest else "too wide" if share > highest else "no"
        body.append([str(name), str(len(of)), f"{share:.0%}", f"{rms:.2f}", f"{least:.0%} ({drive})", word])
    head = "figure, values, within ± 1.96 sd, RMS error / sd, lowest of a manoeuvre, 90 to 98 %"
    return table(head, body, right_from=1)


def main() -> None:
    """Simulate, calibrate, and write the page."""
    given = options("calibration", __doc__, "work out", cars=CARS).parse_args()
    runs, scores = list[dict[str, Any]](), list[dict[str, Any]]()
    for index in range(given.cars):
        of_car = outcomes(Tool(ROOT, given.work.resolve()), index)
        runs += of_car[0]
        scores += of_car[1]
        print(f"car {index}", file=sys.stderr)
    done = pl.DataFrame(runs)
    update(given.out, "calibration.md", {
        "cars": f"{given.cars} simulated cars, seed {SEED}.",
        "errors": error_table(done),
        "intervals": interval_table(done),
        "d2": d2_table(done),
        "plus_minus": coverage_table(pl.DataFrame(scores)),
    })  # fmt: skip


if __name__ == "__main__":
    main()
