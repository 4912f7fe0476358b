"""What a log may cost before its claims count as damage: one object through all readers of untrusted input.

A recording is somebody else's file: a hundred bytes can claim gigabytes, a short schema can unfold without end. Each
limit lies far above what recorders write and far below what harms a machine; one factor raises them all (``--budget``).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

from pdhef_logtool.records.errors import LogError

_OPTION = "--budget"


class BudgetError(LogError):
    """Input claims more than it may cost; inside a log it becomes a loss at its place."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits for one log.

    Attributes
    ----------
    chunk_bytes : decompressed bytes of one chunk, or of one message that is compressed by itself.
    chunk_ratio : decompressed by stored bytes of a chunk of more than a MiB.
    channels : of one file. metadata_bytes : of one declaration, metadata record or header.
    schema_bytes : text or descriptors of one schema. schema_leaves : scalar places of an unfolded schema.
    schema_depth : structs inside one another, also of a JSON message.
    array_width : elements of an array that become columns.
    seconds, seconds_per_mib : time that reading a log once may take, whatever its size and by its size.
    """

    chunk_bytes: int = 256 << 20
    chunk_ratio: int = 2000
    channels: int = 8192
    metadata_bytes: int = 64 << 20
    schema_bytes: int = 4 << 20
    schema_leaves: int = 20_000
    schema_depth: int = 32
    array_width: int = 65_536
    seconds: float = 8.0
    seconds_per_mib: float = 2.0

    def times(self, factor: float) -> Budget:
        """Return the budget with every limit raised by a factor."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Budget(**{name: type(value)(value * factor) for name, value in values.items()})

    def check(self, limit: str, amount: float, what: str) -> None:
        """Raise :class:`BudgetError` if an amount is above the limit of this name; ``what`` claims it."""
        allowed = getattr(self, limit)
        if amount > allowed:
            raise BudgetError(
                expected=f"at most {allowed:.10g} {limit.replace('_', ' ')}",
                got=f"{amount:.10g}",
                where=what,
                remedy=f"if the recording is sound, raise the limit with {_OPTION}",
            )


DEFAULT_BUDGET = Budget()
