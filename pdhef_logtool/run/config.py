"""What a run does: defaults, ``pdhef.toml`` and flags, where flags win; and the times of a slice."""

from __future__ import annotations

import datetime as dt
import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from pdhef_logtool.drive.friction import parse_friction
from pdhef_logtool.estimators.registry import check_names
from pdhef_logtool.records.documents import read_toml, validated
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.readings import POSSIBLE_FRICTION

#: A bare integer from here on is nanoseconds, not seconds from the log's start.
NANOSECONDS_FROM = 10**15
WINDOW_S = 600.0
_FILES = ("vehicle", "mapping", "thresholds", "model", "calibration")
#: What may stand in place of a file.
_KEYWORDS = {"model": ("default", "many-cars", "none"), "calibration": ("none", "unsure")}


def _as_text(value: object) -> object:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if plain or isinstance(value, dt.date) else value


#: As users write it; in a file also a number or a TOML date. No time is longer.
Time = Annotated[str, Field(max_length=64), BeforeValidator(_as_text)]
#: As a list or with commas.
Names = Annotated[
    tuple[str, ...], Field(strict=False), BeforeValidator(lambda v: v.split(",") if isinstance(v, str) else v)
]
Friction = Annotated[float, Field(ge=POSSIBLE_FRICTION[0], le=POSSIBLE_FRICTION[1])]


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", strict=True))
class RunConfig:
    """Everything that decides a run's numbers and outputs; its types are checked wherever one is made.

    Attributes
    ----------
    estimators : names, in the order of the tables; None = every one that the vehicle file suits.
    vehicle, mapping : files; None = the default sedan, recognised types.
    start, end : slice as given (:func:`parse_time`); None = the log's own.
    annotate : ``full`` copies the source into annotated.mcap, ``sidecar`` writes our topics only.
    sensors : ``esp`` is the paper's suite without wheel speeds in the filters.
    friction : ``auto`` is the log's own, else the vehicle file's, else estimated; ``file``, ``estimate``, or a number.
    prefer_truth : which truth counts in a simulated log that has both.
    window_s : length of the windows that the log is processed in; changes no number.
    model : folder of a model bundle for the hybrid filters; None = the shipped one, ``many-cars`` = the shipped one for
        any car, ``none`` = no network.
    calibration : file of ``pdhef calibrate``; None = that beside the model, if any; ``none`` = intervals as they
        are; ``unsure`` = the wide one beside the model, for a car that may have changed since its file was made.
    thresholds : limits that the figures are held against; None = no gate.
    """

    estimators: Names | None = None
    vehicle: Path | None = None
    mapping: Path | None = None
    start: Time | None = None
    end: Time | None = None
    annotate: Literal["full", "sidecar", "none"] = "full"
    sensors: Literal["full", "esp"] = "full"
    friction: Literal["auto", "file", "estimate"] | Friction = "auto"
    prefer_truth: Literal["perfect", "rtk"] = "perfect"
    window_s: Annotated[float, Field(ge=1, le=1e9)] = WINDOW_S
    thresholds: Path | None = None
    model: Path | None = None
    calibration: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as JSON-able values; files by name only, so that no machine's paths get out."""
        document = asdict(self)
        document["estimators"] = None if self.estimators is None else list(self.estimators)
        for key in _FILES:
            path = document[key]
            document[key] = None if path is None else Path(path).name
        return document


def load_config(path: Path | None, flags: dict[str, Any]) -> RunConfig:
    """Merge defaults, the configuration file and the flags that were given (None = not given).

    ``path`` None reads ``pdhef.toml`` of the working directory if there is one. Paths in the file are relative to it.

    Raises
    ------
    UsageError
        The file is missing or wrong, or a value is none of those allowed.
    """
    if path is None and Path("pdhef.toml").is_file():
        path = Path("pdhef.toml")
    raw = {} if path is None else _read_file(path)
    given = {key: value for key, value in flags.items() if value is not None}
    if "friction" in given:
        given["friction"] = parse_friction(given["friction"])
    for where, entries in ((str(path), raw), ("options", {**raw, **given})):
        config = validated(RunConfig, entries, where, UsageError, expected="the entries of pdhef.toml")
    if config.estimators is not None:
        check_names(config.estimators)
    # Times are understood without a log, so that a typing error is told before the first log is opened.
    for name, text in (("--start", config.start), ("--end", config.end)):
        if text is not None:
            parse_time(text, 0, 0, option=name)
    return config


def _read_file(path: Path) -> dict[str, Any]:
    raw = read_toml(path, "a configuration TOML file", UsageError)
    for key in _FILES:
        value = raw.get(key)
        if isinstance(value, str):
            raw[key] = Path(value) if value in _KEYWORDS.get(key, ()) else path.parent / value
    return raw


def parse_time(text: str, start_ns: int, end_ns: int, *, option: str) -> int:
    """Turn a time as users write it into int64 nanoseconds of the log's clock.

    ``12.5`` and ``+12.5s`` are seconds from the log's start, ``end-5s`` is 5 s before its end, a bare integer of at
    least 1e15 is nanoseconds, and anything with a ``T`` or ``-`` between digits is RFC 3339 (UTC when it names no
    zone).

    Raises
    ------
    UsageError
        The text is none of these.
    """
    text = text.strip()
    if re.fullmatch(r"\d+", text) and int(text) >= NANOSECONDS_FROM:
        return int(text)
    relative = re.fullmatch(r"\+?(\d+(?:\.\d*)?|\.\d+)\s*s?", text)
    if relative:
        return start_ns + round(float(relative[1]) * 1e9)
    from_end = re.fullmatch(r"end(?:\s*-\s*(\d+(?:\.\d*)?|\.\d+)\s*s?)?", text)
    if from_end:
        return end_ns - round(float(from_end[1] or 0.0) * 1e9)
    try:
        when = dt.datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(
            expected="a time such as 12.5, +10s, end-5s, 1700000000000000000 or 2026-01-31T12:00:00Z",
            got=repr(text),
            where=option,
        ) from None
    if when.tzinfo is None:
        when = when.replace(tzinfo=dt.UTC)
    delta = when - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
    return (delta.days * 86_400 + delta.seconds) * 10**9 + delta.microseconds * 1000


def time_slice(config: RunConfig, start_ns: int, end_ns: int) -> tuple[int, int]:
    """Return the slice [start, end) of a log that spans [start_ns, end_ns).

    Raises
    ------
    UsageError
        The slice is empty or lies outside of the log.
    """
    begin = start_ns if config.start is None else parse_time(config.start, start_ns, end_ns, option="--start")
    finish = end_ns if config.end is None else parse_time(config.end, start_ns, end_ns, option="--end")
    begin, finish = max(begin, start_ns), min(finish, end_ns)
    if begin >= finish:
        raise UsageError(
            expected=f"a slice inside the log's {(end_ns - start_ns) / 1e9:.3f} s",
            got=f"start {config.start or 'of the log'}, end {config.end or 'of the log'}",
            where="--start/--end",
        )
    return begin, finish
