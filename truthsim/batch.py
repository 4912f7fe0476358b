"""Simulate many drives in processes, with a manifest that does not depend on the number of processes.

A drive on disk that matches its manifest entry is kept, so that an interrupted batch can be resumed.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.errors import PdhefError, SimulationError, UsageError
from pdhef_logtool.records.version import __version__
from pdhef_logtool.storage.files import write_bytes, writing
from pdhef_logtool.workers.supervisor import Tell, supervise
from truthsim.drive import DEFAULT_VEHICLE, Drive, simulate_drive, write_drive
from truthsim.faults import parse_fault
from truthsim.manoeuvres import GRAVITY_M_S2
from truthsim.sensors import SIGNED, SensorNoise
from truthsim.vehicle_choice import choose_vehicle

MANIFEST = "manifest.json"
#: Bins of |a_y| over μ g (docs/method.md#evaluation): lower limit by name.
BINS: dict[str, float] = {"low": 0.0, "middle": 0.3, "high": 0.6}
#: Number of drives between updates of the manifest, from which an interrupted batch is resumed.
_SAVE_EVERY = 25
#: Maximum number of lost drives in an error.
_TOLD = 5


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """Input of a drive; ``vehicle`` and ``faults`` as on the command line."""

    manoeuvre: str
    speed_km_h: float
    friction: float
    seed: int
    duration_s: float
    amplitude: float = 1.0
    vehicle: str = DEFAULT_VEHICLE
    faults: tuple[str, ...] = ()
    sensors: tuple[tuple[str, float], ...] = ()
    without: tuple[str, ...] = ()
    keep_spins: bool = False

    def simulate(self) -> Drive:
        """Simulate the drive.

        Raises
        ------
        SimulationError : it cannot be driven, or the car spun.
        """
        return simulate_drive(
            self.manoeuvre,
            speed_km_h=self.speed_km_h,
            friction=self.friction,
            seed=self.seed,
            duration_s=self.duration_s,
            amplitude=self.amplitude,
            vehicle=choose_vehicle(self.vehicle),
            vehicle_name=self.vehicle,
            noise=sensor_noise(dict(self.sensors)),
            faults=[parse_fault(f) for f in self.faults],
            keep_spins=self.keep_spins,
        )


@dataclass(frozen=True, slots=True)
class Job:
    """One file of a batch, from the first candidate without loss of control; ``facts`` are added to its entry."""

    file: str
    candidates: tuple[DriveSpec, ...]
    facts: tuple[tuple[str, Any], ...] = ()

    @property
    def key(self) -> str:
        """Digest of all inputs of the file; an entry with another key is simulated again."""
        text = json.dumps([__version__, [asdict(c) for c in self.candidates]], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def sensor_noise(values: Mapping[str, float]) -> SensorNoise:
    """Return the usual sensors with some values changed.

    Raises
    ------
    UsageError
        A value does not exist, or is not finite.
    """
    unknown = [name for name in values if name not in SensorNoise._fields]
    if unknown:
        raise UsageError(
            expected=f"values of {', '.join(SensorNoise._fields)}", got=", ".join(unknown), where="--sensor"
        )
    wrong = [n for n, v in values.items() if not np.isfinite(v) or (v < 0.0 and n not in SIGNED)]
    if wrong:
        raise UsageError(expected="finite numbers of at least 0", got=", ".join(wrong), where="--sensor")
    return SensorNoise(**values)


def time_in_bins_s(drive: Drive) -> dict[str, float]:
    """Seconds of a drive in each bin of |a_y| over μ g."""
    share = np.abs(drive.truth["ay_m_s2"]) / (drive.truth["friction"] * GRAVITY_M_S2)
    place = np.digitize(share, list(BINS.values())[1:])
    step_s = float(drive.times_s[1] - drive.times_s[0])
    return {name: round(float(np.sum(place == i)) * step_s, 2) for i, name in enumerate(BINS)}


def make_drive(job: Job, folder: Path) -> dict[str, Any]:
    """Write the job's file and return its entry; if all candidates fail, it has the reasons but no ``sha256``."""
    dropped: list[dict[str, Any]] = []
    for spec in job.candidates:
        try:
            drive = spec.simulate()
        except SimulationError as error:
            dropped.append({"spec": asdict(spec), "reason": str(error)})
            continue
        path = folder / job.file
        write_drive(drive, path, without=spec.without)
        data = path.read_bytes()
        return {
            "file": job.file,
            **dict(job.facts),
            "command": " ".join([drive.command, *(f"--without {w}" for w in spec.without)]),
            **asdict(spec),
            "scale": drive.scale,
            "peak_ay_m_s2": drive.peak_ay_m_s2,
            "peak_share": drive.peak_ay_m_s2 / (drive.friction * GRAVITY_M_S2),
            "peak_sideslip_rad": drive.peak_sideslip_rad,
            "bins_s": time_in_bins_s(drive),
            "spun": drive.spun,
            "lifted": drive.lifted,
            "notes": list(drive.notes),
            "dropped": dropped,
            "key": job.key,
            "size_bytes": len(data),
            "sha256": hashlib.sha256(data).hexdigest(),
        }
    return {"file": job.file, **dict(job.facts), "dropped": dropped, "key": job.key}


def run_jobs(
    jobs: Sequence[Job],
    folder: Path,
    head: Mapping[str, Any],
    *,
    processes: int,
    progress: Callable[[str, float], None] | None = None,
    finish: Callable[[list[dict[str, Any]]], Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Write the files of the jobs to a folder, and ``manifest.json``; return the manifest.

    Parameters
    ----------
    head : first entries of the manifest.
    processes : number of processes; the result does not depend on it.
    finish : function from the entries of all drives to further entries of the manifest.

    Raises
    ------
    UsageError : ``processes`` is below 1.
    OutputError : the folder or a file cannot be written.
    SimulationError : the process of a drive crashed twice; all others are complete.
    """
    if processes < 1:
        raise UsageError(expected="at least one process", got=str(processes), where="--jobs")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    entries = _kept(jobs, folder)
    lost: list[str] = []
    todo = [i for i in range(len(jobs)) if i not in entries]
    made = supervise(partial(_made, folder), (jobs[i] for i in todo), jobs=processes, preload=[__name__])
    try:
        with closing(made):
            for done, ended in enumerate(made, start=1):
                if ended.failure is not None:
                    lost.append(f"{ended.item.file}: {ended.failure.reason}")
                elif isinstance(ended.result, PdhefError):
                    raise ended.result
                elif ended.result is not None:
                    entries[todo[ended.number]] = ended.result
                if progress is not None:
                    progress(f"{len(entries)} of {len(jobs)} drives", len(entries) / len(jobs))
                if done % _SAVE_EVERY == 0:
                    _write_manifest(folder, head, [entries[k] for k in sorted(entries)], complete=False)
    finally:
        ordered = [entries[k] for k in sorted(entries)]
        complete = len(ordered) == len(jobs)
        extra = finish(ordered) if finish is not None and complete else {}
        manifest = _write_manifest(folder, {**head, **extra}, ordered, complete=complete)
    if lost:
        raise SimulationError(
            expected=f"{len(jobs)} drives",
            got=f"{len(lost)} that were lost ({'; '.join(lost[:_TOLD])}{'; …' if len(lost) > _TOLD else ''})",
            where="--jobs",
            remedy="repeat the command to simulate the missing drives",
        )
    return manifest


def _made(folder: Path, job: Job, _tell: Tell) -> dict[str, Any] | PdhefError:
    try:
        return make_drive(job, folder)
    except PdhefError as error:
        return error


def _kept(jobs: Sequence[Job], folder: Path) -> dict[int, dict[str, Any]]:
    """Return the entries of an earlier manifest with unchanged files."""
    try:
        old = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["drives"]
        entries_by_file = {entry["file"]: entry for entry in old}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}
    kept: dict[int, dict[str, Any]] = {}
    for i, job in enumerate(jobs):
        entry = entries_by_file.get(job.file)
        path = folder / job.file
        if entry is None or entry.get("key") != job.key:
            continue
        wanted = entry.get("sha256")
        if wanted is None or (path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == wanted):
            kept[i] = {**entry, **dict(job.facts)}
    return kept


def _write_manifest(
    folder: Path, head: Mapping[str, Any], entries: list[dict[str, Any]], *, complete: bool
) -> dict[str, Any]:
    manifest = {"format": 1, **head, "complete": complete, "drives": entries}
    # Converted via JSON, so that a new manifest equals one that is read back.
    text = json.dumps(manifest, indent=1, allow_nan=False)
    write_bytes(folder / MANIFEST, (text + "\n").encode())
    return dict(json.loads(text))
