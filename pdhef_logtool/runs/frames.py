"""Estimates and figures of one drive as polars frames, for notebooks and scripts; a run writes the same rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.parts import Algorithm
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.table import Skipped
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.records.signals import S_PER_NS, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.runs.estimating import Estimated, choose, estimate_drive, evaluate

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Whole tracks of a drive.

    Attributes
    ----------
    model : of the drive; its car is calibrated on the drive as by a run.
    tracks : by estimator, and ``truth`` where the log has one, with dead-reckoned poses, divergence, intervals.
    algorithms : by name. skipped : estimators that could not run, with reasons.
    """

    drive: Drive
    model: DriveModel
    estimated: Estimated
    tracks: dict[str, StateTrack]
    algorithms: Mapping[str, Algorithm]
    skipped: tuple[Skipped, ...]

    def __repr__(self) -> str:
        return f"<Estimates of {self.drive.name}: {', '.join(self.estimated.tracks)}>"

    @property
    def signals(self) -> Signals:
        """Signals that the estimators used."""
        return self.estimated.signals

    def frame(self, *, errors: bool = False) -> "pl.DataFrame":
        """Return the tracks as rows of estimates.parquet, in SI units.

        Parameters
        ----------
        errors : add estimate - ground truth as columns such as ``error_vy_m_s``, null where a stamp is not scored.
        """
        import polars as pl

        from pdhef_logtool.results.parquet_sink import track_table

        name, added = pl.col("estimator").cast(pl.String), self._errors if errors else lambda _: {}
        tracks = self.tracks.values()
        return pl.concat(pl.DataFrame(track_table(t)).with_columns(name, **added(t)) for t in tracks)

    def plot(self) -> Any:
        """Draw the sideslip of all tracks over the time of the log; return the axes. Needs matplotlib."""
        from matplotlib import pyplot as plt

        axes = plt.subplots()[1]
        for name, track in self.tracks.items():
            seconds = (track.stamps_ns - self.drive.plan.start_ns) * S_PER_NS
            axes.plot(seconds, np.degrees(track.sideslip_rad), label=name)
        axes.set(xlabel="time, s", ylabel="sideslip, °")
        axes.legend()
        return axes

    def _errors(self, track: StateTrack) -> "dict[str, pl.Expr]":
        """Return the errors of a track by column; empty for the ground truth."""
        import polars as pl

        truth, slow = self.estimated.truth, self.drive.car.vehicle.low_speed_blend_m_s
        if truth is None or track.name == TRUTH:
            return {f"error_{s}": pl.lit(None, pl.Float64) for s in SCORED_SIGNALS}
        errors = ((s, signal_error(track, truth, s, slow)) for s in SCORED_SIGNALS)
        return {f"error_{s}": pl.lit(pl.Series(error, nan_to_null=True)) for s, error in errors}


def estimate(drive: Drive, names: Sequence[str] | None = None) -> Estimates:
    """Run estimators over a drive as ``pdhef run`` does, which calibrates the car if no drives have validated it.

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
    model, whole = DriveModel.fit(drive), drive.whole()
    estimators, skipped = choose(drive, names, model.car)
    intervals = drive_intervals(model.car, estimators)
    estimated = estimate_drive(whole, model.apply(whole.signals), estimators, intervals=intervals)
    tracks = {track.name: track for track in estimated.drawn}
    return Estimates(drive, model, estimated, tracks, estimated.algorithms, tuple(skipped))


def score(estimates: Estimates) -> "pl.DataFrame":
    """Return the figures of estimates as rows of metrics.parquet; without ground truth those that need none.

    >>> from pdhef_logtool import Car, read_drive
    >>> with read_drive("sample_logs/dlc.mcap", Car.load("saloon")) as drive:
    ...     figures = score(estimate(drive, ["zero", "phy-ukf"]))
    >>> figures.filter(signal="sideslip_rad", segment="all", metric="rmse").get_column("value").round(4).to_list()
    [0.0199, 0.0065]
    """
    import polars as pl

    rows = evaluate(estimates.drive, estimates.estimated, estimates.model).rows
    columns = ("log", "estimator", "signal", "segment", "metric", "value", "unit", "n")
    return pl.DataFrame([[getattr(r, c) for c in columns] for r in rows], schema=columns, orient="row")
