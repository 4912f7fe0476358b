"""Calibration without ground truth: simulated cars with wrong files, and recorded drives with published ones.

Each simulated car drives a wide sine sweep and a road. Its vehicle file, fitted to a ramp steer, gets a stiffness error
of a factor 0.5 to 2 at each axle. Each drive calibrates the car for itself, as ``pdhef run`` does.
``studies.calibration`` writes the page.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.toml_files import load_vehicle
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, self_calibrate
from pdhef_logtool.estimators.calibration.driving import driving_of
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.self_calibrated import CAR_STD_RAD, D2_SHARE, OPEN_LOOP
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import ALL, NORMAL_95, signal_error
from pdhef_logtool.evaluation.metrics.lateral_consistency import consistency_rows
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import calibrator
from pdhef_logtool.runs.selection import FACTOR
from pdhef_logtool.runs.self_calibrating import driven_d2, log_sensors
from studies.condition_drives import SIDESLIP, as_logged
from studies.drawn_cars import BASE, KINDS, draw_car
from studies.pages import DRIVES, number, table
from studies.peers.drives import FULL_SIZE, PEER_DRIVES, mapping_of, read_peer_drive, vehicle_of
from truthsim.batch import sensor_noise
from truthsim.drive import Drive, simulate_drive
from truthsim.sensors import SensorNoise
from truthsim.vehicle_choice import choose_vehicle

#: Manoeuvre, km/h, seconds (None: its own).
DRIVEN: tuple[tuple[str, float, float | None], ...] = (("sine-sweep-wide", 90.0, None), ("road", 100.0, 240.0))
FRICTIONS = (0.85, 1.0)
WRONG = (0.5, 2.0)
#: Parts of an interval; coverage of a drive that is asked.
OWN, OF_CAR, CONSISTENCY, PARAMETERS = "own", "s_car", "v̇_y residual", "parameters"
LEAST_COVERAGE = 0.90


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """A drive of a simulated car with its right file."""

    car: int
    manoeuvre: str
    drive: WholeDrive
    file: VehicleParameters
    factors: tuple[float, float]

    def error(self, track: StateTrack) -> FloatArray:
        """Return the sideslip error [N] of an estimate in rad, NaN where it is not scored."""
        assert self.drive.truth is not None
        return signal_error(track, self.drive.truth, SIDESLIP, self.file.low_speed_blend_m_s)


def simulate(cars: int, seed: int, driven: Sequence[tuple[str, float, float | None]] = DRIVEN) -> list[Simulated]:
    """Return the drives of the cars; one that cannot be driven is left out, with a message."""
    return [simulated for simulated, _, _ in simulated_drives(cars, seed, driven)]


def simulated_drives(
    cars: int, seed: int, driven: Sequence[tuple[str, float, float | None]], **sensors: float
) -> Iterator[tuple[Simulated, Drive, SensorNoise]]:
    """Yield what :func:`simulate` returns, with the drive as it is simulated and its sensors; ``sensors`` are given."""
    for index in range(cars):
        rng = np.random.default_rng([seed, index])
        car = draw_car(rng, load_vehicle(BASE), (*KINDS, "hatchback"))
        front, rear = np.exp(rng.uniform(np.log(WRONG[0]), np.log(WRONG[1]), 2))
        friction = float(rng.choice(FRICTIONS))
        file = car.vehicle.model_copy(update={"friction": friction})
        for manoeuvre, speed, duration_s in driven:
            noise = sensor_noise(dict(car.sensors) | sensors)
            try:
                drive = simulate_drive(
                    manoeuvre,
                    speed_km_h=speed,
                    friction=friction,
                    seed=int(rng.integers(2**31)),
                    duration_s=duration_s,
                    vehicle=choose_vehicle(car.text),
                    vehicle_name=car.text,
                    noise=noise,
                )
            except SimulationError as error:
                say(f"car {index}, {manoeuvre} is left out: {error}")
                continue
            logged = as_logged(drive, Car.of(file))
            yield Simulated(index, manoeuvre, logged, file, (float(front), float(rear))), drive, noise


def calibrate(signals: Signals, file: VehicleParameters) -> SelfCalibration:
    """Calibrate a car on the signals of a log, read with its file."""
    return self_calibrate([driving_of(signals, file)], file)


def taken(signals: Signals, file: VehicleParameters, calibration: SelfCalibration) -> Car:
    """Return a car as a run of a log has it after a calibration, which may have been refused."""
    if calibration.refused:
        return Car.of(file)
    calibrated = WithoutTruth(
        calibration.vehicle, calibration.noise, told_friction=True, note="", error_scale=calibration.error_scale
    )
    car = replace(Car.of(file), self_calibrated=calibrated)
    driven = driven_d2([signals], car, calibration)
    return replace(car, self_calibrated=replace(calibrated, varied=calibration.varied, driven_d2_m_s=driven))


def bands_of(drive: WholeDrive, car: Car) -> dict[str, tuple[float, float]]:
    """Return coverage of the 95 % interval of ``physics`` and its mean whole width over RMSE: all of it, and by part.

    A part is what the head of :mod:`~pdhef_logtool.estimators.self_calibrated` adds; its figures are those without it.
    """
    found = car.self_calibrated
    assert drive.truth is not None
    assert found is not None
    estimator, slow = make_estimator("physics", car), car.vehicle.low_speed_blend_m_s
    own = run_window(estimator, drive.signals)[0]
    track = calibrator(car, [estimator]).add(own, drive.signals)
    error = signal_error(track, drive.truth, SIDESLIP, slow)
    finite = np.isfinite(error) & np.isfinite(track.sideslip_std_rad)
    error, variance = error[finite], track.sideslip_std_rad[finite] ** 2
    d2 = D2_SHARE * np.nan_to_num(found.driven_d2_m_s) / np.maximum(np.abs(track.vx_m_s[finite]), slow)
    parts = {
        OWN: (found.error_scale * own.sideslip_std_rad[finite]) ** 2,
        OF_CAR: np.full(error.size, (found.error_scale * CAR_STD_RAD) ** 2),
        CONSISTENCY: d2**2,
    }
    parts[PARAMETERS] = variance - sum(parts.values())

    def band(squares: FloatArray) -> tuple[float, float]:
        half = NORMAL_95 * np.sqrt(np.maximum(squares, 0.0))
        return float(np.mean(np.abs(error) <= half)), float(2.0 * np.mean(half) / np.sqrt(np.mean(error**2)))

    return {ALL: band(variance)} | {name: band(variance - part) for name, part in parts.items()}


def recorded_bands() -> dict[str, dict[str, tuple[float, float]]]:
    """Return :func:`bands_of` of the recorded drives of full-size cars with published files, by log."""
    bands = {}
    for one in PEER_DRIVES:
        if one.group == FULL_SIZE:
            file = vehicle_of(one)
            drive = read_peer_drive(DRIVES / one.log, file, mapping_of(one))
            car = taken(drive.signals, file, calibrate(drive.signals, file))
            if car.self_calibrated is not None:
                bands[one.log.partition(".")[0]] = bands_of(drive, car)
    return bands


def errors_of(
    drive: WholeDrive, car: Car, names: Sequence[str], calibration: SelfCalibration
) -> dict[str, tuple[float, float]]:
    """Return sideslip RMSE in degrees and d2 in m/s of estimators, by name."""
    whole = {ALL: np.ones(len(drive.signals), dtype=np.bool_)}
    sensors = log_sensors(car.vehicle, calibration)
    errors = {}
    truth = drive.truth
    assert truth is not None
    low = car.vehicle.low_speed_blend_m_s
    for name in names:
        if name == "physics" and car.self_calibrated is None and "physics" not in car.noise:
            car = car.with_noise("physics", calibration.noise.model_copy(update={"r_std": {}}))
        used = "open-loop" if name == OPEN_LOOP and car.self_calibrated is None else name
        track, _ = run_window(make_estimator(used, car), drive.signals)
        rows = consistency_rows([track], drive.signals, whole, log="", low_speed_m_s=low, sensors=sensors)
        rmse = float(np.degrees(np.sqrt(np.nanmean(signal_error(track, truth, SIDESLIP, low) ** 2))))
        errors[name] = rmse, rows[0].value if rows else float("nan")
    return errors


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What came of a drive: RMSE and d2 by estimator, with the right file, the wrong one, and that calibrated."""

    manoeuvre: str
    right: dict[str, tuple[float, float]]
    wrong: dict[str, tuple[float, float]]
    calibrated: dict[str, tuple[float, float]]
    from_right: dict[str, tuple[float, float]]
    refused: str
    bands: tuple[dict[str, tuple[float, float]], ...]  # from the wrong file and the right one, without those refused


def outcome_of(simulated: Simulated) -> Outcome:
    """Run a drive with its files."""
    wrong = simulated.file.with_stiffness(*simulated.factors)
    calibration, from_right = (
        calibrate(simulated.drive.signals, wrong),
        calibrate(simulated.drive.signals, simulated.file),
    )
    names, after = ("zero", "open-loop", "phy-ukf", "physics"), (OPEN_LOOP, "physics")
    signals = simulated.drive.signals
    calibrated, as_right = taken(signals, wrong, calibration), taken(signals, simulated.file, from_right)
    return Outcome(
        simulated.manoeuvre,
        errors_of(simulated.drive, Car.of(simulated.file), names, calibration),
        errors_of(simulated.drive, Car.of(wrong), names, calibration),
        errors_of(simulated.drive, calibrated, after, calibration),
        errors_of(simulated.drive, as_right, after, from_right),
        calibration.refused,
        tuple(bands_of(simulated.drive, car) for car in (calibrated, as_right) if car.self_calibrated is not None),
    )


def simulated_table(outcomes: Sequence[Outcome]) -> str:
    """Return the medians, a line a manoeuvre."""
    head = ["drive", "cars", "refused"]
    head += [f"right file: {n}" for n in ("phy-ukf", "physics")] + [f"wrong file: {n}" for n in ("phy-ukf", "physics")]
    head += ["wrong file, calibrated: open-loop", "the same: physics", "right file, calibrated: physics"]
    head += ["physics calibrated / right file"]
    body = []
    for name in [*dict.fromkeys(o.manoeuvre for o in outcomes), "all"]:
        some = [o for o in outcomes if name in (o.manoeuvre, "all")]
        columns = [[o.right[n][0] for o in some] for n in ("phy-ukf", "physics")]
        columns += [[o.wrong[n][0] for o in some] for n in ("phy-ukf", "physics")]
        columns += [[o.calibrated[n][0] for o in some] for n in (OPEN_LOOP, "physics")]
        columns += [[o.from_right["physics"][0] for o in some]]
        ratio = [o.calibrated["physics"][0] / o.right["physics"][0] for o in some]
        low, middle, high = np.percentile(ratio, [10, 50, 90])
        cells = [number(float(np.median(c))) for c in columns]
        refused = sum(bool(o.refused) for o in some)
        body.append([name, str(len(some)), str(refused), *cells, f"{middle:.2f} ({low:.2f} to {high:.2f})"])
    return table(head, body, right_from=1)


def coverage_cells(pairs: Sequence[tuple[float, float]]) -> tuple[list[str], str]:
    """Return mean, 10, 50 and 90 % quantiles and share at 90 to 98 % of coverages, and the median relative width."""
    coverage, width = np.array(pairs).T
    shares = (np.mean(coverage), *np.percentile(coverage, [10, 50, 90]))
    shares += (np.mean((coverage >= 0.90) & (coverage <= 0.98)),)
    return [f"{x:.0%}" for x in shares], number(float(np.median(width)), 2)


COVERAGE_HEAD = ["coverage: mean", "10 %", "median", "90 %", "intervals at 90 to 98 %", "width / RMSE: median"]


def band_table(outcomes: Sequence[Outcome]) -> str:
    """Return coverage and width of the 95 % intervals on calibrated cars."""
    body = []
    for name in [*dict.fromkeys(o.manoeuvre for o in outcomes), "all"]:
        pairs = [b[ALL] for o in outcomes if name in (o.manoeuvre, "all") for b in o.bands]
        shares, width = coverage_cells(pairs)
        body.append([name, str(len(pairs)), *shares, width])
    return table(["drive", "intervals", *COVERAGE_HEAD], body, right_from=1)


def parts_table(outcomes: Sequence[Outcome], recorded: dict[str, dict[str, tuple[float, float]]]) -> str:
    """Return width and lowest coverage of the intervals, and those without each of their parts."""
    simulated, body = [b for o in outcomes for b in o.bands], []
    for name in (ALL, OWN, OF_CAR, CONSISTENCY, PARAMETERS):
        cells = []
        for bands in (simulated, list(recorded.values())):
            width = np.median([b[name][1] for b in bands]) if bands else np.nan
            cells += [number(float(width), 1), f"{min((b[name][0] for b in bands), default=np.nan):.0%}"]
        low = [f"{log} {b[name][0]:.0%}" for log, b in recorded.items() if b[name][0] < LEAST_COVERAGE]
        body.append([name if name == ALL else f"without {name}", *cells, ", ".join(low) or "–"])
    head = ["interval", "simulated: median width / RMSE", "lowest coverage"]
    head += ["recorded: median width / RMSE", "lowest coverage", f"recorded drives below {LEAST_COVERAGE:.0%}"]
    return table(head, body, right_from=1)


def d2_table(outcomes: Sequence[Outcome]) -> str:
    """Return how much worse an estimate is whose d2 is larger than the least of the others."""
    pairs = []
    for o in outcomes:
        candidates = {f"wrong {k}": v for k, v in o.wrong.items()} | {f"cal {k}": v for k, v in o.calibrated.items()}
        for name, (error, d2) in candidates.items():
            others = [v for k, v in candidates.items() if k != name and np.isfinite(v[1])]
            best = min(others, key=lambda v: v[1], default=None)
            if best is not None and np.isfinite(d2):
                pairs.append((d2 / best[1], error / best[0]))
    values, body = np.array(pairs), []
    limits = (0.0, 0.9, 1.0, 1.05, 1.1, FACTOR, 1.5, 2.0, np.inf)
    for low, high in pairwise(limits):
        inside = values[(values[:, 0] >= low) & (values[:, 0] < high), 1]
        if inside.size:
            cells = [f"{x:.2f}" for x in np.percentile(inside, [0, 10, 50, 100])]
            body.append([f"{low:g} to {high:g}", str(inside.size), *cells])
    head = ["v̇_y residual / lowest of the others", "estimates", "RMSE ratio: lowest", "10 %", "median", "most"]
    return table(head, body, right_from=1)


def say(text: str) -> None:
    """Print progress to standard error."""
    print(text, file=sys.stderr)
