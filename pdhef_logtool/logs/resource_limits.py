"""Resource limits of reading a log, for all readers of untrusted input; exceeding one counts as damage.

A hundred bytes of a third-party file can declare gigabytes, and a short schema can unfold without end. Each limit is
far above the files of recorders and far below a machine's capacity; one factor raises all (``--set budget=FACTOR``).
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields

from pdhef_logtool.records.errors import LogError

#: Remedy of an exceeded limit.
RAISE_LIMIT = "if the recording is sound, raise the limit with --set budget=FACTOR"
#: Bytes.
KIB, MIB = 1 << 10, 1 << 20
_MESSAGES_A_CHECK = _FEW_MESSAGES = 1 << 16


class LimitError(LogError):
    """Input exceeds a resource limit; inside a log this is a loss."""


@dataclass(frozen=True, slots=True)
class ResourceLimits:
    """Limits for one log.

    Attributes
    ----------
    chunk_bytes : decompressed bytes of a chunk, of a run of messages without chunks, or of a compressed message.
    chunk_ratio : decompressed by stored bytes of a chunk, message or file of more than a MiB.
    chunk_messages : messages of a chunk or run.
    messages_per_byte : messages by stored bytes of a chunk of more than 65,536 messages.
    channels : channels of a file.
    metadata_bytes : bytes of a declaration, metadata record, index record or header.
    schema_bytes : bytes of the text or the descriptors of one schema.
    schema_leaves : scalar fields of a schema with all its nested structs.
    schema_depth : structs inside one another, also of a JSON message.
    array_width : elements of an array that become columns.
    table_bytes : bytes of the decoded tables of a file (CSV, Parquet, MAT, MDF, BLF, ...): a constant part.
    table_ratio : a further part of them, by stored bytes.
    seconds : processor time of reading: a constant part.
    seconds_per_mib : a further part of it, for each MiB read.
    """

    chunk_bytes: int = 256 * MIB
    chunk_ratio: int = 2000
    chunk_messages: int = 1_000_000
    messages_per_byte: float = 4.0
    channels: int = 4096
    metadata_bytes: int = 64 * MIB
    schema_bytes: int = 4 * MIB
    schema_leaves: int = 20_000
    schema_depth: int = 32
    array_width: int = 65_536
    table_bytes: int = 256 * MIB
    table_ratio: int = 32
    seconds: float = 5.0
    seconds_per_mib: float = 20.0

    def times(self, factor: float) -> "ResourceLimits":
        """Return limits that are higher by a factor."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return ResourceLimits(**{name: type(value)(value * factor) for name, value in values.items()})

    def check(self, limit: str, amount: float, what: str) -> None:
        """Raise :class:`LimitError` if an amount, claimed by ``what``, is above the limit of this name."""
        allowed = getattr(self, limit)
        if amount > allowed:
            raise LimitError(
                expected=f"at most {allowed:.10g} {limit.replace('_', ' ')}",
                got=f"{amount:.10g}",
                where=what,
                remedy=RAISE_LIMIT,
            )

    def check_unpacked(self, size: int, stored: int, what: str) -> None:
        """Raise :class:`LimitError` if ``stored`` bytes may not become, or claim to become, ``size`` bytes."""
        self.check("chunk_bytes", size, what)
        if size > MIB:
            self.check("chunk_ratio", size / max(stored, 1), what)

    def check_table(self, size: int, stored: int, what: str) -> None:
        """Raise :class:`LimitError` if ``stored`` bytes may not become, or claim to become, tables of ``size`` bytes.

        Readers call it before they allocate: with rows times width of the metadata, or the size of a container.
        """
        self.check("table_bytes", size - self.table_ratio * stored, what)

    def check_messages(self, count: int, stored: int) -> None:
        """Raise :class:`LimitError` if ``stored`` bytes cannot contain this number of messages."""
        self.check("chunk_messages", count, "a chunk")
        if count > _FEW_MESSAGES:
            self.check("messages_per_byte", count / max(stored, 1), "a chunk")


DEFAULT_LIMITS = ResourceLimits()


class Meter:
    """Processor time of reading one log, with the limit for the bytes read so far.

    Repeated reads count again in time and in bytes, so that a sound log can be read any number of times.
    """

    def __init__(self, limits: ResourceLimits = DEFAULT_LIMITS) -> None:
        self.limits = limits
        self._seconds = 0.0
        self._bytes = 0
        self._since: float | None = None

    @property
    def allowed_s(self) -> float:
        """Time limit for the bytes read so far, in seconds."""
        return self.limits.seconds + self.limits.seconds_per_mib * self._bytes / MIB

    def check(self) -> None:
        """Raise :class:`LimitError` if reading has taken too long."""
        spent = self._seconds + (0.0 if self._since is None else time.thread_time() - self._since)
        if spent > self.allowed_s:
            raise LimitError(
                expected="a log that is read in time",
                got=f"reading took longer than {self.allowed_s:.3g} s",
                where=f"{self._bytes} bytes read",
                remedy=RAISE_LIMIT,
            )

    def check_scan(self, messages: int) -> None:
        """Check the limits once in a while, in a scan that has found this number of messages in a chunk."""
        if messages % _MESSAGES_A_CHECK == 0:
            self.limits.check("chunk_messages", messages, "a chunk")
            self.check()

    @contextmanager
    def running(self, size: int = 0) -> Iterator[None]:
        """Count the time that a block takes, which reads ``size`` bytes; inside another such block only its bytes."""
        self._bytes += size
        if self._since is not None:
            yield
            return
        self._since = time.thread_time()
        try:
            yield
        finally:
            self._seconds += time.thread_time() - self._since
            self._since = None
