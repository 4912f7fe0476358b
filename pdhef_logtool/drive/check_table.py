"""The table of checks (``checks.toml``): their limits and texts, and the verdict on a value."""

import math
import tomllib
from pathlib import Path
from typing import Any

from pdhef_logtool.records.checks import Check, Verdict

TABLE: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("checks.toml").read_text(encoding="utf-8"))
#: Sentences of several checks, and the driving that a sign or a unit needs.
TEXTS: dict[str, str] = TABLE.pop("texts")
NEEDS: dict[str, Any] = TABLE.pop("needs")
#: Placeholder for the signal in the name of a check.
SIGNAL = "SIGNAL"
#: Standard errors outside the limits from which a value fails, and inside from which it passes.
FAILS_STD, PASSES_STD = 4.0, 2.0


def result(name: str, verdict: Verdict, signal: str = "", *, cause: str = "", **figures: Any) -> Check:
    """Return a check with the texts of its entry; ``cause``: key of another text than its remedy or its needs."""
    entry, figures = TABLE[name], {"signal": signal, **figures}
    evidence = entry["unknown"] if math.isnan(figures.get("value", 0.0)) else entry.get("evidence", "{evidence}")
    remedy = entry.get(cause or {"failed": "remedy", "undecided": "lacks"}.get(verdict, ""), "")
    name = name.replace(SIGNAL, signal)
    return Check(name, name.rpartition(".")[0], verdict, evidence.format(**figures), remedy.format(**figures))


def judge(name: str, value: float, std: float = 0.0, signal: str = "", *, doubt: str = "", **figures: Any) -> Check:
    """Return the check of a value by the limits of its entry; NaN is undecided.

    ``doubt``: key of the cause for which a value outside the limits is undecided.
    """
    low, high = TABLE[name]["limits"]
    verdict: Verdict = "undecided"
    is_outside = value + FAILS_STD * std < low or value - FAILS_STD * std > high
    if is_outside and not doubt:
        verdict = "failed"
    elif low <= value - PASSES_STD * std and value + PASSES_STD * std <= high:
        verdict = "passed"
    return result(name, verdict, signal, cause=doubt if is_outside else "", value=value, std=std, **figures)
