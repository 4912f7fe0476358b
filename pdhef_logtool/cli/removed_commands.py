"""Commands and options of former versions, and those that do their work now."""

from __future__ import annotations

from collections.abc import Sequence

_LEARN = "pdhef learn LOG... --car CAR -o CAR --stages"
REMOVED = {
    "identify": "pdhef learn LOG... --car CAR -o CAR",
    "tune": f"{_LEARN} noise",
    "trust": f"{_LEARN} gain",
    "calibrate": f"{_LEARN} intervals",
    "estimators": "pdhef run --list-estimators",
    "slim": "pdhef run LOG... -o OUT --cache DIR",
}


def replacement(words: Sequence[str]) -> str:
    """Return the message on a removed command, empty if the words of the command line name none."""
    command = next((word for word in words if not word.startswith("-")), "")
    return f"'{command}' was removed; use: {REMOVED[command]}" if command in REMOVED else ""


def replaced_option(words: Sequence[str]) -> str:
    """Return the message on an option that ``--plan`` has replaced, empty if there is none."""
    given = next((w.partition("=")[0] for w in words if w.partition("=")[0] in ("--thresholds", "--gate")), "")
    return (
        f"{given} was replaced by --plan; convert the file: pdhef plan init --from FILE -o plan.toml" if given else ""
    )
