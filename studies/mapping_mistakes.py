"""Eight kinds of mistakes in a mapping x every signal: how many are named with the right remedy.

``python -m studies.mapping_mistakes [LOG ...]`` counts them over logs, by default the sample logs;
``--sound COUNT SEED SECONDS`` counts failed checks and corrections over sound simulated drives instead: all manoeuvres,
random cars of three classes, hills and banks included, for so much processor time at most. A mistake is *named* if a
failed check of its signal has the factor or the axis that undoes it in its remedy, *refused* if a mapping file with it
is, *stopped* if a check of its signal fails with another remedy, *open* if the checks of its signal are undecided,
*silent* if they pass, and *other* if another signal fails instead.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
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
    decided = [c for c in mine if c.name.endswith((".sign", ".unit", ".axis"))]
    return "open" if not decided or any(c.verdict == "undecided" for c in decided) else "silent"


def outcomes(path: Path, vehicle: VehicleParameters, mapping: Mapping | None = None) -> Iterator[Outcome]:
    """Yield what the checks state of every mistake over a log."""
    log = open_log(path)
    try:
        right = auto_map(log).mapping if mapping is None else mapping
        for subject in subjects(right):
            for kind in KINDS:
                yield from _outcome(log, right, subject, kind, vehicle)
    finally:
        log.close()


def _outcome(log: DriveLog, right: Mapping, subject: str, kind: str, vehicle: VehicleParameters) -> Iterator[Outcome]:
    wrong = mistaken(right, subject, kind)
    if wrong is None:
        return
    span_ns, members = (log.start_ns, log.end_ns), _members(right, subject)
    is_refused = bool(contradictions(wrong))
    checks = () if is_refused else survey_log(log, wrong, fit_clocks(log, wrong, *span_ns), span_ns, vehicle).checks
    scale = getattr(_source(right, members[0]), "scale", 1.0)
    stated = verdict(checks, members, subject, kind, scale if isinstance(scale, float | int) else 1.0)
    shown = tuple(c for c in checks if c.verdict != "passed")
    yield Outcome(Path(str(log.path)).stem, subject, kind, "refused" if is_refused else stated, shown)


#: Cars of the sound drives, each in random variants; their speeds over a manoeuvre's own, friction, and longest drive.
CLASSES = ("sedan", "suv", "hatchback")
SPEED_FACTORS, FRICTIONS, LONGEST_S = (0.7, 1.1), (0.4, 1.0), 60.0


def sound_drives(count: int, seed: int, limit_s: float) -> Counter[str]:
    """Count drives, those with a failed check and those with a correction; print the checks of both.

    Parameters
    ----------
    limit_s : of processor time.
    """
    counts: Counter[str] = Counter()
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        while counts["drives"] < count and time.process_time() < limit_s:
            i = counts["drives"] + counts["not simulated"]
            name = sorted(MANOEUVRES)[i % len(MANOEUVRES)]
            manoeuvre, drawn = MANOEUVRES[name], int(rng.integers(1, 2**31))
            car = f"{CLASSES[i // len(MANOEUVRES) % len(CLASSES)]}~{drawn}"
            speed, friction = manoeuvre.speed_km_h * rng.uniform(*SPEED_FACTORS), float(rng.uniform(*FRICTIONS))
            longest_s = min(manoeuvre.duration_s or LONGEST_S, LONGEST_S)
            shorter_s = longest_s if (manoeuvre.duration_s or 0.0) > LONGEST_S else None
            try:
                drive = simulate_drive(
                    name, speed_km_h=speed, friction=friction, seed=drawn, duration_s=shorter_s,
                    vehicle=choose_vehicle(car), vehicle_name=car,
                )  # fmt: skip
            except PdhefError:  # it would spin, or the course is too fast for this car
                counts["not simulated"] += 1
                continue
            path.unlink(missing_ok=True)
            write_drive(drive, path)
            log = open_log(path)
            mapping = auto_map(log).mapping
            clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
            checks = survey_log(log, mapping, clocks, (log.start_ns, log.end_ns)).checks
            log.close()
            failed = [c for c in checks if c.verdict == "failed"]
            counts += Counter({"drives": 1, "with a failed check": bool(failed)})
            counts["corrected"] += any(c.name.endswith(".corrected") for c in failed)
            for check in failed:
                print(f"{name} {car} {speed:.1f} km/h, friction {friction:.2f}: {check.name}: {check.evidence}")
    return counts


def main(arguments: Sequence[str]) -> int:
    """Count the outcomes over logs and print those that are not named."""
    warnings.simplefilter("error", RuntimeWarning)
    if arguments[:1] == ["--sound"]:
        of_sound = sound_drives(int(arguments[1]), int(arguments[2]), float(arguments[3]))
        print(", ".join(f"{n} {what}" for what, n in of_sound.items()))
        return 0
    samples = Path(__file__).parents[1] / "sample_logs"
    counts: Counter[str] = Counter()
    for path in [Path(a) for a in arguments if a != "-v"] or [samples / f"{name}.mcap" for name in SAMPLES]:
        peer = next((d for d in PEER_DRIVES if d.log == path.name), None)
        vehicle = path.parent / ("vehicle_mu03.toml" if path.stem == "sweep" else "vehicle.toml")
        car = Car.load(vehicle).vehicle if vehicle.exists() else default_vehicle()
        car = car if peer is None else vehicle_of(peer, path.parent)
        for found in outcomes(path, car, None if peer is None else mapping_of(peer, path.parent)):
            counts[found.verdict] += 1
            if found.verdict not in ("named", "refused"):
                print(f"{found.log} {found.signal} {found.kind}: {found.verdict}")
                for check in found.checks if "-v" in arguments else ():
                    print(f"    {check.verdict} {check.name}: {check.evidence}; {check.remedy}")
    total = counts.total()
    print(f"{total} mistakes: " + ", ".join(f"{n} {v} ({n / total:.1%})" for v, n in counts.most_common()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
