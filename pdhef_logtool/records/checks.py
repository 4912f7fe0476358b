"""Check of a log, its ground truth or its vehicle file: passed, failed, or undecided (not observable)."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

Verdict: TypeAlias = Literal["passed", "failed", "undecided"]


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check of one signal.

    Attributes
    ----------
    name : unique name, also for ``--waive``, for example ``steering_wheel_angle_rad.sign``.
    subject : signal, ground truth quantity or ``vehicle``.
    verdict : ``undecided`` if the drive lacks the necessary excitation.
    evidence : one sentence with figures.
    remedy : next step for the user; empty for a passed check.
    waived : the user has accepted it.
    """

    name: str
    subject: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    waived: bool = False
