"""What drives with ground truth taught about a car: prior of its calibration, and residual of ``physics``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from pdhef_logtool.car.parts import LearntOn, Sha256
from pdhef_logtool.car.vehicle import Positive, Record
from pdhef_logtool.residual_model.ladder import LadderModel

#: What teaches.
GROUND_TRUTH, ESTIMATED = "ground truth", "estimated reference"


class TaughtParameter(Record):
    """Prior of a parameter of the calibration: mean and standard deviation, of its logarithm where that is fitted.

    ``ay_m_s2`` : lateral acceleration of the driving that taught it; 0 = not stated.
    """

    name: str
    value: float
    std: Positive
    ay_m_s2: Annotated[float, Field(ge=0)] = 0.0


class Taught(Record):
    """``taught.json``, written by ``pdhef learn``: what drives with ground truth taught about a car.

    Attributes
    ----------
    physics_sha256 : of the vehicle file that it is about.
    parameters : prior of the calibration of every later drive. residual : of the sideslip after it; None: none is
        worth its uncertainty.
    calibrated : whether the drives of ``residual`` calibrated their car; else it is one of the vehicle file.
    truth : what taught, :data:`GROUND_TRUTH`, :data:`ESTIMATED`, or both.
    figures : evidence and what to drive next.
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
