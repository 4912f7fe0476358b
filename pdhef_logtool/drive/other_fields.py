"""Detection of wrong fields in a mapping file: recognition proposes other fields, and the drive decides.

A signal from a wrong field may still correlate with the others, by chance or because both move in bends. Suspicious
signals are therefore read from the fields that recognition proposes. If all of their checks then pass, and fewer checks
fail than before, the checks name these fields.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from pdhef_logtool.drive.check_table import TEXTS, result
from pdhef_logtool.drive.relation_checks import SUSPICIONS
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.mapping_file import entries_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import PdhefError

_MISREAD = (".sign", ".unit", ".axis", ".mounting", ".frame", ".level")


def with_other_fields(
    checks: Sequence[Check],
    mapping: Mapping,
    checks_of: Callable[[Mapping], Sequence[Check]],
    recognise: Callable[[], Mapping],
) -> tuple[Check, ...]:
    """Return the checks of a mapping file; for signals with a better field in the log, the check names that field.

    Parameters
    ----------
    checks_of : returns the checks of another mapping of the log. recognise : returns the mapping without a file.
    """
    failed = _contradicted(checks)
    if not failed:
        return tuple(checks)
    mounted = {c.subject for c in checks if c.verdict == "failed" and c.name.endswith(".mounting")}
    doubted = {c.subject for c in checks if c.verdict != "passed" and c.name.endswith(_MISREAD)}
    try:
        differing = {n: s for n, s in _others(recognise(), mapping).items() if n not in mounted}
    except PdhefError:  # no signal is recognised
        return tuple(checks)
    for others in ({n: s for n, s in differing.items() if n in doubted}, differing):
        try:
            again = checks_of(_replaced(mapping, others)) if others else ()
        except PdhefError:  # the other fields cannot be read
            continue
        still = _contradicted(again)
        wrong = {c.subject for c in again if c.name in still}
        if others and not wrong & others.keys() and len(still) < len(failed):
            break
    else:
        return tuple(checks)
    renamed = tuple(_check(name, source, checks) for name, source in others.items())
    kept = (c for c in checks if c.subject not in others and c.name not in failed - still)
    return (*renamed, *kept)


def _contradicted(checks: Sequence[Check]) -> set[str]:
    about = (c for c in checks if c.name.endswith(_MISREAD))
    return {c.name for c in about if c.verdict == "failed" or c.remedy.startswith(SUSPICIONS)}


def _others(recognised: Mapping, mapping: Mapping) -> dict[str, SignalSource]:
    """Return by signal the recognised source, where it differs from the mapping's."""
    pairs = [(n, s, recognised.signals.get(n)) for n, s in mapping.signals.items()]
    pairs += [(f"truth.{n}", s, recognised.truth.get(n)) for n, s in mapping.truth.items()]
    return {
        name: replace(other, latency_s=source.latency_s)
        for name, source, other in pairs
        if other is not None and (other.topic, other.paths) != (source.topic, source.paths)
    }


def _replaced(mapping: Mapping, others: dict[str, SignalSource]) -> Mapping:
    of_truth = {n.removeprefix("truth."): s for n, s in others.items() if n.startswith("truth.")}
    of_signals = {n: s for n, s in others.items() if not n.startswith("truth.")}
    return replace(mapping, signals={**mapping.signals, **of_signals}, truth={**mapping.truth, **of_truth})


def _check(name: str, source: SignalSource, checks: Sequence[Check]) -> Check:
    doubts = [c for verdict in ("failed", "undecided") for c in checks if (c.subject, c.verdict) == (name, verdict)]
    evidence = doubts[0].evidence if doubts else "it contradicts others that fail"
    evidence = TEXTS["other_field"].format(evidence=evidence, label=source.label)
    entries = entries_of(source, "topic", "field", "scale")
    return result("SIGNAL.axis", "failed", name, cause="other", evidence=evidence, entries=entries)
