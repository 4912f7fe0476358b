"""Find recorded estimates of other estimators, by flags ``[SIGNAL=]TOPIC[.FIELD]`` or by tables."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.mapping_file import RESERVED_NAMES, factor_of
from pdhef_logtool.mapping.recognition import COVARIANCES, SOURCES
from pdhef_logtool.mapping.records import CanSettings, Mapping as SignalMapping, SignalSource, near
from pdhef_logtool.mapping.vendors import plain_type
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.records.signals import ESTIMATE_UNITS

STATE_TYPE = "pdhef_msgs/VehicleStateEstimate"
#: Quantities that provide the estimate's stamps, best first; the others are interpolated to them.
BASE_ORDER = ("sideslip_rad", "vy_m_s", "vx_m_s", "yaw_rate_rad_s", "ay_m_s2")
#: Standard deviations in the order of the covariance.
STDS = ("vx_std_m_s", "vy_std_m_s", "yaw_rate_std_rad_s")

_STATE_FIELDS = (*BASE_ORDER, "sideslip_std_rad", "valid", "diverged")
_TWIST = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")


@dataclass(frozen=True, slots=True)
class CovarianceSource:
    """A covariance matrix of ``size`` rows in a message; ``planar`` has the indices of v_x, v_y and yaw rate."""

    topic: str
    field: str
    size: int
    planar: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class EstimateSource:
    """Source of one estimator's recorded state: name, quantities (``ESTIMATE_UNITS``) and optional covariance."""

    name: str
    signals: Mapping[str, SignalSource]
    covariance: CovarianceSource | None = None
    can: CanSettings | None = None

    def as_mapping(self) -> SignalMapping:
        """Return the sources as a mapping, for checks, stamps and clocks."""
        return SignalMapping(signals=dict(self.signals), can=self.can)


def choose_estimates(
    log: DriveLog, flags: Sequence[str], mapping: SignalMapping | None, name: str | None
) -> tuple[EstimateSource, ...]:
    """Return the estimates to score, from the flags if any, else from the mapping file's ``[estimates]`` tables.

    Raises
    ------
    UsageError : No estimate exists or none has the name ``name``, or the flags contradict one another.
    MappingError : The log has no such topic.
    """
    tables = {} if mapping is None else mapping.estimates
    can = None if mapping is None else mapping.can
    if name is not None and (not name or name in RESERVED_NAMES):
        raise UsageError(expected="a name of an estimator", got=repr(name), where="--name")
    if flags:
        signals, covariance = sources_of(log, flags, ESTIMATE_UNITS, "--estimate")
        base = _base(signals, "--estimate")
        if covariance is not None and (base.topic != covariance.topic or set(STDS) & set(signals)):
            covariance = None  # its stamps differ from the estimate's, or the flags name standard deviations
        return (EstimateSource(name or _name_of(base.topic), signals, covariance, can),)
    chosen = {n: dict(t) for n, t in tables.items() if name in (None, n)}
    if not chosen:
        others = f" but {', '.join(tables)}" if tables else ""
        got = "none" if name is None else f"none called {name!r}{others}"
        remedy = "give --estimate [SIGNAL=]TOPIC.FIELD, or [estimates.NAME.SIGNAL] tables in a mapping file"
        raise UsageError(expected="an estimate to score", got=got, where="pdhef metrics", remedy=remedy)
    for n, signals in chosen.items():
        _base(signals, f"estimates.{n}")
    return tuple(EstimateSource(n, signals, can=can) for n, signals in chosen.items())


def _base(signals: Mapping[str, SignalSource], where: str) -> SignalSource:
    """Return the quantity that provides the estimate's stamps. Raises UsageError without one."""
    base = next((signals[s] for s in BASE_ORDER if s in signals), None)
    if base is None:
        got = ", ".join(signals) or "none"
        raise UsageError(expected=f"one of {', '.join(BASE_ORDER)}", got=got, where=where)
    return base


def _name_of(topic: str) -> str:
    words = [w for w in re.split(r"[^A-Za-z0-9]+", topic) if w]
    if words[:1] == ["pdhef"] and len(words) > 2:
        return "-".join(words[1:-1])  # topic of this package: /pdhef/<estimator>/state
    name = "_".join(words) or "estimate"
    return f"{name}_" if name in RESERVED_NAMES else name


def sources_of(
    log: DriveLog, texts: Sequence[str], units: Mapping[str, str], option: str
) -> tuple[dict[str, SignalSource], CovarianceSource | None]:
    """Convert ``[SIGNAL=]TOPIC[.FIELD]`` texts to sources by name, and find the covariance of a topic without a field.

    The unit is that of the file or of the field's name, otherwise SI.

    Raises
    ------
    UsageError : The signal is unknown or cannot be determined from the topic's type, or a signal is named twice.
    MappingError : The log has no such topic.
    """
    sources: dict[str, SignalSource] = {}
    covariances: list[CovarianceSource] = []
    for text in texts:
        signal, rest = _split_signal(text, units, option)
        topic, path = _split_topic(log, rest, option)
        if signal is not None:
            if not path:
                raise UsageError(expected=f"{signal}={topic.name}.FIELD", got=text, where=option)
            matches = {signal: path}
        else:
            matches, covariance = _recognise(topic, path, units, text, option)
            covariances += covariance
        for name, field_path in matches.items():
            if name in sources:
                got = f"{name} from {sources[name].label} and from {topic.name}.{field_path}"
                remedy = "for several estimators use a mapping file with [estimates.NAME.SIGNAL] tables"
                raise UsageError(expected="each signal once", got=got, where=option, remedy=remedy)
            unit = next((f.unit for f in log.fields(topic.name) if f.path == field_path), "")
            factor = factor_of(name, field_path.rpartition(".")[2], unit) or 1.0
            sources[name] = SignalSource(name, topic.name, field_path, scale=factor)
    return sources, covariances[0] if len(covariances) == 1 else None


def _split_signal(text: str, units: Mapping[str, str], option: str) -> tuple[str | None, str]:
    head, equals, rest = text.partition("=")
    if not equals or not re.fullmatch(r"\s*\w*\s*", head):
        return None, text.strip()
    signal = head.strip()
    if signal not in units:
        got = repr(signal) + near(signal, list(units), 0.5)
        raise UsageError(expected=f"SIGNAL out of {', '.join(units)}", got=got, where=f"{option} {text}")
    return signal, rest.strip()


def _split_topic(log: DriveLog, text: str, option: str) -> tuple[TopicInfo, str]:
    """Split TOPIC.FIELD at the longest matching topic of the log, as topics outside of ROS 2 may contain dots."""
    fitting = [t for t in log.topics if text == t.name or text.startswith(f"{t.name}.")]
    if fitting:
        topic = max(fitting, key=lambda t: len(t.name))
        return topic, text[len(topic.name) + 1 :]
    names = [t.name for t in log.topics]
    got = text + (near(text, names, 0.5) or near(text.split(".")[0], names, 0.6))
    expected, remedy = "TOPIC.FIELD with a topic of this log", "pdhef inspect lists the topics"
    raise MappingError(expected=expected, got=got, where=f"{log.path} {option}", remedy=remedy)


def _recognise(
    topic: TopicInfo, path: str, units: Mapping[str, str], text: str, option: str
) -> tuple[dict[str, str], list[CovarianceSource]]:
    """Return the fields by signal that a topic's type provides, all of them or the one with this path."""
    kind = plain_type(topic.type_name)
    path_of: dict[str, str] = {}
    covariance: list[CovarianceSource] = []
    if kind == STATE_TYPE:
        path_of = {name: name for name in _STATE_FIELDS}
        covariance = [CovarianceSource(topic.name, "covariance", 3, (0, 1, 2))]
    elif "vx_m_s" in SOURCES.get(kind, {}):
        path_of = {name: SOURCES[kind][name].paths[0] for name in _TWIST}
        its = [path for path, names in COVARIANCES.get(kind, {}).items() if "vx_m_s" in names]
        covariance = [CovarianceSource(topic.name, path.removesuffix("[0]"), 6, (0, 1, 5)) for path in its]
    matches = {name: field_path for name, field_path in path_of.items() if name in units and path in ("", field_path)}
    if not matches:
        expected = "SIGNAL=TOPIC.FIELD, as the type does not give the signal"
        got, remedy = f"{text} ({topic.type_name or 'no type'})", f"SIGNAL is one of {', '.join(units)}"
        raise UsageError(expected=expected, got=got, where=option, remedy=remedy)
    return matches, covariance if path == "" else []
