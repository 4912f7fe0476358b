"""Compare this tool with published sideslip estimators on every recorded drive with ground truth: ``docs/peers.md``.

    python -m studies.peers [--out docs] [--results studies/results/peers]

All estimators get the same published vehicle file and the same mapped and aligned signals. Ground truth is used for
scores only. The drives are in ``../shared`` and may not be redistributed. Without them, the command ends with 0 and
writes no file.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.records.signals import FloatArray, IntArray
from studies.gates.tool import Tool, reports
from studies.pages import DOCS, DRIVES, RESULTS, ROOT, options, write, write_toml
from studies.peers.drives import (
    PEER_DRIVES,
    PeerDrive,
    mapping_of,
    mapping_table,
    read_peer_drive,
    vehicle_of,
    vehicle_table,
)
from studies.peers.page import ESTIMATORS, OURS, page
from studies.peers.parameters import pairs_table
from studies.peers.scoring import DriveErrors, score


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and score all estimators; write page and results."""
    parser = options("peers", __doc__)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of peers.md")
    parser.add_argument(
        "--results", type=Path, default=RESULTS / "peers", help="folder of errors.json and parameters.json"
    )
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "peers")
    given = parser.parse_args(arguments)
    if not DRIVES.is_dir():
        print("nothing is compared: needs ../shared beside the repository")
        return 0
    tool, parameters, documents = Tool(ROOT, given.work.resolve()), list[dict[str, Any]](), []
    for drive in PEER_DRIVES:
        errors, calibration = drive_errors(drive, tool)
        documents.append(errors.document())
        if calibration and not calibration["refused"]:
            parameters.append({"log": drive.log, "parameters": calibration["parameters"]})
    write(given.results / "errors.json", json.dumps(documents, indent=1) + "\n")
    write(given.results / "parameters.json", json.dumps(parameters, indent=1) + "\n")
    write(given.out / "peers.md", page([DriveErrors.of(document) for document in documents], pairs_table(parameters)))
    return 0


def drive_errors(drive: PeerDrive, tool: Tool) -> tuple[DriveErrors, dict[str, Any] | None]:
    """Run all estimators on a drive; return their errors and the calibration with the published vehicle file."""
    read = read_peer_drive(DRIVES / drive.log, vehicle_of(drive), mapping_of(drive))
    assert read.truth is not None
    missing, calibration = np.full(len(read.signals), np.nan), None
    estimates: dict[str, FloatArray] = {}
    stds: dict[str, FloatArray] = {}
    runs: dict[tuple[str, str], dict[str, tuple[FloatArray, FloatArray]]] = {}
    for name, (model, car, preset) in ESTIMATORS.items():
        if (model, car) not in runs:
            folder = tool_run(tool, drive, model, car)
            runs[model, car] = {} if folder is None else tracks_of(folder, read.signals.stamps_ns)
            if folder is not None and (model, car) == ("auto", "file"):
                calibration = calibration_of(folder)
        estimates[name], std = runs[model, car].get(preset, (missing, missing))
        if name in OURS:
            stds[name] = std
    errors = score(drive, estimates, read.truth, stds)
    print(drive.log, {name: round(value, 3) for name, value in errors.rmse_deg.items()}, file=sys.stderr)
    return errors, calibration


@cache
def tool_run(tool: Tool, drive: PeerDrive, model: str, car: str) -> Path | None:
    """Run the estimators of a model and car with the published mapping and vehicle file; None if the run refuses."""
    name = f"{drive.log.partition('.')[0]}-{model}-{car}"
    mapping = write_toml(tool.work / "mappings" / f"{name}.toml", mapping_table(drive))
    presets = ",".join(preset for *run, preset in ESTIMATORS.values() if run == [model, car])
    given: tuple[str | Path, ...] = ("--mapping", mapping, "--keep", "estimates", "--estimators", presets)
    given += ("--model", earlier_model(tool, drive) if model == "earlier" else model)
    if car == "file":
        given += ("--car", write_toml(tool.work / "cars" / f"{name}.toml", vehicle_table(drive)))
    try:
        return tool.run(name, DRIVES / drive.log, *given)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return None


def earlier_model(tool: Tool, drive: PeerDrive) -> str | Path:
    """Return model.toml of the longest other drive with the same recorder and vehicle file; ``off`` without one."""
    models: list[tuple[float, Path]] = []
    for other in PEER_DRIVES:
        if other.drive == drive.drive or _recorder(other) != _recorder(drive):
            continue
        if (folder := tool_run(tool, other, "auto", "file")) is None:
            continue
        (report,) = reports(folder).values()
        if (calibration := report["self_calibration"]) and not calibration["refused"]:
            models.append((report["log"]["duration_s"], next(folder.glob("logs/*/model.toml"))))
    return max(models)[1] if models else "off"


def _recorder(drive: PeerDrive) -> tuple[object, ...]:
    vehicle = vehicle_of(drive).model_dump(exclude={"name"})
    return drive.car, mapping_table(drive)["signals"], vehicle


def calibration_of(folder: Path) -> dict[str, Any] | None:
    """Return the calibration of a run."""
    (report,) = reports(folder).values()
    calibration: dict[str, Any] | None = report["self_calibration"]
    return calibration


def tracks_of(folder: Path, stamps_ns: IntArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return sideslip and its standard deviation of the estimators of a run at the stamps [N]."""
    (file,) = folder.glob("logs/*/estimates.parquet")
    table = pl.read_parquet(file)
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
