"""Compare this tool with published sideslip estimators on every recorded drive with ground truth: ``docs/peers.md``.

    python -m studies.peers [--out docs] [--results studies/results/peers]

All estimators get the same published vehicle file and the same mapped and aligned signals. Ground truth is used for
scores only. The drives are in ``../shared`` and may not be redistributed: without them the command ends with 0 and
writes nothing.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl

from pdhef_logtool.car.toml_files import vehicle_toml
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.mapping import Mapping, mapping_to_toml
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.results.opened_run import ESTIMATES_FILE
from pdhef_logtool.runs.config import Calibrate, RunConfig
from pdhef_logtool.runs.fleet import run_logs
from studies.pages import DOCS, DRIVES, RESULTS, options, write
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, read_peer_drive, vehicle_of
from studies.peers.models import Peer, open_loop, peers_of
from studies.peers.page import OURS, page
from studies.peers.parameters import pairs_table, parameters_of_drive
from studies.peers.scoring import DriveErrors, score, usable_sideslip

SEDAN = "open-loop-sedan"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and score all estimators; write page and results."""
    parser = options("peers", __doc__)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of peers.md")
    parser.add_argument(
        "--results", type=Path, default=RESULTS / "peers", help="folder of errors.json and parameters.json"
    )
    given = parser.parse_args(arguments)
    if not DRIVES.is_dir():
        print("nothing is compared: needs ../shared beside the repository")
        return 0
    documents = [drive_errors(drive).document() for drive in PEER_DRIVES]
    write(given.results / "errors.json", json.dumps(documents, indent=1) + "\n")
    parameters = [found for drive in PEER_DRIVES if (found := parameters_of_drive(drive)) is not None]
    write(given.results / "parameters.json", json.dumps(parameters, indent=1) + "\n")
    write(given.out / "peers.md", page([DriveErrors.of(document) for document in documents], pairs_table(parameters)))
    return 0


def drive_errors(drive: PeerDrive) -> DriveErrors:
    """Run all estimators on a drive and score them."""
    log, mapping, vehicle = DRIVES / drive.log, mapping_of(drive), vehicle_of(drive)
    read = read_peer_drive(log, vehicle, mapping)
    with_sedan = read_peer_drive(log, default_vehicle(), mapping)
    estimates = peer_estimates(read.signals, with_sedan.signals, vehicle)
    runs: dict[tuple[Calibrate, str], dict[str, tuple[FloatArray, FloatArray]]] = {}
    stds: dict[str, FloatArray] = {}
    missing = np.full(len(read.signals), np.nan)
    for name, (calibrate, car, preset) in OURS.items():
        if (calibrate, car) not in runs:
            given = vehicle if car == "file" else None
            runs[calibrate, car] = tool_estimates(log, mapping, given, calibrate, read.signals.stamps_ns)
        estimates[name], stds[name] = runs[calibrate, car].get(preset, (missing, missing))
    assert read.truth is not None
    errors = score(drive, estimates, read.truth, stds)
    print(drive.log, {name: round(value, 3) for name, value in errors.rmse_deg.items()}, file=sys.stderr)
    return errors


def peer_estimates(signals: Signals, with_sedan: Signals, vehicle: VehicleParameters) -> dict[str, FloatArray]:
    """Return the sideslip [N] of the peers by name, from signals read with the vehicle and with the default sedan."""
    runs = [(peer, signals) for peer in peers_of(vehicle)]
    runs.insert(-2, (Peer(SEDAN, open_loop, default_vehicle()), with_sedan))
    return {peer.name: usable_sideslip(run_window(peer, given)[0]) for peer, given in runs}


def tool_estimates(
    log: Path, mapping: Mapping, vehicle: VehicleParameters | None, calibrate: Calibrate, stamps_ns: IntArray
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return sideslip and its standard deviation of a default ``pdhef run`` by estimator, at the stamps [N].

    Nothing if the run refuses.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "mapping.toml").write_text(mapping_to_toml(mapping), encoding="utf-8")
        car = None
        if vehicle is not None:
            car = folder / "vehicle.toml"
            car.write_text(vehicle_toml(vehicle), encoding="utf-8")
        config = RunConfig(
            car=car,
            mapping=folder / "mapping.toml",
            annotate="none",
            keep="estimates",
            calibrate=calibrate,
        )
        try:
            result = run_logs([str(log)], folder / "out", config, report=False).results[0]
        except PdhefError as error:
            print(f"{log.name}: {error}", file=sys.stderr)
            return {}
        if result.output is None:
            print(f"{log.name}: {result.outcome.failed}", file=sys.stderr)
            return {}
        table = pl.read_parquet(result.output / ESTIMATES_FILE)
    tracks = {}
    for (estimator,), rows in table.group_by("estimator"):
        usable = rows.filter(pl.col("valid"))
        at_stamps = np.full((2, len(stamps_ns)), np.nan)
        index = np.searchsorted(stamps_ns, usable["stamp_ns"].to_numpy())
        at_stamps[:, index] = usable["sideslip_rad"].to_numpy(), usable["sideslip_std_rad"].to_numpy()
        tracks[str(estimator)] = at_stamps[0], at_stamps[1]
    return tracks


if __name__ == "__main__":
    sys.exit(main())
