"""A mapping by questions: for each signal the selected field, its alternatives, and the user's answer."""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
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
    mapping, topics = inspection.mapping, {t.name for t in inspection.topics}
    tell(HELP)
    for section, title, names in QUESTIONS:
        sources = dict(getattr(mapping, section))
        taken = next((sources[n] for n in names if n in sources), None)
        others = [c for c in inspection.candidates if c.section == section and c.source.name in names and not c.taken]
        if section == "truth" and taken is None and not others:
            continue
        tell("")
        tell(title)
        if taken is not None:
            tell(f"  * {taken.label} as {taken.name}, scale {taken.scale}")
        for number, candidate in enumerate(others, 1):
            tell(f"  {number} {candidate.source.name}: {candidate}")
        while isinstance(answer := _answered(ask("? ").split(), names, taken, others, topics), str):
            tell(answer)
        sources = {name: source for name, source in sources.items() if name not in names}
        if answer is not None:
            sources[answer.name] = answer
        mapping = replace(mapping, signals=sources) if section == "signals" else replace(mapping, truth=sources)
    tell(f"missing: {', '.join(missing_signals(mapping)) or 'no signal'}")
    return replace(mapping, checks=())


def _answered(
    words: Sequence[str],
    names: Sequence[str],
    taken: SignalSource | None,
    others: Sequence[Candidate],
    topics: Collection[str],
) -> SignalSource | str | None:
    """Return the source that an answer chooses, or a text if it is not understood."""
    if not words:
        return taken
    if len(words) == 1:
        number = int(words[0]) if words[0].isdigit() else 0
        return None if words[0] == "-" else others[number - 1].source if 1 <= number <= len(others) else HELP
    if len(words) <= 3 and words[0] not in topics:
        return f"no topic {words[0]}; pdhef inspect lists them"
    with suppress(ValueError):
        scale = float(words[2]) if len(words) > 2 else 1.0
        if len(words) <= 3 and scale != 0.0:
            name = names[0] if len(names) == 1 or taken is None else taken.name
            return SignalSource(name, words[0], words[1], scale=scale)
    return HELP
