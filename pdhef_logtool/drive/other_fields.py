"""Whether a mapping file reads a wrong field: recognition names another one of the log, and the drive decides.

A signal with a wrong unit still goes with the others; one that is read from another field often does too, by chance or
because both move in bends. Each suspicion is tested: such signals are read from the fields that recognition reads, and
only if all checks of them then pass, and fewer fail than before, the checks name those fields.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from pdhef_logtool.drive.checks.by_relations import AXIS, SUSPICIONS
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.mapping_file import entries_of
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import PdhefError

_MISREAD = (".sign", ".unit", ".axis", ".mounting", ".magnitude", ".frame", ".level")


def with_other_fields(
    checks: Sequence[Check],
    mapping: Mapping,
    checks_of: Callable[[Mapping], Sequence[Check]],
    recognise: Callable[[], Mapping],
) -> tuple[Check, ...]:
    """Return the checks of a mapping file, with those of signals replaced that another field of the log is right for.

    Parameters
    ----------
    checks_of : returns the checks of another mapping of the log. recognise : what is read without a mapping file.
    """
    failed = _contradicted(checks)
    if not failed:
        return tuple(checks)
    mounted = {c.subject for c in checks if c.verdict == "failed" and c.name.endswith(".mounting")}
    doubted = {c.subject for c in checks if c.verdict != "passed" and c.name.endswith(_MISREAD)}
    try:
        differing = {n: s for n, s in _others(recognise(), mapping).items() if n not in mounted}
    except PdhefError:  # nothing is recognised
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
    """Return by signal the source that recognition reads it from, where that is another one."""
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
    check = AXIS.failed(f"{evidence}; with {source.label} all checks of it pass", name, signal_name=name)
    entries = entries_of(source, "topic", "field", "scale")
    return replace(check, remedy=f"another field is mapped: in the mapping {entries}")
