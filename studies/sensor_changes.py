"""Sensors that change in mid-drive: which planted changes are named, and how often a sound drive has one.

    python -m studies.sensor_changes [--hours 4] [--first 1000] [--sound]

A change is planted in the aligned signals of each recorded drive, at 60 % of its length, and in simulated roads of 60 s
and 300 s. ``--hours`` of other simulated roads and all recorded drives without a change count false alarms. ``named``:
the right sensor and kind, known within 2 s of the change; ``late``: after; ``truth``: by ground truth alone, to 2 s;
``other``: another sensor or kind; ``silent``: none. Frozen gyros and accelerometers are faulty samples
(``drive/sensor_faults.py``) and no changes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import correct_signals
from pdhef_logtool.drive.alignment import align
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.sensor_changes import SensorChange, find_changes
from pdhef_logtool.drive.truth import derive_truth, truth_at
from pdhef_logtool.drive.truth_steps import steps_from_truth
from pdhef_logtool.mapping import Mapping, read_signals
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.pages import DRIVES, ROOT
from studies.peers.drives import PEER_DRIVES, mapping_of, vehicle_of
from truthsim.drive import simulate_drive, write_drive

#: Name, signal, and the factor, the addend or the delay of a change; NaN freezes the signal.
PLANTED = {
    **{f"gyro {deg:g} deg/s": ("yaw_rate_rad_s", 1.0, np.radians(deg), 0.0) for deg in (0.5, 1.0, 2.0, -2.0)},
    **{f"gyro x {by}": ("yaw_rate_rad_s", by, 0.0, 0.0) for by in (0.9, 1.1)},
    **{f"a_y {by:g} m/s2": ("ay_m_s2", 1.0, by, 0.0) for by in (0.3, 0.6, 1.0)},
    **{f"a_y x {by}": ("ay_m_s2", by, 0.0, 0.0) for by in (0.85, 1.15)},
    **{f"speed x {by}": ("speed_m_s", by, 0.0, 0.0) for by in (0.95, 1.05)},
    "steering 1 deg": ("steer_rad", 1.0, np.radians(1.0), 0.0),
    "steering wheel 10 deg": ("steer_rad", 1.0, np.radians(10.0 / 16.0), 0.0),
    **{f"frozen {n.split('_')[0]}": (n, np.nan, 0.0, 0.0)
       for n in ("steer_rad", "speed_m_s")},
    **{f"delayed {n.split('_')[0]}": (n, 1.0, 0.0, 0.1)
       for n in ("steer_rad", "yaw_rate_rad_s", "ay_m_s2", "speed_m_s")},
}  # fmt: skip
#: Signals and ground truth of a drive.
Drive = tuple[Signals, StateTrack | None]
#: Place of a change in a drive, and the time in which it should be known.
PLACE, WITHIN_S = 0.6, 2.0


def aligned(log: Path, car: Car, mapping: Mapping | None = None) -> Drive:
    """Return signals and ground truth of a log as the search for changes receives them, [N]."""
    with read_drive(log, car, mapping) as drive:
        plan = drive.plan
        part = read_signals(drive.log, plan.mapping, plan.clocks, plan.start_ns, plan.end_ns)
    signals = without_impossible(correct_signals(align(part.signals, plan.alignment)[0], plan.vehicle))
    if plan.truth is None:
        return signals, None
    derived, low_m_s = derive_truth(part.truth, plan=plan.truth), plan.vehicle.standstill_m_s
    return signals, truth_at(derived, signals.stamps_ns, plan.truth_latency_s, standstill_m_s=low_m_s)


def changes_of(signals: Signals, truth: StateTrack | None) -> list[SensorChange]:
    """Return the changes that a run reports."""
    sound, changes = find_changes(signals)
    return [*changes, *(() if truth is None else steps_from_truth(sound, truth))]


def recorded() -> dict[str, Drive]:
    """Return the recorded drives."""
    return {d.log: aligned(DRIVES / d.log, Car.of(vehicle_of(d)), mapping_of(d)) for d in PEER_DRIVES}


def simulated(first: int, count: int, duration_s: float) -> Iterator[tuple[str, Drive]]:
    """Yield roads of consecutive seeds, a third of them wet."""
    car = Car.load(ROOT / "sample_logs" / "vehicle.toml")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + count):
            log = Path(folder) / f"{seed}.mcap"
            write_drive(
                simulate_drive("road", friction=(0.9, 0.9, 0.5)[seed % 3], seed=seed, duration_s=duration_s), log
            )
            yield f"road {seed}", aligned(log, car)
            log.unlink()


def changed(signals: Signals, at_ns: int, name: str, factor: float, addend: float, delay_s: float) -> Signals:
    """Return signals [N] of which one changes at a time."""
    column, late, since = getattr(signals, name), signals.stamps_ns >= at_ns, np.isfinite(getattr(signals, name))
    if np.isnan(factor):
        other = np.where(since, column[np.flatnonzero(late & since)[0]], np.nan)
    else:
        rows = np.searchsorted(signals.stamps_ns, signals.stamps_ns[since] - round(delay_s * 1e9))
        other = np.full(len(column), np.nan)
        held = column[since][np.clip(np.searchsorted(np.flatnonzero(since), rows, "right") - 1, 0, None)]
        other[since] = (held if delay_s else column[since]) * factor + addend
    wheels = signals.wheel_speed_m_s
    if name == "speed_m_s" and np.isfinite(wheels).any():  # the speed is that of the wheels
        columns = [
            changed(replace(signals, ay_m_s2=w), at_ns, "ay_m_s2", factor, addend, delay_s).ay_m_s2 for w in wheels.T
        ]
        wheels = np.stack(columns, axis=1)
    changed_columns: dict[str, Any] = {name: np.where(late, other, column), "wheel_speed_m_s": wheels}
    return replace(signals, **changed_columns)


def verdict(
    changes: Sequence[SensorChange], before: Sequence[SensorChange], at_ns: int, name: str, frozen: bool
) -> str:
    """Return what the changes of a drive with a planted one say; those that the drive has without it do not count."""
    known = {(c.sensor, c.start_ns) for c in before}
    new = [c for c in changes if (c.sensor, c.start_ns) not in known and c.known_ns > at_ns]
    if not new:
        return "silent"
    first = min(new, key=lambda c: c.known_ns)
    if first.sensor != name or (first.kind == "stuck") != frozen:
        return "other"
    if first.kind.endswith("from_truth"):
        return "truth" if abs(first.start_ns - at_ns) <= WITHIN_S * 1e9 else "other"
    return "named" if first.known_ns - at_ns <= WITHIN_S * 1e9 else "late"


def table(drives: dict[str, Drive]) -> dict[str, Counter[str]]:
    """Return the verdicts of each planted change on some drives."""
    counts: dict[str, Counter[str]] = {label: Counter() for label in PLANTED}
    for signals, truth in drives.values():
        before = changes_of(signals, truth)
        start, end = int(signals.stamps_ns[0]), int(signals.stamps_ns[-1])
        at_ns = start + round(PLACE * (end - start))
        for label, (name, *how) in PLANTED.items():
            if not np.isfinite(getattr(signals, name)[signals.stamps_ns >= at_ns]).any():
                continue
            found = changes_of(changed(signals, at_ns, name, *how), truth)
            counts[label][verdict(found, before, at_ns, name, bool(np.isnan(how[0])))] += 1
    return counts


def tell(title: str, counts: dict[str, Counter[str]]) -> None:
    """Print a table."""
    columns = ("named", "late", "truth", "other", "silent")
    print(f"\n{title:24s}" + "".join(f"{c:>7s}" for c in columns))
    for label, count in [*counts.items(), ("sum", sum(counts.values(), Counter[str]()))]:
        print(f"{label:24s}" + "".join(f"{count[c]:7d}" for c in columns), flush=True)


def false_alarms(drives: Iterator[tuple[str, Drive]]) -> None:
    """Print the changes of drives that have none, and the hours."""
    hours = 0.0
    for name, (signals, truth) in drives:
        hours += (int(signals.stamps_ns[-1]) - int(signals.stamps_ns[0])) / 3.6e12
        for c in changes_of(signals, truth):
            at_s = (c.start_ns - int(signals.stamps_ns[0])) * 1e-9
            print(f"{name}: {c.sensor} {c.kind} at {at_s:.2f} s by {c.size:.4g} ± {c.std:.2g}")
    print(f"{hours:.2f} h without a planted change", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=4.0, help="of sound simulated roads")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first road")
    parser.add_argument("--sound", action="store_true", help="sound drives alone")
    given = parser.parse_args(arguments)
    drives = recorded()
    false_alarms(iter(drives.items()))
    false_alarms(simulated(given.first, round(12 * given.hours), 300.0))
    if not given.sound:
        tell("recorded", table(drives))
        for duration_s in (60.0, 300.0):
            tell(f"roads of {duration_s:.0f} s", table(dict(simulated(given.first + 500, 12, duration_s))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
