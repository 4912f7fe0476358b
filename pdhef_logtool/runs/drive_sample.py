"""A minute of a drive, for what is asked of it again after the run: a block of each sixth of the driving."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.corrected import CorrectedPhysics
from pdhef_logtool.estimators.gnss_aided import GnssAided
from pdhef_logtool.estimators.online_calibrated import OnlineCalibrated
from pdhef_logtool.estimators.self_calibrated import SelfCalibrated
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals, join_signals
from pdhef_logtool.records.tracks import StateTrack, concatenate

#: Blocks, what they last together at most, and how many stamps they have at most: 40 s at 100 Hz.
BLOCKS = 6
SECONDS = 60.0
MOST_STAMPS = 4000
#: What a filter needs before its error counts (docs/method.md#identification).
SETTLE_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class DriveSample:
    """Stamps of a drive [M], blocks one behind the other; a gap between two of them starts every filter again.

    ``truth`` is None where the drive has none. ``block`` [M] numbers the block of a stamp, −1 while filters settle.
    """

    signals: Signals
    truth: StateTrack | None
    block: IntArray

    @property
    def seconds(self) -> float:
        """How long the blocks last together."""
        inside = (self.block[1:] >= 0) & (self.block[1:] == self.block[:-1])
        return float(np.diff(self.signals.stamps_ns)[inside].sum() * 1e-9)

    def half(self, parity: int) -> DriveSample:
        """Return every second block, and before each what a filter settles on."""
        stamps, in_half = self.signals.stamps_ns, (self.block >= 0) & (self.block % 2 == parity)
        keep = in_half.copy()
        for number in np.unique(self.block[in_half]):
            first = int(np.argmax(self.block == number))
            keep[np.searchsorted(stamps, stamps[first] - round(SETTLE_S * 1e9)) : first] = True
        spans = np.flatnonzero(np.diff(keep, prepend=False, append=False)).reshape(-1, 2).tolist()
        return DriveSample(
            join_signals([self.signals.rows(a, b) for a, b in spans]),
            None if self.truth is None else concatenate([self.truth.rows(a, b) for a, b in spans]),
            np.where(in_half, self.block, -1)[keep],
        )


def sample_drive(signals: Signals, truth: StateTrack | None, weight: FloatArray) -> DriveSample | None:
    """Return blocks of a drive [N]: of each sixth of the stamps with a weight [N] the block with most of it.

    ``weight`` is NaN at stamps that do not count; None where fewer do than there are blocks.
    """
    finite_index = np.flatnonzero(np.isfinite(weight))
    if finite_index.size < BLOCKS:
        return None
    stamps = signals.stamps_ns
    step_s = float(np.median(np.diff(stamps))) * 1e-9
    want = min(MOST_STAMPS // BLOCKS, finite_index.size // BLOCKS, max(1, int(SECONDS / BLOCKS / step_s)))
    spans: list[tuple[int, int, int]] = []
    done, gathered = 0, np.concatenate([[0.0], np.cumsum(weight[finite_index])])
    for a, b in pairwise(np.linspace(0, finite_index.size, BLOCKS + 1).astype(np.int64).tolist()):
        begin = max(int(finite_index[a + np.argmax(gathered[a + want : b + 1] - gathered[a : b + 1 - want])]), done)
        lead = max(int(np.searchsorted(stamps, stamps[begin] - round(SETTLE_S * 1e9))), done)
        done = min(begin + want, len(stamps))
        spans.append((lead, begin, done))
        if done == len(stamps):
            break
    block = [np.where(np.arange(lead, end) < begin, -1, i) for i, (lead, begin, end) in enumerate(spans)]
    # Where nothing lies between two blocks the filters run on, and only the first block has to settle.
    settling = stamps[[i for lead, _, end in spans for i in range(lead, end)]] < stamps[0] + round(SETTLE_S * 1e9)
    return DriveSample(
        join_signals([signals.rows(lead, end) for lead, _, end in spans]),
        None if truth is None else concatenate([truth.rows(lead, end) for lead, _, end in spans]),
        np.where(settling, -1, np.concatenate(block)),
    )


def bare_filter(estimator: Estimator, signals: Signals) -> tuple[Estimator, Signals]:
    """Return what runs under a fallback and self-calibration, and what it is given of a drive's signals."""
    while isinstance(estimator, SelfCalibrated | OnlineCalibrated | GnssAided | CorrectedPhysics):
        if isinstance(estimator, SelfCalibrated):
            signals = estimator.given(signals)
        estimator = estimator.physics if isinstance(estimator, CorrectedPhysics) else estimator.estimator
    return estimator, signals
