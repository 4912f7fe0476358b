"""Small sound files of every table and CAN format, to be damaged: three seconds of one simulated drive each."""

from __future__ import annotations

import io
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from studies.torture.seeds import START_NS

_T = np.arange(150) * 0.02
_RATE = 0.3 * np.sin(3.0 * _T)
#: Columns with their units in the names.
COLUMNS = {
    "time [s]": _T, "speed [m/s]": 15.0 + _T, "accel_y [m/s^2]": 15.0 * _RATE, "yaw_rate [rad/s]": _RATE,
    "steering_angle [rad]": 0.2 * _RATE, "lateral_velocity [m/s]": -0.1 * _RATE,
}  # fmt: skip
_NAMES = [title.partition(" ")[0] for title in COLUMNS]


def csv() -> bytes:
    """Return a CSV file with units in its head."""
    rows = [",".join(f"{v:.5f}" for v in row) for row in zip(*COLUMNS.values(), strict=True)]
    return "\n".join([",".join(COLUMNS), *rows, ""]).encode()


def vbo() -> bytes:
    """Return a file of a VBOX."""
    head = (
        "File created on 01/05/2024 @ 12:00\n\n[header]\nsatellites\ntime\nlatitude\nlongitude\nvelocity kmh\nheading\n"
    )
    head += (
        "Y_Accel\nYawRate\n\n[channel units]\ng\n°/s\n\n[column names]\nsats time lat long velocity heading\n\n[data]\n"
    )
    rows = [
        f"018 12000{t:.3f} +3608.246{i % 10} -1086.979{i % 10} {54.0 + t:07.3f} 231.56 {r:+.6E} {9.0 * r:+.6E}"
        for i, (t, r) in enumerate(zip(_T, _RATE, strict=True))
    ]
    return (head + "\n".join([*rows, ""])).replace("\n", "\r\n").encode("latin-1")


def parquet() -> bytes:
    """Return a Parquet file of two row groups."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = io.BytesIO()
    pq.write_table(pa.table(dict(COLUMNS)), file, row_group_size=100)
    return file.getvalue()


def mat5() -> bytes:
    """Return a compressed MAT file with a struct."""
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(file, {"car": dict(zip(_NAMES, COLUMNS.values(), strict=True)), "note": "text"}, do_compression=True)
    return file.getvalue()


def mat73() -> bytes:
    """Return a MAT file of version 7.3, which is HDF5 behind a head of 512 bytes."""
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as target:
        for name, values in zip(_NAMES, COLUMNS.values(), strict=True):
            target.create_dataset(f"car/{name}", data=values[None], compression="gzip", chunks=(1, 50))
    return b"MATLAB 7.3 MAT-file, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM" + bytes(384) + file.getvalue()[512:]


def mdf(version: str, compression: int, folder: Path) -> bytes:
    """Return an MDF file with a group of channels and one of another rate."""
    import asammdf

    signals = [asammdf.Signal(v, _T, name=n) for n, v in zip(_NAMES[1:], list(COLUMNS.values())[1:], strict=True)]
    conversion = {"a": 0.5, "b": 1.0}
    with asammdf.MDF(version=version) as target:
        target.append(signals, comment="car", common_timebase=True)
        raw = np.arange(30, dtype=np.int16)
        target.append([asammdf.Signal(raw, _T[::5], name="Temperature", unit="K", conversion=conversion)])
        return Path(target.save(folder / "seed", overwrite=True, compression=compression)).read_bytes()


def can_log(suffix: str, folder: Path) -> bytes:
    """Return frames of two identifiers as a BLF or ASC file."""
    import can

    path = folder / f"seed.{suffix}"
    with can.Logger(path) as target:
        for t, rate in zip(_T, _RATE, strict=True):
            data = round(1000 * rate).to_bytes(2, "little", signed=True) + bytes(6)
            for k in (0, 1):
                target(can.Message(START_NS / 1e9 + t + 1e-3 * k, 0x100 + k, False, data=data, channel=1))
    return path.read_bytes()


#: What makes each seed, given a folder for files in between, by the name of its format.
TABLE_SEEDS: dict[str, Any] = {
    "csv": lambda _: csv(),
    "vbo": lambda _: vbo(),
    "parquet": lambda _: parquet(),
    "mat": lambda _: mat5(),
    "mat73": lambda _: mat73(),
    "mdf": partial(mdf, "3.30", 0),
    "mf4": partial(mdf, "4.10", 0),
    "mf4dz": partial(mdf, "4.11", 2),
    "blf": partial(can_log, "blf"),
    "asc": partial(can_log, "asc"),
}
