"""The published estimators of ``studies.peers``: they recover a simulated car, get no ground truth, and are scored."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from studies.peers.models import stiffness

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track
from studies.pages import DOCS, RESULTS
from studies.peers import __main__ as peers
from studies.peers.drives import FULL_SIZE, OFFSET, PEER_DRIVES, PeerDrive, beside_mapping, beside_vehicle
from studies.peers.page import page
from studies.peers.parameters import OF_CAR, PEAK, pairs_table
from studies.peers.scoring import DriveErrors, car_means, score

SPEED_M_S, STEP_S, SECONDS = 20.0, 0.01, 30.0
#: Sideslip RMSE in degrees on the simulated linear car, with a sideslip RMS of 0.37°.
BOUNDS_DEG = {
    "linear-kf": 0.001,
    "learned-single-track": 0.16,  # stationary: sideslip lags behind steering
    "open-loop-linear": 0.001,
    "slip-ukf": 0.1,  # low-passed sensors and a yaw acceleration over 1 s
    "open-loop-sedan": 0.001,
    "kinematic": 0.3,  # the leak
    "zero": 0.4,
}


def linear_sedan() -> VehicleParameters:
    """Return the default sedan with the peak forces so high that its tyres are linear."""
    sedan = default_vehicle()
    front, rear = stiffness(sedan)
    tyres = Tyres(
        front=AxleTyre(cornering_stiffness_n_per_rad=front), rear=AxleTyre(cornering_stiffness_n_per_rad=rear)
    )
    return sedan.model_copy(update={"tyres": tyres, "friction": 2.0})


def simulated(vehicle: VehicleParameters) -> tuple[Signals, np.ndarray]:
    """Return the signals of a linear single track on a slow sine of steering, and its sideslip [N]."""
    m, iz = vehicle.mass_kg, vehicle.yaw_inertia_kg_m2
    lf, lr = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    cf, cr = stiffness(vehicle)

    def steer(t):
        return 0.04 * np.sin(2.0 * np.pi * 0.2 * t)

    def forces(t, x):
        return cf * (steer(t) - (x[0] + lf * x[1]) / SPEED_M_S), -cr * (x[0] - lr * x[1]) / SPEED_M_S

    def rates(t, x):
        front, rear = forces(t, x)
        return [(front + rear) / m - SPEED_M_S * x[1], (lf * front - lr * rear) / iz]

    times = np.arange(0.0, SECONDS, STEP_S)
    vy, r = solve_ivp(rates, (0.0, SECONDS), [0.0, 0.0], t_eval=times, rtol=1e-9, atol=1e-12).y
    front, rear = forces(times, np.array([vy, r]))
    stamps = np.round(times * 1e9).astype(np.int64)
    missing = np.full(len(times), np.nan)
    signals = Signals(
        stamps, stamps, steer(times), np.zeros_like(times), (front + rear) / m, r, np.full(len(times), SPEED_M_S),
        missing, np.full((len(times), 4), np.nan),
    )  # fmt: skip
    return signals, np.arctan2(vy, SPEED_M_S)


@pytest.mark.fleet  # compiles the peers: a minute
@pytest.mark.slow
def test_every_peer_recovers_a_linear_car_within_its_bound():
    vehicle = linear_sedan()
    signals, sideslip = simulated(vehicle)
    rms = np.degrees(np.sqrt(np.mean(sideslip**2)))
    assert rms == pytest.approx(0.37, abs=0.01)
    estimates = peers.peer_estimates(signals, signals, vehicle)
    errors = {name: np.degrees(np.sqrt(np.mean((beta - sideslip) ** 2))) for name, beta in estimates.items()}
    assert errors.keys() == BOUNDS_DEG.keys()
    assert {name: error for name, error in errors.items() if not error < BOUNDS_DEG[name]} == {}


@pytest.mark.fleet  # compiles the peers: a minute
@pytest.mark.slow
def test_ground_truth_changes_no_estimate(sample_logs_dir: Path):
    log, vehicle = sample_logs_dir / "step.mcap", default_vehicle()
    with read_drive(log, Car.of(vehicle), options=ReadOptions()) as drive:
        mapping = drive.mapping
    truth = {
        name: replace(source, scale=np.multiply(source.scale, -3.0).tolist()) for name, source in mapping.truth.items()
    }
    drives = [peers.read_peer_drive(log, vehicle, given) for given in (mapping, replace(mapping, truth=truth))]
    assert drives[0].truth is not None
    assert drives[1].truth is not None
    assert not np.allclose(drives[0].truth.vx_m_s, drives[1].truth.vx_m_s, equal_nan=True)
    before, after = (peers.peer_estimates(drive.signals, drive.signals, vehicle) for drive in drives)
    for name, sideslip in before.items():
        np.testing.assert_array_equal(sideslip, after[name], err_msg=name)


def track(sideslip: np.ndarray, speed: float = 10.0):
    """Return ground truth with a sideslip [N] in rad."""
    stamps = np.arange(len(sideslip), dtype=np.int64) * 10_000_000
    speeds = np.full(len(sideslip), speed)
    return make_track("truth", stamps, vx_m_s=speeds * np.cos(sideslip), vy_m_s=speeds * np.sin(sideslip),
                      yaw_rate_rad_s=np.zeros(len(sideslip)), sideslip_rad=sideslip)  # fmt: skip


def test_a_missing_estimate_counts_as_0():
    truth = track(np.radians(np.full(10, 3.0)))
    half = np.where(np.arange(10) < 5, np.nan, truth.sideslip_rad)
    errors = score(PEER_DRIVES[0], {"none": np.full(10, np.nan), "half": half}, truth)
    assert errors.rmse_deg == pytest.approx({"none": 3.0, "half": 3.0 / np.sqrt(2.0)})
    assert errors.missing == {"none": 1.0, "half": 0.5}


def test_slow_stamps_are_not_scored_and_an_offset_is_removed_where_it_is_declared():
    assert score(PEER_DRIVES[0], {}, track(np.zeros(5), speed=2.9)).scored == 0
    truth = track(np.radians(np.array([2.0, 2.0, 2.0, 5.0])))
    offset = score(PeerDrive("log", "car", OFFSET), {"zero": np.zeros(4)}, truth)
    assert offset.offset_deg == pytest.approx(2.0)
    assert offset.rmse_deg["zero"] == pytest.approx(1.5)


def test_logs_of_a_drive_share_its_weight_and_drives_of_a_car_its_vote():
    drives = PeerDrive("a", "x"), PeerDrive("b", "x", same_as="a"), PeerDrive("c", "x"), PeerDrive("d", "y")
    errors = [DriveErrors(d, 1, 0.0, {"e": value}) for d, value in zip(drives, (1.0, 4.0, 8.0, 3.0), strict=True)]
    assert car_means(errors, "e") == pytest.approx({"x": 4.0, "y": 3.0})


def test_files_beside_a_drive_become_mapping_and_vehicle():
    entries = [
        {"signal": "lateral_acceleration", "role": "sensor", "scale": -1.0},
        {"signal": "lateral_velocity", "role": "truth", "scale": 1.0},
        {"signal": "yaw_rate", "role": "aux", "scale": 1.0},
    ]
    place = {"topic": "/t", "field": "f", "stamp": "header.stamp", "offset": 0.5}
    mapping = beside_mapping({"signal": [entry | place for entry in entries]})
    assert (mapping["signals"].keys(), mapping["truth"].keys()) == ({"ay_m_s2"}, {"vy_m_s"})
    assert mapping["signals"]["ay_m_s2"] == place | {"scale": -1.0}
    given = {"name": "car", "mass_kg": 1500.0, "yaw_inertia_kg_m2": 2500.0, "lf_m": 1.2, "lr_m": 1.4}
    given |= {"cf_axle_n_per_rad": 9e4, "cr_axle_n_per_rad": 1.1e5, "friction_front": 0.9, "friction_rear": 0.94}
    vehicle = beside_vehicle({"vehicle": given})
    assert (vehicle["cg_to_rear_axle_m"], vehicle["friction"]) == (1.4, pytest.approx(0.92))
    assert vehicle["tyres"]["rear"] == {"cornering_stiffness_n_per_rad": 1.1e5}


def test_without_the_drives_it_writes_nothing_and_ends_with_0(monkeypatch, tmp_path: Path, capsys):
    monkeypatch.setattr(peers, "DRIVES", tmp_path / "absent")
    assert peers.main(["--out", str(tmp_path), "--results", str(tmp_path)]) == 0
    assert "needs ../shared" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_the_page_shows_the_stored_errors_of_every_drive():
    documents = json.loads((RESULTS / "peers" / "errors.json").read_text(encoding="utf-8"))
    assert [document["log"] for document in documents] == [drive.log for drive in PEER_DRIVES]
    parameters = json.loads((RESULTS / "peers" / "parameters.json").read_text(encoding="utf-8"))
    text = page([DriveErrors.of(d) for d in documents], pairs_table(parameters))
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == text
    assert sum(drive.group == FULL_SIZE for drive in PEER_DRIVES) == 9


def test_parameters_are_compared_between_drives_of_one_car():
    """Of three GTI drives stiffness and peak of one are 3 sigma off. The two logs of one V40 drive are no pair."""

    def of(log: str, factor: float):
        fitted = [
            {
                "name": n,
                "value": factor if n in (OF_CAR[0], PEAK) else 1.0,
                "prior": 1.0,
                "sd": 0.1,
                "log": n in (OF_CAR[0], PEAK),
                "excited": True,
            }
            for n in OF_CAR
        ]
        return {"log": log, "parameters": fitted}

    logs = ("niki_gti_1khz.mcap", "gti_pole_aa.mcap", "gti_low_speed.mcap", "lunda_v40", "v40_swd_gnss.mcap")
    off = float(np.exp(3.0 * np.hypot(0.1, 0.1)))
    rows = pairs_table([of(log, off if i == 0 else 1.0) for i, log in enumerate(logs)]).splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert cells[0] == [OF_CAR[0], "3", "33%", "2.45", "3", "33%"]
    assert cells[1] == [OF_CAR[1], "3", "100%", "0.00", "3", "100%"]
    assert cells[OF_CAR.index(PEAK)] == [PEAK, "3", "33%", "2.45", "3", "33%"]
    assert cells[-1][:3] == ["all", str(3 * len(OF_CAR)), f"{1.0 - 4.0 / (3 * len(OF_CAR)):.0%}"]
    assert cells[-1][-1] == f"{1.0 - 4.0 / (3 * len(OF_CAR)):.0%}"
