"""What every output of a run offers."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray, Loss, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Name of the track that contains the ground truth.
TRUTH = "truth"

#: A drive that takes longer is long: views for a person contain less than every stamp of it.
LONGEST_WHOLE_NS = 600_000_000_000

#: Near the end of a Rerun recording that was finished, within so many bytes.
_RECORDING_END, _RECORDING_TAIL = b"RRF2FOOT", 64

#: What numbers are rounded to in files, far below what sensors resolve: powers of two, so that last bytes are zero.
_STEPS = {
    "x_m": 2.0**-10,
    "y_m": 2.0**-10,
    "yaw_rad": 2.0**-17,
    "vx_m_s": 2.0**-13,
    "vy_m_s": 2.0**-13,
    "yaw_rate_rad_s": 2.0**-17,
    "sideslip_rad": 2.0**-20,
    "ay_m_s2": 2.0**-12,
    "orientation": 2.0**-18,
}
#: What stays in single precision: a person has given it, and reads 0.85 there.
_SINGLE = frozenset({"friction", "network_trust", "r_scale"})
#: Bits of a single precision number that are left out of all else, so that 12 are behind the first.
_BITS_OUT = 11


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in [start_ns, end_ns): a segment, a divergence, a loss."""

    name: str
    start_ns: int
    end_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class ManoeuvreEvent(Event):
    """A recognised manoeuvre: its first side (``left``, ``right``), the speed at its start, and its peaks."""

    side: str
    speed_m_s: float
    peak_ay_m_s2: float
    peak_yaw_rate_rad_s: float
    peak_steer_rad: float
    lowest_ax_m_s2: float


@dataclass(frozen=True, slots=True)
class Shown:
    """The estimators that a person is shown first; ``baseline`` is what the selected one is compared with, or None."""

    main: str
    baseline: str | None = None


def rounded(name: str, values: FloatArray) -> FloatArray:
    """Round a column as files contain it: motion to a step, inputs to single precision, else to 1.2e-4 of itself.

    The bytes that are then zero take no space in a compressed file.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # beyond single precision; numbers that signal
        step = _STEPS.get(name)
        if step is not None:
            return np.asarray(np.rint(values / step) * step + 0.0, dtype=np.float64)  # + 0.0: no negative zeros
        short = np.array(values, dtype=np.float32)
        if name not in _SINGLE:
            bits = short.view(np.uint32)
            bits += np.uint32(1 << (_BITS_OUT - 1))
            bits &= np.uint32((0xFFFFFFFF << _BITS_OUT) & 0xFFFFFFFF)
            short[np.isnan(values)] = np.nan  # some have become numbers
        return short.astype(np.float64)


def resolution(name: str) -> tuple[float, float]:
    """Return by how much a column as files contain it may be off at most: absolute, and as a share of itself."""
    return (_STEPS[name] / 2.0, 0.0) if name in _STEPS else (0.0, 2.0 ** (_BITS_OUT - 24))


def is_finished_recording(path: Path) -> bool:
    """Return whether a Rerun recording has its end; what is before it is not read."""
    with path.open("rb") as file:
        file.seek(-min(_RECORDING_TAIL, path.stat().st_size), os.SEEK_END)
        return _RECORDING_END in file.read()


def first_of_slots(stamps_ns: IntArray, step_ns: int, before_ns: int | None) -> IntArray:
    """Return the rows [K] that open a slot of ``step_ns``; none that ``before_ns``, the stamp before, has opened."""
    slot = stamps_ns // step_ns
    before = slot[:1] - 1 if before_ns is None else np.array([before_ns // step_ns])
    return np.flatnonzero(np.diff(slot, prepend=before) != 0)


class Sink(ABC):
    """One output of one log, fed window by window.

    For each window :meth:`append_signals` comes at most once and :meth:`append` once per estimator and once for the
    track named ``truth`` (if there is one), in any order. The first track whose name was already given in the
    current window opens the next one. Then either :meth:`finish` or :meth:`abort` ends the sink; nothing is
    under the final name before :meth:`finish` returns. ``lost``: what of the source this output cannot contain.
    """

    lost: tuple[Loss, ...] = ()

    def append_signals(self, signals: Signals) -> None:  # noqa: B027 (most outputs contain no inputs)
        """Take what the estimators saw in this window; nothing by default."""

    @abstractmethod
    def append(self, track: StateTrack) -> None:
        """Take one track [N] of this window."""

    @abstractmethod
    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Write what belongs to the whole log and give the output its final name.

        ``report`` is the document of :func:`pdhef_logtool.results.run_report.build_report`.
        """

    @abstractmethod
    def abort(self) -> None:
        """Remove what was written; harmless after :meth:`finish` and when called twice."""
