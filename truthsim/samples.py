"""The sample logs of the repository: ``python -m truthsim.samples sample_logs`` makes them again, bit for bit.

Bit for bit on one machine; another processor's mathematics may differ in the last places of the floating-point values.
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

from pdhef_logtool.errors import OutputError
from truthsim.drive import Drive, simulate_drive, write_drive


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample log, and the vehicle file in the same folder that belongs to its road."""

    file: str
    manoeuvre: str
    speed_km_h: float
    friction: float
    seed: int
    vehicle: str

    def simulate(self) -> Drive:
        """Drive it."""
        return simulate_drive(self.manoeuvre, speed_km_h=self.speed_km_h, friction=self.friction, seed=self.seed)


SAMPLES = (
    Sample("dlc.mcap", "dlc", 100.0, 0.85, 1, "vehicle.toml"),
    Sample("sweep.mcap", "sine-sweep", 60.0, 0.30, 1, "vehicle_mu03.toml"),
    Sample("road.mcap", "road", 90.0, 0.85, 1, "vehicle.toml"),
)
MANIFEST = "manifest.toml"


def write_samples(folder: Path) -> None:
    """Write all sample logs and the manifest (command, seed, SHA-256, size, vehicle file) into a folder.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    lines = ["# Made by: python -m truthsim.samples sample_logs"]
    for sample in SAMPLES:
        path = folder / sample.file
        drive = sample.simulate()
        write_drive(drive, path)
        data = path.read_bytes()
        lines += [
            "",
            "[[log]]",
            f'file = "{sample.file}"',
            f'command = "{drive.command} -o {sample.file}"',
            f"seed = {sample.seed}",
            f'sha256 = "{hashlib.sha256(data).hexdigest()}"',
            f"size_bytes = {len(data)}",
            f'vehicle = "{sample.vehicle}"',
        ]
    temporary = folder / f".{MANIFEST}.part"
    try:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
        temporary.replace(folder / MANIFEST)
    except OSError as error:
        raise OutputError(
            expected="a writable folder", got=error.strerror or str(error), where=str(folder / MANIFEST)
        ) from error


if __name__ == "__main__":
    write_samples(Path(sys.argv[1] if len(sys.argv) > 1 else "sample_logs"))
