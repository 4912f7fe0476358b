"""Calibrated intervals: how much wider or narrower an estimator's own 1-sigma must be, learnt on drives with truth.

The calibrated variance of sideslip is a sum of non-negative contributions,

    s² = Σ (k_i t_i)²,

with the terms t_i of :mod:`pdhef_logtool.watches.error_features` (the filter's own 1-sigma, grip use, sideslip,
disagreement with accelerometer and gyro, ...). It grows with every term and needs no truth and no future. ``s`` is the
95 % quantile of the error divided by 1.96, so that ± 1.96 s covers 95 % whatever the errors' distribution. The yaw
rate's is the same sum over fewer terms; v_y's 1-sigma keeps its ratio to the sideslip's, times a factor. The covariance
is scaled row and column alike, so that its correlations stay. Estimates themselves never change.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.records.documents import read_json
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import model_folder

if TYPE_CHECKING:
    from pdhef_logtool.watches.error_features import FeatureCarry

FORMAT = "pdhef-calibration"
FORMAT_VERSION = 1
#: Name of the file beside a model bundle.
FILE = "calibration.json"
#: Instead of a file: leave all intervals as the estimators give them.
NO_CALIBRATION = "none"
#: Instead of a file: the wide one beside the model, for a car that may not be as its vehicle file says.
UNSURE, UNSURE_FILE = "unsure", "calibration_unsure_vehicle.json"
#: Terms of the sideslip's variance; those of the yaw rate's, where ``filter`` is its own 1-sigma.
SIDESLIP_TERMS = ("floor", "filter", "sideslip", "grip", "grip2", "kinematic", "yaw_rate")
YAW_RATE_TERMS = ("floor", "filter", "yaw_rate")
#: A sideslip is not known at all beyond this 1-sigma.
MAX_SIDESLIP_STD_RAD = 1.0


@dataclass(frozen=True, slots=True)
class Inflation:
    """The coefficients k of one estimator, in the order of the terms, and the factor of v_y."""

    sideslip: tuple[float, ...]
    yaw_rate: tuple[float, ...]
    vy_factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """What ``pdhef calibrate`` wrote.

    Attributes
    ----------
    inflations : by estimator. vehicle_sha256, vehicle_name : of the vehicle file that it was made with.
    roll_gradient_rad_per_m_s2 : of that file. name, sha256 : of the calibration file.
    model_sha256 : of the network, None without. spread : by which friction and vehicle were made wrong too; 0, not.
    """

    inflations: Mapping[str, Inflation]
    vehicle_name: str
    vehicle_sha256: str
    roll_gradient_rad_per_m_s2: float
    model_sha256: str | None = None
    spread: float = 0.0
    name: str = FILE
    sha256: str = ""


@dataclass(slots=True)
class TrackCalibrator:
    """Applies a calibration, or none, to the tracks of a drive window by window.

    ``vehicle_sha256`` and ``model_sha256`` are those of the run, for the notes. ``stands_for`` says by name which
    estimator's coefficients are used where they are not its own.
    """

    calibration: Calibration | None
    vehicle_sha256: str
    model_sha256: str | None = None
    stands_for: Mapping[str, str] = field(default_factory=dict)
    _carries: dict[str, FeatureCarry] = field(default_factory=dict)
    _has_interval: set[str] = field(default_factory=set)

    def add(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return the next window of a track with calibrated intervals, or as it is where it has no entry."""
        if np.isfinite(track.sideslip_std_rad).any():
            self._has_interval.add(track.name)
        like = self.stands_for.get(track.name, track.name)
        if self.calibration is None or like not in self.calibration.inflations:
            return track
        track, self._carries[track.name] = calibrated(
            track, signals, self.calibration, self._carries.get(track.name), like=like
        )
        return track

    def notes(self, name: str) -> tuple[str, ...]:
        """Return what the report says of an estimator's intervals; nothing for one without."""
        if name not in self._has_interval:
            return ()
        made = self.calibration
        if made is None or self.stands_for.get(name, name) not in made.inflations:
            return ("intervals not calibrated",)
        of = f"wrong by {made.spread:g}" if made.spread > 0.0 else "as told"
        said = [f"intervals calibrated by {made.name} ({made.sha256[:8]}) for friction and vehicle {of}"]
        if made.vehicle_sha256 != self.vehicle_sha256:
            said.append(f"that calibration was made for another vehicle file ({made.vehicle_name})")
        if made.model_sha256 is not None and made.model_sha256 != self.model_sha256:
            said.append("that calibration was made for another network")
        return tuple(said)


def calibrated(
    track: StateTrack,
    signals: Signals,
    calibration: Calibration,
    carry: FeatureCarry | None = None,
    *,
    like: str | None = None,
) -> tuple[StateTrack, FeatureCarry]:
    """Return a track with calibrated 1-sigmas and covariance; joined windows equal the whole bit for bit.

    Parameters
    ----------
    track, signals : [N] at the same stamps. carry : of the previous window.
    like : name with an entry; None is the track's.

    Raises
    ------
    KeyError
        The calibration has no entry for the estimator.
    """
    from pdhef_logtool.watches.error_features import error_terms

    inflation = calibration.inflations[track.name if like is None else like]
    terms, carry = error_terms(track, signals, calibration.roll_gradient_rad_per_m_s2, carry)
    return inflated(track, terms, inflation), carry


def inflated(track: StateTrack, terms: FloatArray, inflation: Inflation) -> StateTrack:
    """Scale a track's 1-sigmas and covariance by an inflation; ``terms`` [N, 7]. NaN stays NaN."""
    own = track.sideslip_std_rad
    sideslip = np.minimum(combined(terms, inflation.sideslip), MAX_SIDESLIP_STD_RAD)
    sideslip = np.where(np.isfinite(own), sideslip, np.nan)
    covariance = track.covariance
    if covariance.shape[0]:
        rate_std = track.yaw_rate_std_rad_s
        rate = combined(yaw_rate_terms(terms, rate_std), inflation.yaw_rate)
        scale = np.ones((len(track), 3))
        scale[:, 1] = inflation.vy_factor * _ratio(sideslip, own)
        scale[:, 2] = _ratio(rate, rate_std)
        covariance = covariance * scale[:, :, None] * scale[:, None, :]
    return replace(track, sideslip_std_rad=sideslip, covariance=covariance)


def combined(terms: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """Return √ Σ (k_i t_i)² of terms [N, m], [N]."""
    # Added term by term: a product of matrices need not give the same bits for a window as for the whole.
    total = np.zeros(terms.shape[0])
    for i, k in enumerate(coefficients):
        total += (k * terms[:, i]) ** 2
    return np.sqrt(total)


def yaw_rate_terms(terms: FloatArray, rate_std: FloatArray) -> FloatArray:
    """Return the yaw rate's terms [N, 3] from those of the sideslip and the estimator's own 1-sigma [N]."""
    known = np.where(np.isfinite(rate_std), rate_std, 0.0)
    return np.stack([terms[:, 0], known, terms[:, SIDESLIP_TERMS.index("yaw_rate")]], axis=1)


def _ratio(new: FloatArray, old: FloatArray) -> FloatArray:
    """Return new / old where both are known and old is not 0, else 1."""
    good = np.isfinite(new) & np.isfinite(old) & (old > 0.0)
    return np.where(good, new / np.where(good, old, 1.0), 1.0)


# ---- the file ----


def inflations_document(inflations: Mapping[str, Inflation]) -> dict[str, Any]:
    """Return the coefficients by estimator and term, as they stand under ``estimators`` of the file."""
    return {
        name: {
            "sideslip": dict(zip(SIDESLIP_TERMS, i.sideslip, strict=True)),
            "yaw_rate": dict(zip(YAW_RATE_TERMS, i.yaw_rate, strict=True)),
            "vy_factor": i.vy_factor,
        }
        for name, i in inflations.items()
    }


def load_calibration(path: Path) -> Calibration:
    """Read a calibration file, or the one in a model's folder.

    Raises
    ------
    ModelError
        The file is missing, is no calibration, or an entry is wrong.
    """
    file = path / FILE if path.is_dir() else path
    remedy = "pdhef calibrate writes one"
    said = read_json(file, "a calibration file", ModelError, remedy)
    if said.get("format") != FORMAT or said.get("version") != FORMAT_VERSION:
        got = f"{said.get('format')} {said.get('version')}"
        raise ModelError(expected=f"{FORMAT} {FORMAT_VERSION}", got=got, where=str(file), remedy=remedy)
    try:
        return Calibration(
            inflations={str(n): _inflation(entry) for n, entry in said["estimators"].items()},
            vehicle_name=str(said["vehicle"]["name"]),
            vehicle_sha256=str(said["vehicle"]["sha256"]),
            roll_gradient_rad_per_m_s2=_finite(said["vehicle"]["roll_gradient_rad_per_m_s2"], low=-math.inf),
            model_sha256=None if said.get("model_sha256") is None else str(said["model_sha256"]),
            spread=_finite(said["settings"]["vary"]),
            name=file.name,
            sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        )
    except (OSError, LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise ModelError(
            expected="the entries of a calibration file", got=f"{error!r}", where=str(file), remedy=remedy
        ) from None


def _inflation(entry: Mapping[str, Any]) -> Inflation:
    return Inflation(
        sideslip=tuple(_finite(entry["sideslip"][t]) for t in SIDESLIP_TERMS),
        yaw_rate=tuple(_finite(entry["yaw_rate"][t]) for t in YAW_RATE_TERMS),
        vy_factor=_finite(entry["vy_factor"]),
    )


def _finite(value: Any, low: float = 0.0) -> float:
    number = float(value)
    if isinstance(value, bool) or not math.isfinite(number) or number < low:
        raise ValueError(f"{value!r} is not a number of at least {low:g}")
    return number


def find_calibration(chosen: Path | None, model: Path | None) -> Calibration | None:
    """Return the calibration of a run: the chosen file's, nothing for ``none``, else that beside its model if any.

    ``unsure`` is the wide one beside the model.

    Parameters
    ----------
    model : as :func:`~pdhef_logtool.residual_model.bundle.open_model` takes it.

    Raises
    ------
    ModelError
        The file is missing or wrong.
    """
    beside = model_folder(model)
    if str(chosen) == UNSURE:
        if beside is None:
            raise ModelError(
                expected=f"a model folder with {UNSURE_FILE}", got="no model", where="--calibration unsure",
                remedy="name the file itself",
            )  # fmt: skip
        return load_calibration(beside / UNSURE_FILE)
    if chosen is not None:
        return None if str(chosen) == NO_CALIBRATION else load_calibration(chosen)
    return load_calibration(beside) if beside is not None and (beside / FILE).is_file() else None
