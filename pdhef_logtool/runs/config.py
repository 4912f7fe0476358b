"""What a run does: defaults, ``pdhef.toml`` and flags, where flags win."""

from __future__ import annotations

import datetime as dt
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from pdhef_logtool.car.car import NO_INTERVALS, SHIPPED_CARS, UNSURE
from pdhef_logtool.drive.friction import parse_friction
from pdhef_logtool.drive.options import WINDOW_S, ReadOptions, parse_time
from pdhef_logtool.estimators.presets import split_names
from pdhef_logtool.records.documents import read_toml, validated
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.object_store import is_url
from pdhef_logtool.records.readings import POSSIBLE_FRICTION
from pdhef_logtool.residual_model.bundle import NO_MODEL, SHIPPED_FOLDERS

_FILES = ("car", "cars", "mapping", "msgs", "thresholds", "network", "intervals")
#: What may stand in place of a file.
_KEYWORDS = {
    "car": tuple(SHIPPED_CARS),
    "network": (*SHIPPED_FOLDERS, NO_MODEL),
    "intervals": (NO_INTERVALS, UNSURE),
}


def _as_text(value: object) -> object:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return str(value) if plain or isinstance(value, dt.date) else value


#: As users write it; in a file also a number or a TOML date. No time is longer.
Time = Annotated[str, Field(max_length=64), BeforeValidator(_as_text)]
#: As a list or with commas.
Names = Annotated[
    tuple[str, ...], Field(strict=False), BeforeValidator(lambda v: split_names(v) if isinstance(v, str) else v)
]
#: A file or folder, as a path or a text.
File = Annotated[Path, BeforeValidator(lambda v: Path(v) if isinstance(v, str) else v)]
Keep = Literal["metrics", "estimates", "full"]
Friction = Annotated[float, Field(ge=POSSIBLE_FRICTION[0], le=POSSIBLE_FRICTION[1])]


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", strict=True))
class RunConfig:
    """Everything that decides a run's numbers and outputs; its types are checked wherever one is made.

    Attributes
    ----------
    estimators : names, in the order of the tables; ``all`` alone = every one that the car suits; None = the main one,
        ``physics`` and ``zero``, with those that they are checked against (:func:`~.selection.default_names`).
    car : a car's folder, a vehicle.toml, or ``saloon``, the shipped one; None = the default sedan.
    cars : a table that says which car each log has, instead of ``car``; None = the same for all.
    mapping : file; None = recognised types.
    start, end : slice as given (:func:`~pdhef_logtool.drive.options.parse_time`); None = the log's own.
    annotate : ``full`` copies the source into annotated.mcap, ``sidecar`` writes our topics only; None = ``full``
        where everything is kept (``sidecar`` with a cache, as the source is not read), else ``none``.
    keep : what is written of a drive: ``metrics`` (report.json and figures), ``estimates`` (its tracks too) or
        ``full``; None = ``full``, of many logs ``metrics`` (:mod:`~pdhef_logtool.runs.fleet`).
    sensors : ``esp`` is the paper's suite without wheel speeds in the filters.
    friction : ``auto`` is the log's own, else the car's, else estimated; ``file``, ``estimate``, or a number.
    prefer_truth : which truth counts in a simulated log that has both.
    window_s : length of the windows that the log is processed in; changes no number.
    clock : ``arrival`` takes a sample as known when it arrived, as in a car; ``stamp`` at its stamp (not causal).
    budget : factor on what reading a log may cost before its claims count as damage.
    msgs : folder with definitions of message types that a log does not define.
    network : instead of the car's: a folder, ``default``, ``many-cars`` (the shipped one for any car), ``none``.
    intervals : instead of the car's: a file of ``pdhef calibrate``, ``none`` (intervals as they are), ``unsure`` (wide
        ones, for a car that may have changed since its file was made).
    thresholds : limits that the figures are held against; None = no gate.
    waived : names of checks whose failure does not count.
    calibrate : a car without evidence, without truth: on each ``log`` for itself, on the ``pool`` of all, or ``off``.
    cache : folder or URL of slim logs, which stand for logs that were read before; changes no number.
    cache_max_gb : what the cache may hold, in GB, if it is a folder: what was not used for longest goes; None = any.
    allow_private_redirects : whether a web server may redirect to other hosts of this machine and its network.
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
    friction: Literal["auto", "file", "estimate"] | Friction = "auto"
    prefer_truth: Literal["perfect", "rtk"] = "perfect"
    window_s: Annotated[float, Field(ge=1, le=1e9)] = WINDOW_S
    clock: Literal["arrival", "stamp"] = "arrival"
    budget: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    msgs: File | None = None
    thresholds: File | None = None
    network: File | None = None
    intervals: File | None = None
    calibrate: Literal["off", "log", "pool"] = "log"
    waived: Names = ()
    cache: Annotated[str, BeforeValidator(lambda v: str(v) if isinstance(v, Path) else v)] | None = None
    cache_max_gb: Annotated[float, Field(gt=0)] | None = None
    allow_private_redirects: bool = False

    @property
    def read_options(self) -> ReadOptions:
        """What of it decides how a log is read."""
        return ReadOptions(**{f.name: getattr(self, f.name) for f in fields(ReadOptions)})

    @property
    def kept(self) -> Keep:
        """What is written of a drive."""
        return self.keep or "full"

    @property
    def annotation(self) -> Literal["full", "sidecar", "none"]:
        """What annotated.mcap holds; what was asked for is never left out."""
        whole: Literal["full", "sidecar"] = "full" if self.cache is None else "sidecar"
        return self.annotate or (whole if self.kept == "full" else "none")

    @property
    def files(self) -> list[Path]:
        """The files and folders that it names, with what may stand in place of one."""
        return [path for key in _FILES if (path := getattr(self, key)) is not None]

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as JSON-able values; files by name only, so that no machine's paths get out."""
        document = asdict(self)
        del document["cache"], document["cache_max_gb"], document["allow_private_redirects"]
        document["waived"] = list(self.waived)
        document |= {"annotate": self.annotation, "keep": self.kept}
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
    if {"car", "cars"} & given.keys():  # one stands for the other
        raw = {key: value for key, value in raw.items() if key not in {"car", "cars"}}
    if "friction" in given:
        given["friction"] = parse_friction(given["friction"])
    for where, entries in ((str(path), raw), ("options", {**raw, **given})):
        config = validated(RunConfig, entries, where, UsageError, expected="the entries of pdhef.toml")
    if config.estimators is not None:
        from pdhef_logtool.estimators.table import check_names  # inspect takes none, and no compiler

        check_names(config.estimators)
    if config.cache is not None and config.annotate == "full":
        raise UsageError(
            expected="--annotate sidecar or none with --cache",
            got="full",
            where="--annotate",
            remedy="a full copy reads all of each log: leave out --cache",
        )
    if config.cache_max_gb is not None and (config.cache is None or is_url(config.cache)):
        raise UsageError(expected="--cache DIR", got=config.cache or "none", where="--cache-max")
    # Times are understood without a log, so that a typing error is told before the first log is opened.
    for name, text in (("--start", config.start), ("--end", config.end)):
        if text is not None:
            parse_time(text, 0, 0, option=name)
    return config


def _read_file(path: Path) -> dict[str, Any]:
    raw = read_toml(path, "a configuration TOML file", UsageError)
    if isinstance(raw.get("cache"), str) and "://" not in raw["cache"]:
        raw["cache"] = str(path.parent / raw["cache"])
    for key in _FILES:
        value = raw.get(key)
        if isinstance(value, str):
            raw[key] = Path(value) if value in _KEYWORDS.get(key, ()) else path.parent / value
    return raw
