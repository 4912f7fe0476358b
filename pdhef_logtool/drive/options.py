"""Options for reading a log (slice, sensors, ground truth, friction), and the formats of times."""

import datetime as dt
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits
from pdhef_logtool.logs.table_file import TableSettings
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import NS_PER_S

#: A bare integer from here on is nanoseconds, not seconds from the log's start.
NANOSECONDS_FROM = 10**15
#: Models in place of a file: sensors and car fitted to the whole log; sensors of the log, and the prior of the car.
AUTO, OFF = Path("auto"), Path("off")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """All options that influence the inputs of an estimator, except the mapping and the car.

    Attributes
    ----------
    start, end : slice as text (:func:`parse_time`); None = start and end of the log.
    sensors : ``esp`` is the paper's suite without wheel speeds in the filters.
    friction : of :func:`~pdhef_logtool.drive.friction.parse_friction`; None keeps the friction of the log, if any.
    prefer_truth : ground truth to use if a simulated log contains both.
    budget : factor on the resource limits for reading a log.
    waived : names of checks to ignore.
    model : :data:`AUTO`, :data:`OFF`, or the model.toml of an earlier drive, which decides the sensors.
    msgs : folder with definitions of message types that a log does not define.
    rate_hz, group, folder : of logs of tables (:class:`~pdhef_logtool.logs.table_file.TableSettings`).
    allow_private_redirects : whether a web server may redirect to other hosts of this machine and its network.
    """

    start: str | None = None
    end: str | None = None
    sensors: Literal["full", "esp"] = "full"
    friction: str | float | None = "auto"
    prefer_truth: Literal["perfect", "rtk"] = "perfect"
    budget: float = 1.0
    waived: tuple[str, ...] = ()
    model: Path = AUTO
    msgs: Path | None = None
    rate_hz: float | None = None
    group: str = ""
    folder: Literal["auto", "recording", "drives"] = "auto"
    allow_private_redirects: bool = False

    def __post_init__(self) -> None:
        """Convert texts to paths."""
        object.__setattr__(self, "model", Path(self.model))
        object.__setattr__(self, "msgs", None if self.msgs is None else Path(self.msgs))

    @property
    def use_speed(self) -> bool:
        """Whether the filters use the speed sensor after their start."""
        return self.sensors == "full"

    @property
    def tables(self) -> TableSettings:
        """Settings of logs of tables."""
        return TableSettings(self.rate_hz, self.group, self.folder)

    @property
    def limits(self) -> ResourceLimits:
        """Resource limits for reading a log."""
        return DEFAULT_LIMITS.times(self.budget)


AS_IT_IS = ReadOptions()


def parse_time(text: str, start_ns: int, end_ns: int, *, option: str) -> int:
    """Convert a time from user input to int64 nanoseconds of the log's clock.

    ``12.5`` and ``+12.5s`` are seconds from the log's start, ``end-5s`` is 5 s before its end, a bare integer of at
    least 1e15 is nanoseconds, and anything with a ``T`` or ``-`` between digits is RFC 3339 (UTC when it names no
    zone).

    Raises
    ------
    UsageError : The text has another format.
    """
    text = text.strip()
    if re.fullmatch(r"\d+", text) and int(text) >= NANOSECONDS_FROM:
        return int(text)
    relative = re.fullmatch(r"\+?(\d+(?:\.\d*)?|\.\d+)\s*s?", text)
    if relative:
        return start_ns + round(float(relative[1]) * NS_PER_S)
    from_end = re.fullmatch(r"end(?:\s*-\s*(\d+(?:\.\d*)?|\.\d+)\s*s?)?", text)
    if from_end:
        return end_ns - round(float(from_end[1] or 0.0) * NS_PER_S)
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
    return (delta.days * 86_400 + delta.seconds) * NS_PER_S + delta.microseconds * 1000


def time_slice(options: ReadOptions, start_ns: int, end_ns: int) -> tuple[int, int]:
    """Return the slice [start, end) of a log that spans [start_ns, end_ns).

    Raises
    ------
    UsageError : The slice is empty or lies outside of the log.
    """
    begin = start_ns if options.start is None else parse_time(options.start, start_ns, end_ns, option="--start")
    finish = end_ns if options.end is None else parse_time(options.end, start_ns, end_ns, option="--end")
    begin, finish = max(begin, start_ns), min(finish, end_ns)
    if begin >= finish:
        raise UsageError(
            expected=f"a slice inside the log's {(end_ns - start_ns) / NS_PER_S:.3f} s",
            got=f"start {options.start or 'of the log'}, end {options.end or 'of the log'}",
            where="--start/--end",
        )
    return begin, finish
