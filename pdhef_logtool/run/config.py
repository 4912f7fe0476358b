"""What a run does: defaults, ``pdhef.toml`` and flags, where flags win."""

from __future__ import annotations

import tomllib
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from pdhef_logtool.drive.friction import parse_friction
from pdhef_logtool.drive.options import SENSOR_SUITES, WINDOW_S, ReadOptions, parse_time
from pdhef_logtool.estimators.registry import check_names
from pdhef_logtool.records.errors import UsageError

ANNOTATE = ("full", "sidecar", "none")
_FILES = ("vehicle", "mapping", "thresholds", "model", "calibration")
#: What may stand in place of a file.
_KEYWORDS = {"model": ("default", "many-cars", "none"), "calibration": ("none", "unsure")}


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Everything that decides a run's numbers and outputs.

    Attributes
    ----------
    estimators : names, in the order of the tables; None = every one that the vehicle file suits.
    vehicle, mapping : files; None = the default sedan, recognised types.
    start, end : slice as given (:func:`~pdhef_logtool.drive.options.parse_time`); None = the log's own.
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

    estimators: tuple[str, ...] | None = None
    vehicle: Path | None = None
    mapping: Path | None = None
    start: str | None = None
    end: str | None = None
    annotate: Literal["full", "sidecar", "none"] = "full"
    sensors: Literal["full", "esp"] = "full"
    friction: str | float = "auto"
    prefer_truth: Literal["perfect", "rtk"] = "perfect"
    window_s: float = WINDOW_S
    thresholds: Path | None = None
    model: Path | None = None
    calibration: Path | None = None

    @property
    def read_options(self) -> ReadOptions:
        """What of it decides how a log is read."""
        return ReadOptions(**{f.name: getattr(self, f.name) for f in fields(ReadOptions)})

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
    config = RunConfig()
    if path is None and Path("pdhef.toml").is_file():
        path = Path("pdhef.toml")
    if path is not None:
        config = replace(config, **_read_file(path))
    config = replace(config, **{k: v for k, v in flags.items() if v is not None})
    _check(config)
    return replace(config, friction=parse_friction(config.friction))


def _read_file(path: Path) -> dict[str, Any]:
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(expected="a configuration TOML file", got=str(error), where=str(path)) from None
    known = {f.name for f in fields(RunConfig)}
    unknown = sorted(set(raw) - known)
    if unknown:
        raise UsageError(expected=f"keys out of {', '.join(sorted(known))}", got=", ".join(unknown), where=str(path))
    if "estimators" in raw:
        names = raw["estimators"]
        raw["estimators"] = tuple(names.split(",") if isinstance(names, str) else names)
    for key in _FILES:
        if key in raw:
            value = str(raw[key])
            raw[key] = Path(value) if value in _KEYWORDS.get(key, ()) else path.parent / value
    for key in ("start", "end"):
        if key in raw:
            raw[key] = str(raw[key])
    return raw


def _check(config: RunConfig) -> None:
    if config.estimators is not None:
        check_names(config.estimators)
    for name, value, allowed in (
        ("annotate", config.annotate, ANNOTATE),
        ("sensors", config.sensors, SENSOR_SUITES),
        ("prefer_truth", config.prefer_truth, ("perfect", "rtk")),
    ):
        if value not in allowed:
            raise UsageError(expected=f"one of {', '.join(allowed)}", got=repr(value), where=name)
    if not isinstance(config.window_s, (int, float)) or not config.window_s >= 1.0:
        raise UsageError(expected="a window of at least 1 s", got=repr(config.window_s), where="window_s")
    # Times are understood without a log, so that a typing error is told before the first log is opened.
    for name, text in (("--start", config.start), ("--end", config.end)):
        if text is not None:
            parse_time(text, 0, 0, option=name)
