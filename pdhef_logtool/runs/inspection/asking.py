"""A mapping by questions: for each signal the selected field, its alternatives, and the user's answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from pdhef_logtool.mapping import Mapping, SignalSource
from pdhef_logtool.mapping.candidates import Candidate
from pdhef_logtool.mapping.mapping_file import missing_signals
from pdhef_logtool.runs.inspection.report import Inspection

#: Questions in order; a steering angle is either of two signals.
QUESTIONS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("signals", "steering angle (left positive)", ("steer_rad", "steering_wheel_rad")),
    ("signals", "yaw rate (left positive)", ("yaw_rate_rad_s",)),
    ("signals", "lateral acceleration (left positive)", ("ay_m_s2",)),
    ("signals", "longitudinal acceleration (forward positive)", ("ax_m_s2",)),
    ("signals", "speed", ("speed_m_s",)),
    ("truth", "true forward velocity", ("vx_m_s",)),
    ("truth", "true lateral velocity (left positive)", ("vy_m_s",)),
    ("truth", "true sideslip (left positive)", ("sideslip_rad",)),
)
HELP = "Enter keeps *, a number takes that candidate, - takes none, or type: TOPIC FIELD [SCALE]"


def ask_mapping(inspection: Inspection, ask: Callable[[str], str], tell: Callable[[str], None]) -> Mapping:
    """Ask for each signal and ground truth quantity; return the mapping of the answers.

    Parameters
    ----------
    ask : prints a question and returns the line that is answered. tell : prints a line.
    """
    mapping = inspection.mapping
    tell(HELP)
    for section, title, names in QUESTIONS:
        sources = dict(mapping.signals if section == "signals" else mapping.truth)
        taken = next((sources[n] for n in names if n in sources), None)
        others = [c for c in inspection.candidates if c.section == section and c.source.name in names and not c.taken]
        if section == "truth" and taken is None and not others:
            continue
        topics = frozenset(t.name for t in inspection.topics)
        answer = _answer(title, names, taken, others, topics, ask, tell)
        for name in names:
            sources.pop(name, None)
        if answer is not None:
            sources[answer.name] = answer
        mapping = replace(mapping, signals=sources) if section == "signals" else replace(mapping, truth=sources)
    tell(f"missing: {', '.join(missing_signals(mapping)) or 'no signal'}")
    return replace(mapping, checks=())


def _answer(
    title: str,
    names: tuple[str, ...],
    taken: SignalSource | None,
    others: Sequence[Candidate],
    topics: frozenset[str],
    ask: Callable[[str], str],
    tell: Callable[[str], None],
) -> SignalSource | None:
    tell("")
    tell(title)
    if taken is not None:
        tell(f"  * {taken.label} as {taken.name}, scale {taken.scale}")
    for number, candidate in enumerate(others, 1):
        tell(f"  {number} {candidate.source.name}: {candidate}")
    while True:
        text = ask("? ").strip()
        if not text:
            return taken
        if text == "-":
            return None
        if text.isdigit() and 1 <= int(text) <= len(others):
            return others[int(text) - 1].source
        words = text.split()
        if len(words) in (2, 3) and words[0] not in topics:
            tell(f"no topic {words[0]}; pdhef inspect lists them")
            continue
        if len(words) in (2, 3) and _is_number(words[2:]):
            scale = float(words[2]) if len(words) == 3 else 1.0
            name = names[0] if len(names) == 1 or taken is None else taken.name
            return SignalSource(name, words[0], words[1], scale=scale)
        tell(HELP)


def _is_number(words: Sequence[str]) -> bool:
    try:
        return all(float(w) != 0.0 for w in words)
    except ValueError:
        return False
