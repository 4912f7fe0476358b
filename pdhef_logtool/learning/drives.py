"""Settings and drives of the learning commands: selection, reading, and the record of each drive."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pdhef_logtool.car.parts import LearntOn
from pdhef_logtool.drive.plan import DrivePlan
from pdhef_logtool.drive.reading import Drive, Tell, WholeDrive, logs_of, lost_texts
from pdhef_logtool.logs.discovery import LogInput, Logs
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, EXIT_PARTIAL, UsageError
from pdhef_logtool.records.printable import listed
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.config import RunConfig

#: Splits of a simulated set for results.
HELD_OUT = ("test", "extrapolation")
#: Value of ``split`` that accepts every drive.
ANY_SPLIT = "any"
#: Maximum number of drives to name in an error.
_NAMED = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnSettings:
    """Settings that, together with the logs, determine the result of ``learn``.

    Attributes
    ----------
    config : car, mapping, slice, sensors, truth channel.
    split : use only drives that their set's manifest assigns to this split; "any" accepts drives of all splits, also
        of :data:`HELD_OUT`.
    """

    config: RunConfig
    split: str | None = None


def chosen_logs(arguments: Logs, settings: LearnSettings) -> dict[LogInput, str]:
    """Return the logs with their splits in a simulated set, empty without one.

    Raises
    ------
    UsageError
        There is no log of the requested split, or results need one of them.
    """
    wanted, manifests = settings.split, cache(set_manifest)
    logs = logs_of(arguments, settings.config.read_options)
    splits = {i: str(manifests(i.folder).get(i.path.name, {}).get("split") or "") for i in logs}
    if wanted not in (None, ANY_SPLIT):
        there = ", ".join(sorted({s for s in splits.values() if s}))
        splits = {i: split for i, split in splits.items() if split == wanted}
        if not splits:
            got = f"drives of {there}" if there else "drives without a set's manifest beside them"
            raise UsageError(expected=f"drives of split {wanted}", got=got, where="--split")
    refused = [f"{i.stem} ({split})" for i, split in splits.items() if split in HELD_OUT]
    if refused and wanted != ANY_SPLIT:
        expected = "drives that no result is reported on"
        remedy = "drives that a car learns from are no longer test drives: use --split validation, or --split any"
        raise UsageError(expected=expected, got=listed(refused, _NAMED), where="learn", remedy=remedy)
    return splits


def set_manifest(folder: Path | None) -> Mapping[str, Mapping[str, Any]]:
    """Return the entries of a set's manifest.json (``drives``) or manifest.toml (``log``) by file name."""
    entries: list[Any] = []
    for name, parse, key in (("manifest.json", json.loads, "drives"), ("manifest.toml", tomllib.loads, "log")):
        # No folder or manifest, or a file of another program.
        with suppress(OSError, ValueError, RecursionError, TypeError, LookupError):
            entries += parse((folder / name).read_text(encoding="utf-8"))[key]  # type: ignore[operator]
    return {e["file"]: e for e in entries if isinstance(e, dict) and isinstance(e.get("file"), str)}


@dataclass(frozen=True, slots=True)
class DriveRecord:
    """Record of a drive in every command; ``left_out`` is the reason for its exclusion, empty if it is used.

    Attributes
    ----------
    seconds : from first to last stamp. span_s : these stamps in seconds from the log's start.
    truth : sources of the ground truth. friction_from : source of the friction. notes : notes of the reader.
    """

    name: str
    file: str
    sha256: str = ""
    split: str | None = None
    seconds: float = 0.0
    span_s: tuple[float, float] | None = None
    truth: tuple[str, ...] = ()
    friction_from: str = ""
    losses: tuple[Loss, ...] = ()
    notes: tuple[str, ...] = ()
    left_out: str = ""

    @property
    def learnt_on(self) -> LearntOn:
        """The drive as an entry of a car file."""
        start_s, end_s = self.span_s or (0.0, 0.0)
        return LearntOn(name=self.name, sha256=self.sha256, start_s=round(start_s, 2), end_s=round(end_s, 2))

    def to_dict(self) -> dict[str, Any]:
        """Return the record as JSON-able values."""
        span_s = None if self.span_s is None else [round(s, 3) for s in self.span_s]
        document = {**asdict(self), "seconds": round(self.seconds, 3), "span_s": span_s}
        reason = document.pop("left_out")
        return document | ({"reason": reason} if reason else {})


def record_of(drive: Drive, *, whole: WholeDrive | None = None, left_out: str = "") -> DriveRecord:
    """Return the record of a drive that was read."""
    return DriveRecord(
        name=drive.name,
        file=drive.path.name,
        sha256=drive.sha256,
        seconds=0.0 if whole is None else whole.seconds,
        span_s=None if whole is None else whole.span_s,
        truth=tuple(sorted({source.label for source in drive.mapping.truth.values()})),
        friction_from=drive.friction.label,
        losses=drive.losses,
        notes=(*drive.notes, *drive.remarks),
        left_out=left_out,
    )


def tell_drive(record: DriveRecord, warn: Tell) -> None:
    """Warn of the notes and losses of a drive, and of the reason for its exclusion."""
    for text in (*record.notes, *lost_texts(record.losses)):
        warn(f"{record.name}: {text}")
    if record.left_out:
        warn(f"{record.name} is left out: {record.left_out}")


def exit_code(records: Sequence[DriveRecord]) -> int:
    """Return 0 if all drives were used completely, 3 if not, 1 if none was used."""
    if all(r.left_out for r in records):
        return EXIT_FAILURE
    return EXIT_PARTIAL if any(r.left_out or lost_texts(r.losses) for r in records) else EXIT_OK


def drives_document(records: Sequence[DriveRecord]) -> dict[str, list[dict[str, Any]]]:
    """Return the used and the excluded drives for the JSON of a command."""
    return {
        "drives": [r.to_dict() for r in records if not r.left_out],
        "left_out": [r.to_dict() for r in records if r.left_out],
    }


def no_true_sideslip(plan: DrivePlan) -> str:
    """Return why a drive has no ground truth of the sideslip; empty if it has."""
    if plan.truth is None or "sideslip_rad" not in plan.derivation:
        return "no true sideslip"
    if "sideslip_rad" in plan.dependent:
        return f"its ground truth is invalid: {plan.dependent['sideslip_rad']}"
    return ""
