"""Configuration of a run: flags override ``pdhef.toml``, which overrides defaults."""

import datetime as dt
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from pdhef_logtool.car.names import SHIPPED_CARS
from pdhef_logtool.car.vehicle import SENSOR_PROFILES, Friction
from pdhef_logtool.drive.friction import parse_friction
from pdhef_logtool.drive.options import AUTO, OFF, ReadOptions, parse_time
from pdhef_logtool.estimators.table import check_names
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.residual_model.bundle import NO_MODEL, SHIPPED_FOLDERS
from pdhef_logtool.residual_model.interface import plug_in_names
from pdhef_logtool.storage.documents import read_toml, validated

_FILES = ("car", "cars", "mapping", "msgs", "plan", "network", "model", "sensor_profile")
#: Settings that change no result.
_NO_RESULT = ("allow_private_redirects", "log_timeout_s", "max_memory_mb", "strict", "full_worst")
#: Values that replace a file.
_KEYWORDS = {
    "car": tuple(SHIPPED_CARS),
    "network": (*SHIPPED_FOLDERS, NO_MODEL),
    "sensor_profile": tuple(SENSOR_PROFILES),
    "model": (str(AUTO), str(OFF)),
}


def _as_text(value: object) -> object:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if plain or isinstance(value, dt.date) else value


#: As users write it; in a file also a number or a TOML date. No time is longer.
Time = Annotated[str, Field(max_length=64), BeforeValidator(_as_text)]
#: As a list or with commas.
Names = Annotated[
    tuple[str, ...],
    Field(strict=False),
    BeforeValidator(lambda v: tuple(filter(None, map(str.strip, v.split(",")))) if isinstance(v, str) else v),
]
#: A file or folder, as a path or a text.
File = Annotated[Path, Field(strict=False)]
Keep = Literal["metrics", "estimates", "full"]


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", strict=True, defer_build=True))
class RunConfig:
    """Settings of a run: the keys of ``pdhef.toml`` and of ``--set``. Types are checked at construction.

    Attributes
    ----------
    estimators : names, or ``all``; None = ``pd-hef``, ``physics`` and ``zero``, with the estimators of their selection
        (:func:`~.selection.default_names`).
    car : car folder, vehicle.toml, or ``saloon`` (the shipped car); None = the default sedan.
    cars : cars.toml, which assigns a car to each log; replaces ``car``.
    mapping : mapping.toml; None = signals are recognised.
    start : start of the time slice (:func:`~pdhef_logtool.drive.options.parse_time`); None = start of the log.
    end : end of the time slice; None = end of the log.
    annotate : content of annotated.mcap: ``full`` (copy of the log with the estimates), ``sidecar`` (estimates only) or
        ``none``; None = ``full`` if ``keep`` is ``full``, otherwise ``none``.
    keep : files per log: ``metrics`` (report and metrics), ``estimates`` (and the tracks) or ``full``; None = ``full``,
        for more than 50 logs ``metrics``.
    sensors : ``full``, or ``esp`` (sensor set of the paper: the speed sensor only initialises the filters).
    sensor_profile : TOML file with ``[sensors]`` (noise, rates and limits of the sensors), or ``production``, in place
        of the car's entries, for ``run`` and ``metrics``; None = entries of the car.
    friction : ``auto`` (from the log, else the car, else 1; for ``extract`` first from the ground truth), ``file``, or
        a number.
    prefer_truth : ground truth of a simulated log that has both: ``perfect`` or ``rtk``.
    budget : factor on the limits of memory and time for reading a log.
    msgs : folder, zip file or wheel with .msg files of types that a log does not define; or a DBC file, or a folder of
        them, for raw CAN frames in BLF, ASC, candump and MDF files.
    rate_hz : rows per second of a table without times, or with times without a unit; None = rate of the mapping file.
    group : of a file with several runs, the one to read: the beginning or end of its names of topics.
    folder : whether a folder of tables is one ``recording`` or several ``drives``; ``auto``: CSV files with overlapping
        times and different columns are one recording.
    plan : validation plan (plan.toml); None = the default plan, which decides no exit code.
    network : network folder, ``default``, ``none`` or the name of an installed residual model; None = the car's.
    model : ``auto`` (sensors, and a car without validation data, are fitted to the whole log without ground truth; not
        causal), ``off`` (the car is not fitted, only its prior is used), or the model.toml of an earlier run or of
        ``learn``, for sensors and car of earlier drives (causal).
    reference : sideslip reference (not causal, without tyre data): ``auto`` (where the log has no ground truth of
        sideslip), ``on`` (beside ground truth as well; in ``learn`` and ``extract`` in its place) or ``off``.
    gnss : ``auto`` (``physics``, ``pd-hef`` and the reference use GNSS velocity where the log has it) or ``off``.
    no_position : keep latitude, longitude and all other positions and headings out of the outputs. Topics are copied
        if each of their fields is known not to be a position; attachments, metadata and names of log files are left
        out.
    waived : names of checks that may fail.
    allow_private_redirects : follow redirects of web servers to hosts of this machine or its network.
    log_timeout_s : abort a log after this time without progress, in s.
    max_memory_mb : abort a log if its worker process exceeds this memory, in MB.
    strict : an INCONCLUSIVE requirement of the plan fails, too (exit code 4).
    full_worst : number of logs with the largest error that keep all files; None = 5 for more than 50 logs.
    """

    estimators: Names | None = None
    car: File | None = None
    cars: File | None = None
    mapping: File | None = None
    start: Time | None = None
    end: Time | None = None
    annotate: Literal["full", "sidecar", "none"] | None = None
    keep: Keep | None = None
    sensors: Literal["full", "esp"] = "full"
    sensor_profile: File | None = None
    friction: Literal["auto", "file"] | Friction = "auto"
    prefer_truth: Literal["perfect", "rtk"] = "perfect"
    budget: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    msgs: File | None = None
    rate_hz: Annotated[float, Field(gt=0, le=1e6)] | None = None
    group: str = ""
    folder: Literal["auto", "recording", "drives"] = "auto"
    plan: File | None = None
    network: File | None = None
    model: File = AUTO
    reference: Literal["auto", "on", "off"] = "auto"
    gnss: Literal["auto", "off"] = "auto"
    no_position: bool = False
    waived: Names = ()
    allow_private_redirects: bool = False
    log_timeout_s: Annotated[float, Field(ge=1)] | None = None
    max_memory_mb: Annotated[int, Field(ge=1)] | None = None
    strict: bool = False
    full_worst: Annotated[int, Field(ge=0)] | None = None

    @property
    def read_options(self) -> ReadOptions:
        """The part that decides how a log is read."""
        return ReadOptions(**{f.name: getattr(self, f.name) for f in fields(ReadOptions)})

    @property
    def kept(self) -> Keep:
        """Outputs of a drive."""
        return self.keep or "full"

    @property
    def annotation(self) -> Literal["full", "sidecar", "none"]:
        """Content of annotated.mcap."""
        return self.annotate or ("full" if self.kept == "full" else "none")

    @property
    def files(self) -> list[Path]:
        """The files and folders that it names."""
        return [path for key in _FILES if (path := getattr(self, key)) is not None]

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as JSON-able values; files by name only, so that no machine's paths get out."""
        document = asdict(self)
        for key in _NO_RESULT:
            del document[key]
        document |= {"annotate": self.annotation, "keep": self.kept}
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
        The file is missing or wrong, or a value is not allowed.
    """
    if path is None and Path("pdhef.toml").is_file():
        path = Path("pdhef.toml")
    raw = {} if path is None else _read_file(path)
    given = {key: value for key, value in flags.items() if value is not None}
    if {"car", "cars"} & given.keys():  # one replaces the other
        raw = {key: value for key, value in raw.items() if key not in {"car", "cars"}}
    if "friction" in given:
        given["friction"] = parse_friction(given["friction"])
    for where, entries in ((str(path), raw), ("options", {**raw, **given})):
        config = validated(RunConfig, entries, where, UsageError, expected="the entries of pdhef.toml")
    if config.estimators is not None:
        check_names(config.estimators)
    # Times are parsed without a log, so that a typing error is reported before the first log is opened.
    for name, text in (("--start", config.start), ("--end", config.end)):
        if text is not None:
            parse_time(text, 0, 0, option=name)
    return config


def parse_assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Return the settings of ``KEY=VALUE`` texts; a value is TOML if it is valid TOML, else text.

    Raises
    ------
    UsageError
        A text has no ``=``, or names no setting.
    """
    settings: dict[str, Any] = {}
    names = [f.name for f in fields(RunConfig)]
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or key not in names:
            near = get_close_matches(key, names, n=1)
            raise UsageError(
                expected="KEY=VALUE with a setting of pdhef.toml",
                got=text,
                where="--set",
                remedy=f"did you mean {near[0]}?" if near else "docs/settings.md lists the settings",
            )
        settings[key] = _toml_value(value)
    return settings


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text


def _read_file(path: Path) -> dict[str, Any]:
    raw = read_toml(path, "a configuration TOML file", UsageError, times=("start", "end"))
    for key in _FILES:
        value = raw.get(key)
        if isinstance(value, str):
            is_name = value in _KEYWORDS.get(key, ()) or (key == "network" and value in plug_in_names())
            raw[key] = Path(value) if is_name else path.parent / value
    return raw
