"""Odd numbers in sound files: rates, irregular stamps, gaps, NaN, constants, impossible values, clocks; long drives.

The signals of a sample drive are changed as columns and written as a log of the same topics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from studies.torture.hours import Drive, Samples


def _sensors(change: Callable[[Samples, np.random.Generator], Samples]) -> Callable[[Drive], Drive]:
    """Make a change of one topic's samples one of all topics except the ground truth."""

    def changed(drive: Drive) -> Drive:
        rng = np.random.default_rng(7)
        return {t: s if t.startswith("/truth") else change(s, rng) for t, s in drive.items()}

    return changed


def _at_rate(hz: float) -> Callable[[Drive], Drive]:
    def change(samples: Samples, _: np.random.Generator) -> Samples:
        old = samples.stamp_ns
        new = np.arange(old[0], old[-1], round(1e9 / hz))
        delay = int(np.median(samples.log_ns - old))
        return Samples(new + delay, new, {k: np.interp(new, old, v) for k, v in samples.values.items()})

    return _sensors(change)


def _jittered(samples: Samples, rng: np.random.Generator) -> Samples:
    shift = rng.uniform(0, 8e6, samples.stamp_ns.shape).astype(np.int64)
    return replace(samples, stamp_ns=samples.stamp_ns + shift, log_ns=samples.log_ns + shift)


def _thinned(samples: Samples, rng: np.random.Generator) -> Samples:
    return samples.take(np.flatnonzero(rng.random(samples.log_ns.shape[0]) > 0.4))


def _with_gaps(samples: Samples, rng: np.random.Generator) -> Samples:
    t = (samples.stamp_ns - samples.stamp_ns[0]) * 1e-9
    keep = np.ones(t.shape, bool)
    for start in rng.uniform(0.0, float(t[-1]), 4):
        keep &= (t < start) | (t > start + rng.uniform(0.3, 1.5))
    return samples.take(np.flatnonzero(keep))


def _spoilt(value: float, share: float, burst: int = 1) -> Callable[[Drive], Drive]:
    """Put a value in the place of a share of all samples, in bursts."""

    def change(samples: Samples, rng: np.random.Generator) -> Samples:
        values = {}
        for name, column in samples.values.items():
            starts = np.flatnonzero(rng.random(column.shape) < share / burst)
            bad = np.unique((starts[:, None] + np.arange(burst)).ravel())
            values[name] = column.copy()
            values[name][bad[bad < column.shape[0]]] = value
        return replace(samples, values=values)

    return _sensors(change)


def _constant(value: float | None) -> Callable[[Drive], Drive]:
    def change(samples: Samples, _: np.random.Generator) -> Samples:
        held = {k: np.full_like(v, v[0] if value is None else value) for k, v in samples.values.items()}
        return replace(samples, values=held)

    return _sensors(change)


def _standing(drive: Drive) -> Drive:
    still = _constant(0.0)(drive)
    truth = drive["/truth/perfect/odometry"]
    level = {k: np.full_like(v, 1.0 if k.endswith("orientation.w") else 0.0) for k, v in truth.values.items()}
    return still | {"/truth/perfect/odometry": replace(truth, values=level)}


def _stepped(drive: Drive, *, stamps_s: float, recorder_s: float) -> list[Drive]:
    """Shift the clocks of stamps and of the recorder from the middle on, in the order of recording."""
    imu = drive["/imu/data"].log_ns
    middle = (imu[0] + imu[-1]) // 2
    before = {t: s.take(np.flatnonzero(s.log_ns < middle)) for t, s in drive.items()}
    after = {t: s.take(np.flatnonzero(s.log_ns >= middle)) for t, s in drive.items()}
    return [before, _shifted(after, stamps_s, recorder_s)]


def _shifted(drive: Drive, stamps_s: float, recorder_s: float = 0.0) -> Drive:
    stamp, log = np.int64(round(stamps_s * 1e9)), np.int64(round(recorder_s * 1e9))
    return {t: replace(s, stamp_ns=s.stamp_ns + stamp, log_ns=s.log_ns + log) for t, s in drive.items()}


def _coarse(drive: Drive) -> Drive:
    """Repeat every stamp five times."""
    return {t: replace(s, stamp_ns=s.stamp_ns[np.arange(s.stamp_ns.shape[0]) // 5 * 5]) for t, s in drive.items()}


def _first(n: int) -> Callable[[Drive], Drive]:
    return lambda drive: {t: s.take(np.arange(min(n, s.log_ns.shape[0]))) for t, s in drive.items()}


def _scaled(factor: float) -> Callable[[Drive], Drive]:
    return _sensors(lambda s, _: replace(s, values={k: v * factor for k, v in s.values.items()}))


#: Change of a drive, and the expected exit codes.
NUMERICS: dict[str, tuple[Callable[[Drive], Drive | list[Drive]], tuple[int, ...]]] = {
    "20 Hz": (_at_rate(20.0), (0,)),
    "200 Hz": (_at_rate(200.0), (0,)),
    "1000 Hz": (_at_rate(1000.0), (0,)),
    "1 Hz": (_at_rate(1.0), (0, 1, 3)),
    "stamps that jitter by 8 ms": (_sensors(_jittered), (0, 3)),
    "four of ten samples missing": (_sensors(_thinned), (0, 3)),
    "gaps of 0.3 to 1.5 s": (_sensors(_with_gaps), (0, 3)),
    "2 % NaN": (_spoilt(float("nan"), 0.02), (0, 3)),
    "20 % NaN in bursts of 40": (_spoilt(float("nan"), 0.2, 40), (3,)),
    "infinite values": (_spoilt(float("inf"), 0.01), (0, 3)),
    "values of 1e30": (_spoilt(1e30, 0.01), (0, 3)),
    "values of 1e300": (_spoilt(1e300, 0.01), (0, 3)),
    "all NaN": (_constant(float("nan")), (1, 3)),
    "all constant": (_constant(None), (0, 3)),
    "standstill": (_standing, (0,)),
    "a million times too large": (_scaled(1e6), (0, 1, 3)),
    "a million times too small": (_scaled(1e-6), (0, 1, 3)),
    "one sample": (_first(1), (0, 1, 3)),
    "two samples": (_first(2), (0, 1, 3)),
    "all clocks back by 3 s": (lambda d: _stepped(d, stamps_s=-3.0, recorder_s=-3.0), (3,)),
    "all clocks on by 3 s": (lambda d: _stepped(d, stamps_s=3.0, recorder_s=3.0), (0, 3)),
    "all clocks on by ten years": (lambda d: _stepped(d, stamps_s=3.2e8, recorder_s=3.2e8), (3,)),
    "stamps back by 1 h from the middle on": (lambda d: _stepped(d, stamps_s=-3600.0, recorder_s=0.0), (0, 3)),
    "stamps an hour behind the recorder": (lambda d: _shifted(d, -3600.0), (0, 3)),
    "stamps repeated in fives": (_coarse, (0, 3)),
}
