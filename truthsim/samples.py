"""The sample logs of the repository: ``python -m truthsim.samples sample_logs`` regenerates them, bit for bit.

This holds on one machine; results on another processor may differ in the last digits of floating-point values.
"""

import hashlib
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.storage.files import write_bytes
from truthsim.drive import Drive, simulate_drive, write_drive
from truthsim.faults import parse_fault


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample log, with the vehicle file in the same folder that matches its road.

    A ``file`` without a suffix is a rosbag2 folder (sqlite3).
    """

    file: str
    what: str
    manoeuvre: str
    speed_km_h: float
    friction: float
    seed: int
    vehicle: str = "vehicle.toml"
    duration_s: float | None = None
    faults: tuple[str, ...] = ()
    without: tuple[str, ...] = ()

    def simulate(self) -> Drive:
        """Simulate the drive."""
        return simulate_drive(
            self.manoeuvre,
            speed_km_h=self.speed_km_h,
            friction=self.friction,
            seed=self.seed,
            duration_s=self.duration_s,
            faults=[parse_fault(f) for f in self.faults],
        )


SAMPLES = (
    Sample("dlc.mcap", "the paper's manoeuvre A, a double lane change", "dlc", 100.0, 0.85, 1),
    Sample("sweep.mcap", "the paper's manoeuvre B, a sine sweep", "sine-sweep", 60.0, 0.30, 1, "vehicle_mu03.toml"),
    Sample("fishhook.mcap", "a fishhook", "fishhook", 80.0, 0.85, 1),
    Sample("step.mcap", "a step of the steering", "step-steer", 100.0, 0.85, 1),
    Sample("road.mcap", "five minutes of town, country and motorway", "road", 110.0, 0.85, 1),
    Sample(
        "faults.mcap",
        "a minute of road with faults of the sensors",
        "road",
        90.0,
        0.85,
        2,
        duration_s=60.0,
        faults=(
            "burst20:yaw_rate:5:8",
            "stuck:ay:12:14",
            "dropout:wheels:18:20",
            "flip:steer:24:26",
            "jump0.5:imu:30:31",
            "delay30:steering:36:39",
            "float:rtk:42:46",
            "lost:rtk:50:54",
        ),
    ),
    Sample("step_rosbag2", "a step of the steering as a rosbag2", "step-steer", 80.0, 0.85, 2),
    Sample(
        "no_truth.mcap",
        "banked bends, without any truth",
        "banked-road",
        80.0,
        0.85,
        1,
        duration_s=30.0,
        without=("rtk", "perfect"),
    ),
)
MANIFEST = "manifest.toml"


def write_sample(sample: Sample, folder: Path) -> str:
    """Write one sample log and return the command that regenerates it.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    drive = sample.simulate()
    command = " ".join([drive.command, *(f"--without {part}" for part in sample.without)])
    path = folder / sample.file
    if path.suffix:
        write_drive(drive, path, without=sample.without)
        return f"{command} -o {sample.file}"
    log = folder / f".{sample.file}.mcap"
    try:
        write_drive(drive, log, without=sample.without)
        convert_to_rosbag2(log, path)
    finally:
        log.unlink(missing_ok=True)
    return f"{command} -o {sample.file}.mcap, then rosbags: every message as it is"


def convert_to_rosbag2(log: Path, folder: Path) -> None:
    """Copy the messages of an MCAP file unchanged to a rosbag2 folder (sqlite3), replacing an existing one.

    Raises
    ------
    OutputError : the folder cannot be written.
    """
    from mcap.reader import make_reader
    from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    temporary = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        with log.open("rb") as stream, Writer(temporary, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections = {}
            for schema, channel, message in make_reader(stream).iter_messages():
                if channel.topic not in connections:
                    assert schema is not None
                    store.register(get_types_from_msg(schema.data.decode(), schema.name))
                    connections[channel.topic] = writer.add_connection(channel.topic, schema.name, typestore=store)
                writer.write(connections[channel.topic], message.log_time, message.data)
        # The writer names its files after the folder.
        for part in temporary.iterdir():
            part.rename(part.with_name(part.name.replace(temporary.name, folder.name)))
        metadata = temporary / "metadata.yaml"
        metadata.write_text(metadata.read_text(encoding="utf-8").replace(temporary.name, folder.name), encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    except (OSError, WriterError) as error:
        raise OutputError(expected="a folder for a rosbag2", got=str(error), where=str(folder)) from error


def digest(path: Path) -> tuple[str, int]:
    """Return SHA-256 and size in bytes of a file, or of the concatenated files of a folder by name."""
    data = b"".join(p.read_bytes() for p in sorted(path.iterdir())) if path.is_dir() else path.read_bytes()
    return hashlib.sha256(data).hexdigest(), len(data)


def write_samples(folder: Path) -> None:
    """Write all sample logs and the manifest (command, seed, SHA-256, size, vehicle file) into a folder.

    Raises
    ------
    OutputError : a file cannot be written.
    """
    lines = ["# Made by: python -m truthsim.samples sample_logs"]
    for sample in SAMPLES:
        command = write_sample(sample, folder)
        sha256, size = digest(folder / sample.file)
        lines += [
            "",
            "[[log]]",
            f'file = "{sample.file}"',
            f'what = "{sample.what}"',
            f'command = "{command}"',
            f"seed = {sample.seed}",
            f'sha256 = "{sha256}"',
            f"size_bytes = {size}",
            f'vehicle = "{sample.vehicle}"',
        ]
    write_bytes(folder / MANIFEST, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    write_samples(Path(sys.argv[1] if len(sys.argv) > 1 else "sample_logs"))
