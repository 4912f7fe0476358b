"""One check of a log, its truth or its vehicle file: passed, failed, or undecided because the drive cannot tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

Verdict: TypeAlias = Literal["passed", "failed", "undecided"]


@dataclass(frozen=True, slots=True)
class Check:
    """What one relation says of one signal.

    Attributes
    ----------
    name : what a person waives it by, for example ``steering_wheel_angle_rad.sign``; no two of a log share one.
    subject : signal, truth quantity or ``vehicle`` that is judged.
    verdict : ``undecided`` where the drive does not excite what the relation needs.
    evidence : one sentence with figures.
    remedy : what to do about it; empty where it passed.
    waived : the person has said that it does not count.
    """

    name: str
    subject: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    waived: bool = False
