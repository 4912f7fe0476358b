"""A hash of the content of a log's channels, independent of container, other topics and file name."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.signals import Channel


def channels_sha256(channels: Mapping[str, Channel], sources: Mapping[str, SignalSource]) -> str | None:
    """Return the hash of names, stamps on the log's clock and values in SI units; None without samples.

    Stamps are hashed before the latency of a source is subtracted, because mapping files and cars may change the
    latency of the same drive. Arrival times are not hashed.
    """
    total = hashlib.sha256()
    full = [(name, channel) for name, channel in sorted(channels.items()) if len(channel)]
    for name, channel in full:
        stamps_ns = channel.stamps_ns + round(sources[name].latency_s * 1e9)
        # -0.0 and 0.0 are one value.
        values = np.ascontiguousarray(channel.values + 0.0, dtype="<f8")
        total.update(name.encode() + b"\0" + hashlib.sha256(stamps_ns.astype("<i8").data).digest())
        total.update(hashlib.sha256(values.data).digest())
    return total.hexdigest() if full else None
