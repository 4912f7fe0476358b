"""Results of teaching with ground truth: prior of the calibration, and residual of ``physics``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from pdhef_logtool.car.parts import LearntOn, Sha256
from pdhef_logtool.car.vehicle import Positive, Record
from pdhef_logtool.residual_model.ladder import LadderModel

#: Sources of the error that teaching uses.
GROUND_TRUTH, ESTIMATED = "ground truth", "estimated reference"


class TaughtParameter(Record):
    """Prior of a calibration parameter: mean and standard deviation, of the logarithm for parameters fitted as such.

    ``ay_m_s2`` : lateral acceleration of the drives; 0 if unknown.
    """

    name: str
    value: float
    std: Positive
    ay_m_s2: Annotated[float, Field(ge=0)] = 0.0


class Taught(Record):
    """``taught.json``, written by ``pdhef learn``: results of teaching with ground truth.

    Attributes
    ----------
    physics_sha256 : of the vehicle file.
    parameters : prior of the calibration of later drives. residual : of the sideslip after the calibration; None if no
        residual reduces the error by enough.
    calibrated : whether the residual is relative to the calibrated car; otherwise to the vehicle file.
    truth : source, :data:`GROUND_TRUTH`, :data:`ESTIMATED`, or both.
    figures : evidence and recommended drives.
    """

    format: Literal["pdhef-taught"] = "pdhef-taught"
    version: Literal[1] = 1
    physics_sha256: Sha256
    parameters: Annotated[tuple[TaughtParameter, ...], Field(strict=False)] = ()
    residual: LadderModel | None = None
    calibrated: bool = True
    truth: str = GROUND_TRUTH
    evidence: str = ""
    drives: Annotated[tuple[LearntOn, ...], Field(strict=False)] = ()
    figures: dict[str, Any] = Field(default_factory=dict)
