"""Estimates and figures of one drive as polars frames, for notebooks and scripts; a run writes the same rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pdhef_logtool.car.parts import Algorithm
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.table import Skipped
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.runs.estimating import estimate_drive
from pdhef_logtool.runs.preparing import choose

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Whole tracks of a drive.

    Attributes
    ----------
    tracks : by estimator, and ``truth`` where the log has one, with dead-reckoned poses, divergence and intervals.
    signals : input of the estimators. algorithms : by name. skipped : estimators that could not run, with reasons.
    """

    drive: Drive
    tracks: dict[str, StateTrack]
    signals: Signals
    algorithms: dict[str, Algorithm]
    skipped: tuple[Skipped, ...]

    def frame(self) -> pl.DataFrame:
        """Return the tracks as rows of estimates.parquet, in SI units."""
        import polars as pl

        from pdhef_logtool.results.parquet_sink import track_table

        frames = (pl.DataFrame(track_table(track)) for track in self.tracks.values())
        return pl.concat(f.with_columns(pl.col("estimator").cast(pl.String)) for f in frames)


def estimate(drive: Drive, names: Sequence[str] | None = None) -> Estimates:
    """Run estimators over a drive.

    Parameters
    ----------
    drive : of :func:`~pdhef_logtool.drive.reading.read_drive`. names : of estimators; None = those that a run
        takes; ``["all"]`` or ``["peers"]`` = those that the car suits.

    Raises
    ------
    UsageError
        A name is unknown. EstimatorError: the drive contains no stamp.

    >>> from pdhef_logtool import Car, read_drive
    >>> with read_drive("sample_logs/dlc.mcap", Car.load("saloon")) as drive:
    ...     estimates = estimate(drive, ["zero", "phy-ukf"])
    >>> list(estimates.tracks), estimates.algorithms["phy-ukf"].algorithm, len(estimates.frame())
    (['truth', 'zero', 'phy-ukf'], 'vehicle-ukf', 2853)
    """
    estimators, skipped = choose(drive, names)
    whole = drive.whole()
    corrected = DriveModel.of(drive).apply(whole.signals)
    estimated = estimate_drive(whole, corrected, estimators, intervals=drive_intervals(drive.car, estimators))
    truth = {} if estimated.drawn_truth is None else {TRUTH: estimated.drawn_truth}
    algorithms = {e.name: resolve(e) for e in estimators}
    return Estimates(drive, truth | estimated.tracks, estimated.signals, algorithms, tuple(skipped))


def score(estimates: Estimates) -> pl.DataFrame:
    """Return the figures of estimates as rows of metrics.parquet; without ground truth those that need none.

    >>> from pdhef_logtool import Car, read_drive
    >>> with read_drive("sample_logs/dlc.mcap", Car.load("saloon")) as drive:
    ...     figures = score(estimate(drive, ["zero", "phy-ukf"]))
    >>> figures.filter(signal="sideslip_rad", segment="all", metric="rmse").get_column("value").round(4).to_list()
    [0.0199, 0.0065]
    """
    import polars as pl

    from pdhef_logtool.runs.scoring import evaluate

    def read(name: str) -> StateTrack | None:
        """Return a track; the ground truth counts wherever one of its quantities is known."""
        track = estimates.tracks.get(name)
        return replace(track, valid=track.something_known) if track is not None and name == TRUTH else track

    names = [name for name in estimates.tracks if name != TRUTH]
    calibrated = DriveModel.of(estimates.drive).calibrated(estimates.signals)
    rows = evaluate(estimates.drive, names, read, estimates.signals, calibrated).rows
    columns = ("log", "estimator", "signal", "segment", "metric", "value", "unit", "n")
    return pl.DataFrame([[getattr(r, c) for c in columns] for r in rows], schema=columns, orient="row")
