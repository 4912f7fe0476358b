"""Small sound files of every table and CAN format, to be damaged: three seconds of one simulated drive each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from studies.strangers.containers import Topic, write
from studies.torture.seeds import START_NS

_STAMPS = START_NS + np.arange(150) * 20_000_000
_RATE = 0.3 * np.sin(np.arange(150) * 0.06)
_SPEED = 15.0 + np.arange(150) * 0.02
TOPICS = (
    Topic("/imu", "bus", _STAMPS, _STAMPS, {"accel_y [m/s^2]": _SPEED * _RATE, "yaw_rate [rad/s]": _RATE}),
    Topic("/car", "bus", _STAMPS, _STAMPS, {"speed [m/s]": _SPEED, "steering_angle [rad]": 0.2 * _RATE}),
)
#: Suffix and layouts of each format; a number after a version of MDF is its compression.
FORMATS: dict[str, tuple[str, tuple[str, ...]]] = {
    "csv": ("csv", ("csv", "csv-german", "csv-gps", "csv-lab", "csv-dated", "csv-sources", "csv-pipes", "csv-long")),
    "vbo": ("vbo", ("vbo",)),
    "parquet": ("parquet", ("parquet", "parquet-nested", "parquet-long")),
    "mat5": ("mat", ("mat", "mat-series", "mat-pairs", "mat-recorder")),
    "mat73": ("mat", ("mat-7.3",)),
    "mdf3": ("mdf", ("3.30 0",)),
    "mdf4": ("mf4", ("mdf", "4.11 2", "can-mdf")),
    "blf": ("blf", ("can-blf",)),
    "asc": ("asc", ("can-asc",)),
}


def table_seeds(name: str, folder: Path) -> list[bytes]:
    """Return the sound files of a format; a folder takes files in between."""
    return [_seed(layout, folder) for layout in FORMATS[name][1]]


def _seed(layout: str, folder: Path) -> bytes:
    version, _, compression = layout.partition(" ")
    path = write(TOPICS, folder / "seed", "mdf" if compression else layout)
    if compression:
        import asammdf

        with asammdf.MDF(path) as file, file.convert(version) as other:
            path = Path(other.save(folder / "other", overwrite=True, compression=int(compression)))
    return (next(path.glob("drive.*")) if path.is_dir() else path).read_bytes()
