"""Eight kinds of mistakes in a mapping x every signal: how many are named with the right remedy.

``python -m studies.mapping_mistakes [LOG ...]`` counts them over logs, by default the sample logs;
``--simulated COUNT SEED SECONDS`` counts them over simulated drives: all manoeuvres, random cars of three classes,
hills and banks included, every second one with its vehicle file, for so much processor time at most; ``--sound COUNT
SEED SECONDS`` counts failed checks and corrections of such drives instead. A mistake is *named* if a failed check of
its signal has the factor or the axis that undoes it in its remedy, *refused* if a mapping file with it is, *stopped* if
a check of its signal fails with another remedy, *silent* if its checks pass, and *other* if another signal fails
instead. If they are undecided it is *not checkable* where each states what the drive lacks, and the right mapping does
not pass either; else *open*.
"""

from __future__ import annotations

import itertools
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.mounting import scaled_source, survey_log
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, auto_map, fit_clocks
from pdhef_logtool.mapping.mapping_file import contradictions
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import PdhefError
from studies.drawn_cars import FIT_FRICTION, fit_vehicle
from studies.peers.drives import PEER_DRIVES, mapping_of, vehicle_of
from truthsim.drive import simulate_drive, write_drive
from truthsim.manoeuvres import MANOEUVRES
from truthsim.vehicle_choice import choose_vehicle

#: What a mapping's scale is wrong by, or for an axis the one that is read instead.
_UNITS = {"57.3": 57.3, "9.81": 9.81, "3.6": 3.6}
FACTORS = {f"x{n}": f for n, f in _UNITS.items()} | {f"/{n}": 1.0 / f for n, f in _UNITS.items()} | {"sign": -1.0}
AXIS = "axis"
KINDS = (*FACTORS, AXIS)
SAMPLES = ("dlc", "fishhook", "step", "sweep", "road")
#: Read instead of a signal; two axes of an accelerometer, and of a velocity, are exchanged.
EXCHANGED = {"ax_m_s2", "ay_m_s2", "truth.vx_m_s", "truth.vy_m_s"}
OTHER = {
    "ax_m_s2": "ay_m_s2",
    "ay_m_s2": "ax_m_s2",
    "yaw_rate_rad_s": "ay_m_s2",
    "steer_rad": "yaw_rate_rad_s",
    "steering_wheel_rad": "yaw_rate_rad_s",
    "speed_m_s": "yaw_rate_rad_s",
    "wheel_speeds": "yaw_rate_rad_s",
    "truth.vx_m_s": "truth.vy_m_s",
    "truth.vy_m_s": "truth.vx_m_s",
    "truth.yaw_rate_rad_s": "truth.vy_m_s",
    "truth.sideslip_rad": "truth.yaw_rate_rad_s",
}
_UNDOES = re.compile(r"scale(?: in the mapping)?(?: by| =) ([-+.\de]+)")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the checks state of one mistake: ``verdict`` as in the module, and the failed or undecided checks."""

    log: str
    signal: str
    kind: str
    verdict: str
    checks: tuple[Check, ...]


def subjects(mapping: Mapping) -> list[str]:
    """Return the signals that can be mistaken: the wheel speeds are one."""
    names = [n for n in mapping.signals if n in OTHER]
    wheels = ["wheel_speeds"] if any(n.startswith("wheel_speed_") for n in mapping.signals) else []
    return names + wheels + [f"truth.{n}" for n in mapping.truth if f"truth.{n}" in OTHER]


def _members(mapping: Mapping, subject: str) -> list[str]:
    return [n for n in mapping.signals if n.startswith("wheel_speed_")] if subject == "wheel_speeds" else [subject]


def _source(mapping: Mapping, name: str) -> SignalSource | None:
    return mapping.truth.get(name[6:]) if name.startswith("truth.") else mapping.signals.get(name)


def mistaken(mapping: Mapping, subject: str, kind: str) -> Mapping | None:
    """Return a mapping file's mapping with a mistake; None where the log lacks the axis, or nothing changes."""
    signals, truth = dict(mapping.signals), dict(mapping.truth)
    for name in _members(mapping, subject):
        source = _source(mapping, name)
        assert source is not None
        if kind == "sign" and source.combine == "norm":
            return None  # the size of a vector
        if kind == AXIS:
            other = _source(mapping, OTHER[subject])
            if other is None:
                return None
            wrong = replace(other, name=source.name)
            if subject in EXCHANGED:
                (truth if name.startswith("truth.") else signals)[other.name] = replace(source, name=other.name)
        else:
            wrong = scaled_source(source, FACTORS[kind])
        (truth if name.startswith("truth.") else signals)[wrong.name] = wrong
    return replace(mapping, signals=signals, truth=truth, origin="file")


def _decided(names: Iterable[str]) -> set[str]:
    return {f"{n}.{aspect}" for n in names for aspect in ("sign", "unit", "axis")}


def verdict(checks: Sequence[Check], members: Sequence[str], subject: str, kind: str, scale: float) -> str:
    """Return what checks state of a mistake, as in the module."""
    related = set(members) | ({"truth.sideslip_rad"} if subject == "truth.vy_m_s" else set())
    mine = [c for c in checks if c.subject in related]
    failed = [c for c in mine if c.verdict == "failed"]
    if failed:
        if kind == AXIS:
            right = any(c.name.endswith((".axis", ".mounting")) for c in failed)
        else:
            found = [float(m[1]) for c in failed for m in _UNDOES.finditer(c.remedy)]
            wanted = (1.0 / FACTORS[kind], scale)
            right = any(abs(f / w - 1.0) < 0.05 for f in found[:1] for w in wanted)
        return "named" if right else "stopped"
    others = {c.subject for c in checks if c.verdict == "failed" and c.subject not in related}
    if others:
        return "other"
    decided = [c for c in mine if c.name in _decided(related)]
    return "open" if not decided or any(c.verdict == "undecided" for c in decided) else "silent"


def outcomes(path: Path, vehicle: VehicleParameters, mapping: Mapping | None = None) -> Iterator[Outcome]:
    """Yield what the checks state of every mistake over a log."""
    log = open_log(path)
    try:
        right = auto_map(log).mapping if mapping is None else mapping
        sound = {c.name: str(c.verdict) for c in _checks(log, replace(right, origin="file"), vehicle)}
        for subject in subjects(right):
            for kind in KINDS:
                yield from _outcome(log, right, subject, kind, vehicle, sound)
    finally:
        log.close()


def _checks(log: DriveLog, mapping: Mapping, vehicle: VehicleParameters) -> tuple[Check, ...]:
    span_ns = (log.start_ns, log.end_ns)
    return survey_log(log, mapping, fit_clocks(log, mapping, *span_ns), span_ns, vehicle).checks


def _outcome(
    log: DriveLog, right: Mapping, subject: str, kind: str, vehicle: VehicleParameters, sound: dict[str, str]
) -> Iterator[Outcome]:
    wrong = mistaken(right, subject, kind)
    if wrong is None:
        return
    members = _members(right, subject)
    is_refused = bool(contradictions(wrong))
    checks = () if is_refused else _checks(log, wrong, vehicle)
    checks = tuple(c for c in checks if not c.verdict == sound.get(c.name) == "failed")
    scale = getattr(_source(right, members[0]), "scale", 1.0)
    stated = verdict(checks, members, subject, kind, scale if isinstance(scale, float | int) else 1.0)
    if stated == "open":
        aspect = kind if kind == "sign" else "unit"
        doubts = [c.remedy for c in checks if c.verdict == "undecided" and c.name in _decided(members)]
        is_shown = any(sound.get(f"{m}.{aspect}") == "passed" for m in members)
        stated = "open" if is_shown or not all(d.startswith("needs ") for d in doubts) else "not checkable"
    shown = tuple(c for c in checks if c.verdict != "passed")
    yield Outcome(Path(str(log.path)).stem, subject, kind, "refused" if is_refused else stated, shown)


#: Cars of the simulated drives, each in random variants; their speeds over a manoeuvre's own, friction, longest drive.
CLASSES = ("sedan", "suv", "hatchback")
SPEED_FACTORS, FRICTIONS, LONGEST_S = (0.7, 1.1), (0.4, 1.0), 60.0


def drawn_drives(count: int, seed: int, limit_s: float, longest_s: float) -> Iterator[tuple[str, str, Path]]:
    """Simulate drives and yield each in words, with its car and the log.

    Parameters
    ----------
    limit_s : of processor time. longest_s : of a drive, s.
    """
    rng, drives = np.random.default_rng(seed), 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        for i in itertools.count():
            if drives >= count or time.process_time() > limit_s:
                return
            name = sorted(MANOEUVRES)[i % len(MANOEUVRES)]
            manoeuvre, drawn = MANOEUVRES[name], int(rng.integers(1, 2**31))
            car = f"{CLASSES[(i + i // len(MANOEUVRES)) % len(CLASSES)]}~{drawn}"
            speed, friction = manoeuvre.speed_km_h * rng.uniform(*SPEED_FACTORS), float(rng.uniform(*FRICTIONS))
            shorter_s = longest_s if (manoeuvre.duration_s or 0.0) > longest_s else None
            try:
                drive = simulate_drive(
                    name, speed_km_h=speed, friction=friction, seed=drawn, duration_s=shorter_s,
                    vehicle=choose_vehicle(car), vehicle_name=car,
                )  # fmt: skip
            except PdhefError:  # it would spin, or the course is too fast for this car
                continue
            path.unlink(missing_ok=True)
            write_drive(drive, path, steering_wheel=drives % 4 > 1)
            drives += 1
            yield f"{name} {car} {speed:.1f} km/h, friction {friction:.2f}", car, path


def sound_drives(count: int, seed: int, limit_s: float) -> Counter[str]:
    """Count simulated drives, those with a failed check and those with a correction; print the checks of both."""
    counts: Counter[str] = Counter()
    for words, _, path in drawn_drives(count, seed, limit_s, LONGEST_S):
        log = open_log(path)
        failed = [c for c in _checks(log, auto_map(log).mapping, default_vehicle()) if c.verdict == "failed"]
        log.close()
        counts += Counter({"drives": 1, "with a failed check": bool(failed)})
        counts["corrected"] += any(c.name.endswith(".corrected") for c in failed)
        for check in failed:
            print(f"{words}: {check.name}: {check.evidence}")
    return counts


def simulated_mistakes(count: int, seed: int, limit_s: float, *, verbose: bool) -> Counter[str]:
    """Count the outcomes over simulated drives."""
    counts: Counter[str] = Counter()
    for i, (words, car, path) in enumerate(drawn_drives(count, seed, limit_s, 1.5 * LONGEST_S)):
        vehicle = fit_vehicle(choose_vehicle(car), FIT_FRICTION, default_vehicle()) if i % 2 else default_vehicle()
        of_drive = count_outcomes(outcomes(path, vehicle), verbose=verbose)
        print(f"{words}, {'with' if i % 2 else 'without'} a vehicle file: {dict(of_drive)}", flush=True)
        counts += of_drive
    return counts


def recorded_mistakes(path: Path, *, verbose: bool) -> Counter[str]:
    """Count the outcomes over a log: of a peer with its vehicle and mapping, else with the vehicle file beside it."""
    peer = next((d for d in PEER_DRIVES if d.log == path.name), None)
    if peer is not None:
        return count_outcomes(
            outcomes(path, vehicle_of(peer, path.parent), mapping_of(peer, path.parent)), verbose=verbose
        )
    vehicle = path.parent / ("vehicle_mu03.toml" if path.stem == "sweep" else "vehicle.toml")
    return count_outcomes(
        outcomes(path, Car.load(vehicle).vehicle if vehicle.exists() else default_vehicle()), verbose=verbose
    )


def count_outcomes(found: Iterable[Outcome], *, verbose: bool) -> Counter[str]:
    """Count outcomes by verdict and print those that are not named."""
    counts: Counter[str] = Counter()
    for outcome in found:
        counts[outcome.verdict] += 1
        if outcome.verdict not in ("named", "refused"):
            print(f"{outcome.log} {outcome.signal} {outcome.kind}: {outcome.verdict}", flush=True)
            for check in outcome.checks if verbose else ():
                print(f"    {check.verdict} {check.name}: {check.evidence}; {check.remedy}")
    return counts


def main(arguments: Sequence[str]) -> int:
    """Count the outcomes over logs and print those that are not named."""
    warnings.simplefilter("error", RuntimeWarning)
    verbose, words = "-v" in arguments, [a for a in arguments if a != "-v"]
    if words[:1] == ["--sound"]:
        of_sound = sound_drives(int(words[1]), int(words[2]), float(words[3]))
        print(", ".join(f"{n} {what}" for what, n in of_sound.items()))
        return 0
    if words[:1] == ["--simulated"]:
        counts = simulated_mistakes(int(words[1]), int(words[2]), float(words[3]), verbose=verbose)
    else:
        samples = [Path(__file__).parents[1] / "sample_logs" / f"{name}.mcap" for name in SAMPLES]
        paths = [Path(w) for w in words] or samples
        counts = sum((recorded_mistakes(p, verbose=verbose) for p in paths), Counter())
    total = counts.total()
    print(f"{total} mistakes: " + ", ".join(f"{n} {v} ({n / total:.1%})" for v, n in counts.most_common()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
