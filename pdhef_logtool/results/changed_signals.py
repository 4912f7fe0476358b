"""Where two runs over one drive part: signal, first stamp that differs, how many, and by how much."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pdhef_logtool.results.pairing import Pair
from pdhef_logtool.results.sink import TRUTH, resolution

if TYPE_CHECKING:
    import polars as pl

#: Compared columns of a track.
_SIGNALS = ("sideslip_rad", "vy_m_s", "vx_m_s", "yaw_rate_rad_s", "ay_m_s2", "sideslip_std_rad", "valid")


@dataclass(frozen=True, slots=True)
class ChangedSignal:
    """A column of a track that differs by more than the rounding of the files.

    ``track``: an estimator, or :data:`TRUTH`. ``first_ns``: first stamp that differs; ``first_s``: counted from the
    track's first. ``stamps``: how many differ, of ``of``; a stamp that one side lacks does too. ``largest``: largest
    absolute difference where both are known, None where they never are.
    """

    drive: str
    track: str
    signal: str
    first_ns: int
    first_s: float
    stamps: int
    of: int
    largest: float | None


def changed_signals(pair: Pair, estimator: str) -> Iterator[ChangedSignal]:
    """Yield the columns of ground truth and of an estimator that differ, if both sides have the track.

    Raises
    ------
    OutputError : A file is damaged.
    """
    import polars as pl

    left, other = pair.a.estimates(), pair.b.estimates()
    if left is None or other is None:
        return
    columns = [c for c in _SIGNALS if c in left.collect_schema() and c in other.collect_schema()]
    for track in (TRUTH, estimator):
        rows = [
            frame.filter(pl.col("estimator").cast(pl.String) == track).select(
                "stamp_ns", *(pl.col(c).cast(pl.Float64).fill_nan(None) for c in columns), there=pl.lit(value=True)
            )
            for frame in (left, other)
        ]
        joined = rows[0].join(rows[1], on="stamp_ns", how="full", coalesce=True, suffix="_b").sort("stamp_ns").collect()
        if joined["there"].any() and joined["there_b"].any():
            yield from (c for column in columns if (c := _changed(joined, pair.a.label, track, column)) is not None)


def _changed(joined: pl.DataFrame, drive: str, track: str, column: str) -> ChangedSignal | None:
    import polars as pl

    if joined[column].is_null().all() and joined[f"{column}_b"].is_null().all():
        return None
    missing = pl.col("there").is_null() | pl.col("there_b").is_null()
    step, share = resolution(column)
    by = (pl.col(column) - pl.col(f"{column}_b")).abs()
    only_one = pl.col(column).is_null() != pl.col(f"{column}_b").is_null()
    apart = (by.fill_nan(0.0) > 2.0 * (step + share * pl.col(column).abs())).fill_null(value=False)
    differing = joined.select("stamp_ns", differs=missing | only_one | apart, by=by).filter("differs")
    if not len(differing):
        return None
    largest = differing["by"].max()
    return ChangedSignal(
        drive,
        track,
        column,
        first_ns=int(differing["stamp_ns"][0]),
        first_s=(int(differing["stamp_ns"][0]) - int(joined["stamp_ns"][0])) * 1e-9,
        stamps=len(differing),
        of=len(joined),
        largest=float(largest) if isinstance(largest, float) else None,
    )
