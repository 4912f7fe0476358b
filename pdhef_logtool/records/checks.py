"""One check of a log, its ground truth or its vehicle file: passed, failed, or undecided (not observable)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

Verdict: TypeAlias = Literal["passed", "failed", "undecided"]


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one relation for one signal.

    Attributes
    ----------
    name : what a person waives it by, for example ``steering_wheel_angle_rad.sign``; no two of a log share one.
    subject : signal, ground truth quantity or ``vehicle`` that is judged.
    verdict : ``undecided`` where the drive does not excite what the relation needs.
    evidence : one sentence with figures.
    remedy : what to do about it; empty where it passed.
    waived : the user has accepted it.
    """

    name: str
    subject: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    waived: bool = False
