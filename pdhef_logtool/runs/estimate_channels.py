"""An estimate that somebody else recorded, from its fields to a state track on its own stamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.estimators.vehicle_ukf import sideslip_std
from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.mapping import SignalSource, clock_key, fit_clocks, resolve_mapping
from pdhef_logtool.mapping.can_frames import with_can_signals
from pdhef_logtool.mapping.channels import LOSS_TEXTS, dropped, si_values
from pdhef_logtool.mapping.clocks import request_source, stamps_on_log_clock
from pdhef_logtool.mapping.estimates import BASE_ORDER, STDS, CovarianceSource, EstimateSource
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import ESTIMATE_UNITS, BoolArray, Channel, FloatArray, IntArray, Loss
from pdhef_logtool.records.tracks import StateTrack, diagonal_covariance, make_track

#: Steps of more than this number of median periods are not interpolated.
GAP_PERIODS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEstimate:
    """A recorded estimate on its own stamps.

    ``channels`` are its quantities on their own stamps, NaN left out; ``claimed`` are the names of all that the
    estimate consists of.
    """

    track: StateTrack
    channels: Mapping[str, Channel]
    claimed: frozenset[str]
    notes: tuple[str, ...] = ()


def read_estimate(
    log: DriveLog, source: EstimateSource, start_ns: int, end_ns: int
) -> tuple[RecordedEstimate, list[Loss]]:
    """Read one recorded estimate with log time in [start, end) onto the stamps of its first quantity of BASE_ORDER.

    NaN stays: it counts against the availability of the estimator and is not a loss.

    Raises
    ------
    MappingError : The slice contains no message of it, or not one number.
    """
    log = with_can_signals(log, source.as_mapping())
    mapping = resolve_mapping(log, source.as_mapping())
    clocks = fit_clocks(log, mapping, start_ns, end_ns)
    requests: dict[str, list[str]] = {}
    for s in mapping.signals.values():
        request_source(log, s, requests)
    if source.covariance is not None:
        requests[source.covariance.topic].append(source.covariance.field)
    losses: list[Loss] = []
    base = next(name for name in BASE_ORDER if name in mapping.signals)
    columns = log.read(requests, start_ns, end_ns)
    channels: dict[str, Channel] = {}
    covariance = None
    for name, s in mapping.signals.items():
        topic = columns.get(s.read_topic)
        if topic is None or len(topic) == 0:
            channels[name] = Channel(
                name, ESTIMATE_UNITS[name], s.label, *2 * (np.empty(0, dtype=np.int64),), np.empty(0)
            )
            continue
        stamps, usable = stamps_on_log_clock(log, topic, s, clocks[clock_key(s)])
        stamps = stamps - np.int64(round(s.latency_s * 1e9))
        kept = _in_order(stamps, topic.log_time_ns, usable)
        values = _in_range(si_values(topic, s), s)[kept]
        channels[name] = Channel(name, ESTIMATE_UNITS[name], s.label, stamps[kept], topic.log_time_ns[kept], values)
        if name == base:
            if not usable.all():
                losses.append(dropped("bad-stamp", s.topic, topic.log_time_ns[~usable]))
            if repeated := int(np.count_nonzero(usable)) - len(kept):
                text = LOSS_TEXTS["duplicate-stamp"]
                losses.append(Loss("duplicate-stamp", text, s.topic, count=repeated, severity="note"))
            if source.covariance is not None:
                covariance = _planar_covariance(topic, source.covariance)[kept]
    if not any(np.isfinite(channel.values).any() for name, channel in channels.items() if name in BASE_ORDER):
        raise MappingError(
            expected="numbers in the recorded estimate",
            got="none in the chosen slice",
            where=f"{log.path} {', '.join(s.label for n, s in mapping.signals.items() if n in BASE_ORDER)}",
            remedy="check topic, field and slice",
        )
    track, notes = _track(source.name, channels[base].stamps_ns, channels, covariance)
    finite = {n: c.take(np.isfinite(c.values)) for n, c in channels.items() if n in BASE_ORDER}
    return RecordedEstimate(track, finite, frozenset(channels), notes), losses


def _in_range(values: FloatArray, source: SignalSource) -> FloatArray:
    with np.errstate(invalid="ignore"):
        outside = np.zeros(values.shape[0], dtype=np.bool_)
        if source.valid_min is not None:
            outside |= values < source.valid_min
        if source.valid_max is not None:
            outside |= values > source.valid_max
    return np.where(outside | ~np.isfinite(values), np.nan, values)


def _in_order(stamps_ns: IntArray, arrival_ns: IntArray, usable: BoolArray) -> IntArray:
    """Return the places of usable samples in order of unique stamps; of equal stamps the first arrival."""
    places = np.flatnonzero(usable)
    order = places[np.lexsort((arrival_ns[places], stamps_ns[places]))]
    return order[np.diff(stamps_ns[order], prepend=stamps_ns[order[:1]] - 1) > 0]


def _planar_covariance(topic: Columns, source: CovarianceSource) -> FloatArray:
    """Return [N, 3, 3] over v_x, v_y, yaw rate; NaN if unknown (all zero, or −1 first, as in ROS)."""
    raw = np.asarray(topic.fields[source.field], dtype=np.float64)
    n = raw.shape[0]
    if raw.ndim != 2 or raw.shape[1] != source.size**2:
        return np.full((n, 3, 3), np.nan)
    places = np.array(source.planar)
    planar = raw.reshape(n, source.size, source.size)[:, places[:, None], places]
    unknown = (planar == 0.0).all(axis=(1, 2)) | (raw[:, 0] < 0.0)
    return np.where(unknown[:, None, None], np.nan, planar)


def _track(
    name: str, stamps_ns: IntArray, channels: Mapping[str, Channel], covariance: FloatArray | None
) -> tuple[StateTrack, tuple[str, ...]]:
    notes: list[str] = []
    columns: dict[str, FloatArray] = {}
    for quantity, channel in channels.items():
        same = np.array_equal(channel.stamps_ns, stamps_ns)
        columns[quantity] = channel.values if same else _interpolated(channel, stamps_ns)
        if not same and quantity in BASE_ORDER:
            notes.append(f"{quantity} has other stamps than the estimate and is interpolated to them")
    if "sideslip_rad" in columns:
        beta = columns["sideslip_rad"]
        columns["sideslip_rad"] = np.where(np.abs(beta) > np.pi, wrap_angle(beta), beta)
        if "vx_m_s" in columns and "vy_m_s" not in columns:
            columns["vy_m_s"] = columns["vx_m_s"] * np.tan(columns["sideslip_rad"])
            notes.append("v_y is v_x times tan of the sideslip")
    if covariance is None or not np.isfinite(covariance).any():
        covariance = diagonal_covariance([columns.get(s, np.full(stamps_ns.shape[0], np.nan)) for s in STDS])
    flags = {flag: columns[flag] >= 0.5 for flag in ("valid", "diverged") if flag in columns}
    if covariance.shape[0] and "sideslip_std_rad" not in columns and {"vx_m_s", "vy_m_s"} <= columns.keys():
        # Where only deviations are known the correlation of the two velocities counts as 0.
        completed = np.where(np.eye(3, dtype=np.bool_), covariance, np.nan_to_num(covariance, nan=0.0))
        columns["sideslip_std_rad"] = sideslip_std(columns["vx_m_s"], columns["vy_m_s"], completed)
    state = {n: c for n, c in columns.items() if n not in (*STDS, "valid", "diverged")}
    return make_track(name, stamps_ns, covariance=covariance, **state, **flags), tuple(notes)


def _interpolated(channel: Channel, stamps_ns: IntArray) -> FloatArray:
    finite = channel.take(np.isfinite(channel.values))
    bracket = Bracket(finite.stamps_ns, stamps_ns, gap_ns(finite.stamps_ns))
    return bracket.angle(finite.values) if channel.name == "sideslip_rad" else bracket.linear(finite.values)


def gap_ns(stamps_ns: IntArray) -> int:
    """Return the longest step of stamps [N] that is interpolated across."""
    return round(GAP_PERIODS * float(np.median(np.diff(stamps_ns)))) if stamps_ns.shape[0] > 1 else 0
