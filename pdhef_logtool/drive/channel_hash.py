"""A hash of the content of a log's channels, independent of container, other topics, file name and windows."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

from pdhef_logtool.records.signals import Channel


@dataclass(slots=True)
class ChannelHash:
    """Hashes channels piece by piece: names, stamps on the log's clock, values in SI units.

    Stamps count as they are before a latency is taken off them, which a mapping file or a car brings: a drive stays
    the same drive for a car whose sensors are better known. Arrivals are not part of it.
    """

    _parts: dict[str, tuple[hashlib._Hash, hashlib._Hash]] = field(default_factory=dict)

    def add(self, channel: Channel, latency_ns: int) -> None:
        """Take the next samples of a channel; ``latency_ns`` was taken off its stamps."""
        if not len(channel):
            return
        stamps, values = self._parts.setdefault(channel.name, (hashlib.sha256(), hashlib.sha256()))
        stamps.update((channel.stamps_ns + latency_ns).astype("<i8").tobytes())
        # -0.0 and 0.0 are one value.
        values.update(np.ascontiguousarray(channel.values + 0.0, dtype="<f8").tobytes())

    def hexdigest(self) -> str | None:
        """Return the hash of all samples so far; None where there are none."""
        if not self._parts:
            return None
        total = hashlib.sha256()
        for name, (stamps, values) in sorted(self._parts.items()):
            total.update(name.encode() + b"\0" + stamps.digest() + values.digest())
        return total.hexdigest()
