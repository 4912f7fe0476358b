"""What the page of a drive shows and no table contains, gathered while the drive's tracks are still at hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.evaluation.dead_reckoned import path_drift
from pdhef_logtool.evaluation.reasons import SensorFault, sensor_faults
from pdhef_logtool.evaluation.standing import standings
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.run_report import DriveDetails
from pdhef_logtool.results.sink import TRUTH

#: Entries of a log's metadata that a report keeps, and signs of each.
_MOST_METADATA, _MOST_SIGNS = 64, 200

_Read = Callable[[str], StateTrack | None]


def drive_details(
    drive: Drive,
    ready: Sequence[Estimator],
    main: str,
    read: _Read,
    *,
    metadata: bool = True,
) -> DriveDetails:
    """Return the details of a drive.

    Parameters
    ----------
    ready : the estimators that ran. main : name of the selected estimate. read : returns the track of a name.
    metadata : with the metadata of the log.
    """
    truth, slow = read(TRUTH), drive.car.vehicle.low_speed_blend_m_s
    answer = read(main)
    assert answer is not None
    by_name = {e.name: e for e in ready}
    asked = [by_name[n] for n in dict.fromkeys((main, PHYSICS)) if n in by_name]
    return DriveDetails(
        faults=next((f for e in asked if (f := _faults(read, e.name)) is not None), None),
        standings=[] if truth is None else standings(main, _rivals(ready, by_name[main], read), read, truth, slow),
        path_drift=None if truth is None else path_drift(answer, truth),
        metadata=_metadata(drive) if metadata else {},
    )


def _faults(read: _Read, name: str) -> tuple[SensorFault, ...] | None:
    track = read(name)
    return None if track is None else sensor_faults(track)


def _rivals(ready: Sequence[Estimator], main: Estimator, read: _Read) -> list[str]:
    """Return the estimators on the car's model alone to compare the selected one with; none sees more of the log."""
    rivals = []
    for estimator in ready:
        algorithm = resolve(estimator)
        physics = algorithm.physics_sha256 is not None and algorithm.network_sha256 is None
        other = physics and estimator.name != main.name and (estimator.causal or not main.causal)
        if other and not _is_same(read(estimator.name), read(main.name)):
            rivals.append(estimator.name)
    return rivals


def _is_same(track: StateTrack | None, main: StateTrack | None) -> bool:
    """Whether two tracks [N] have the same sideslip bit for bit: one filter under two names (residual gain 0)."""
    if track is None or main is None or len(track) != len(main):
        return False
    return np.array_equal(track.sideslip_rad, main.sideslip_rad, equal_nan=True)


def _metadata(drive: Drive) -> dict[str, str]:
    """Return the log's metadata by key, and by ``record.key`` where records differ, as far as it is short."""
    texts = drive.log.metadata()
    texts = {k: v for k, v in texts.items() if k.partition(".")[2] not in texts or texts[k.partition(".")[2]] != v}
    short = {printable(k, _MOST_SIGNS): v for k, v in sorted(texts.items()) if len(v) <= _MOST_SIGNS}
    return {k: printable(v) for k, v in [*short.items()][:_MOST_METADATA]}
