"""Eight kinds of mistakes in a mapping × every signal: how many are named with the right remedy.

``python -m studies.mapping_mistakes [--car] [LOG ...]`` counts them over logs, by default the sample logs, as ``pdhef
inspect --mapping`` states them; with ``--car``, as ``pdhef run --car`` does with the published vehicle file of a
recorded drive. A mistake is *named* if a failed check of its signal has the factor or the axis that undoes it in its
remedy, *refused* if the mapping file is, *stopped* if a check of its signal fails with another remedy, *other* if
another signal fails instead, *silent* if its checks pass, and *open* if they are undecided.
"""

import copy
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool import PdhefError, inspect_log
from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping.mapping_file import load_mapping
from studies.gates.tool import Tool
from studies.pages import ROOT, options, read_toml, write_toml
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_table, vehicle_table

_UNITS = {"57.3": 57.3, "9.81": 9.81, "3.6": 3.6}
FACTORS = {f"x{n}": f for n, f in _UNITS.items()} | {f"/{n}": 1.0 / f for n, f in _UNITS.items()} | {"sign": -1.0}
AXIS = "axis"
VERDICTS = ("named", "refused", "stopped", "other", "silent", "open")
SAMPLES = ("dlc", "fishhook", "step", "sweep", "road")
#: The source that is read instead of a signal's; two axes of an accelerometer, and of a velocity, are exchanged.
OTHER: dict[str, str] = read_toml(Path(__file__).with_suffix(".toml"))
EXCHANGED = {"ax_m_s2", "ay_m_s2", "truth.vx_m_s", "truth.vy_m_s"}
_UNDOES = re.compile(r"scale(?: in the mapping)? (by|=) ([-+.\de]+)")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Verdict of the checks on one mistake, and the checks that did not pass."""

    log: str
    signal: str
    kind: str
    verdict: str
    checks: tuple[dict[str, Any], ...] = ()


def _place(name: str) -> tuple[str, str]:
    """Return the table of a mapping file and the name there."""
    return ("truth", name[6:]) if name.startswith("truth.") else ("signals", name)


def subjects(mapping: dict[str, Any]) -> list[str]:
    """Return the signals that can be mistaken: the wheel speeds are one."""
    return [name for name in OTHER if any(n.startswith(_place(name)[1]) for n in mapping[_place(name)[0]])]


def mistaken(mapping: dict[str, Any], subject: str, kind: str) -> dict[str, Any] | None:
    """Return a mapping file with a mistake; None if the log lacks the axis or the mistake has no effect."""
    wrong = copy.deepcopy(mapping)
    table, prefix = _place(subject)
    for name in [n for n in wrong[table] if n.startswith(prefix)]:
        source = wrong[table][name]
        if kind != AXIS:
            if kind == "sign" and source.get("combine") == "norm":
                return None  # the size of a vector
            source["scale"] = np.multiply(source.get("scale", 1.0), FACTORS[kind]).tolist()
            continue
        other_table, other = _place(OTHER[subject])
        if other not in mapping[other_table]:
            return None
        wrong[table][name] = mapping[other_table][other]
        if subject in EXCHANGED:
            wrong[other_table][other] = mapping[table][name]
    return wrong


def verdict(checks: Sequence[dict[str, Any]], subject: str, kind: str, scale: float) -> str:
    """Return the verdict of checks on a mistake, as in the module; ``scale`` is the right one."""
    related = (subject, "truth.sideslip_rad") if subject == "truth.vy_m_s" else (subject,)
    mine = [c for c in checks if c["subject"].startswith(related)]
    failed = [c for c in mine if c["verdict"] == "failed"]
    if failed and kind == AXIS:
        return "named" if any(c["name"].endswith((".axis", ".mounting")) for c in failed) else "stopped"
    if failed:
        # The remedy is a factor, or the scale itself.
        found = [
            float(m[2]) * (FACTORS[kind] if m[1] == "by" else 1.0 / scale)
            for c in failed
            for m in _UNDOES.finditer(c["remedy"])
        ]
        return "named" if any(abs(f - 1.0) < 0.05 for f in found[:1]) else "stopped"
    if any(c["verdict"] == "failed" for c in checks):
        return "other"
    decided = [c for c in mine if c["name"].endswith((".sign", ".unit", ".axis"))]
    return "open" if not decided or any(c["verdict"] == "undecided" for c in decided) else "silent"


#: The checks of a log with a mapping file; raises an error that refuses the file.
Look = Callable[[Path, Path], Sequence[dict[str, Any]]]


def outcomes(
    look: Look, log: Path, mapping: dict[str, Any], folder: Path, wanted: Sequence[tuple[str, str]] = ()
) -> Iterator[Outcome]:
    """Yield the outcomes of mistakes (signal and kind, default all) in the mapping of a log.

    ``folder`` takes the mapping files.
    """
    sound = {c["name"]: c["verdict"] for c in look(log, write_toml(folder / f"{log.stem}-right.toml", mapping))}
    for subject, kind in wanted or [(s, k) for s in subjects(mapping) for k in (*FACTORS, AXIS)]:
        wrong = mistaken(mapping, subject, kind)
        if wrong is None:
            continue
        file = write_toml(folder / f"{log.stem}-{subject}-{kind.replace('/', 'by')}.toml", wrong)
        try:
            checks = look(log, file)
        except (RuntimeError, PdhefError):
            yield Outcome(log.stem, subject, kind, "refused")
            continue
        checks = [c for c in checks if not c["verdict"] == sound.get(c["name"]) == "failed"]
        table, prefix = _place(subject)
        scales = (source.get("scale", 1.0) for n, source in mapping[table].items() if n.startswith(prefix))
        bad = tuple(c for c in checks if c["verdict"] != "passed")
        yield Outcome(log.stem, subject, kind, verdict(checks, subject, kind, float(np.ravel(next(scales))[0])), bad)


def look_at(log: Path, mapping: Path) -> Sequence[dict[str, Any]]:
    """Return the checks that ``pdhef inspect`` shows."""
    return list(inspect_log(log, mapping=mapping).to_dict()["checks"])


def look_at_with_car(log: Path, mapping: Path) -> Sequence[dict[str, Any]]:
    """Return the checks with the published vehicle file of a recorded drive, without one for other logs."""
    if (peer := peer_of(log)) is None:
        return look_at(log, mapping)
    car = Car.load(write_toml(mapping.with_suffix(".car.toml"), vehicle_table(peer)))
    with read_drive(log, car, load_mapping(mapping)) as drive:
        return [asdict(check) for check in drive.plan.checks]


def peer_of(log: Path) -> PeerDrive | None:
    """Return the recorded drive of a log, None for other logs."""
    return next((drive for drive in PEER_DRIVES if drive.log == log.name), None)


def recognised(log: Path, folder: Path) -> dict[str, Any]:
    """Return the mapping file of a log: the known one of a recorded drive, else the recognised one."""
    peer = peer_of(log)
    return Tool(ROOT, folder).mapping(log) if peer is None else mapping_table(peer)


def main() -> None:
    """Count the outcomes over logs and print those that are not named."""
    parser = options("mapping_mistakes", __doc__)
    parser.add_argument("--car", action="store_true", help="with the published vehicle files of recorded drives")
    parser.add_argument("logs", nargs="*", type=Path, default=[ROOT / "sample_logs" / f"{n}.mcap" for n in SAMPLES])
    given = parser.parse_args()
    look, paths = look_at_with_car if given.car else look_at, [path.resolve() for path in given.logs]
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for outcome in (o for path in paths for o in outcomes(look, path, recognised(path, folder), folder)):
            counts[outcome.verdict] += 1
            if outcome.verdict not in ("named", "refused"):
                print(f"{outcome.log} {outcome.signal} {outcome.kind}: {outcome.verdict}", flush=True)
                for check in outcome.checks:
                    print(f"    {check['verdict']} {check['name']}: {check['evidence']}; {check['remedy']}")
    total = counts.total()
    print(f"{total} mistakes: " + ", ".join(f"{n} {v} ({n / total:.1%})" for v, n in counts.most_common()))


if __name__ == "__main__":
    main()
