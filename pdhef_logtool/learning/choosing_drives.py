"""Which drives a fitting command takes: those of a split, and none that would make a figure too good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from pdhef_logtool.learning.network.extract_command import set_manifest
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import UsageError

#: Drives that are named in an error.
_NAMED = 3


@dataclass(frozen=True, slots=True)
class Refusal:
    """Splits that a command refuses, what it expects instead, who says so, and what to do."""

    splits: tuple[str, ...]
    expected: str
    where: str
    remedy: str


class Choice(Protocol):
    """What a command's settings say: only drives of ``split`` (None: all), and whether no split is refused."""

    @property
    def split(self) -> str | None:
        """The split, None for all."""
        ...

    @property
    def any_split(self) -> bool:
        """Whether no split is refused."""
        ...


def choose_drives(
    inputs: Sequence[LogInput], choice: Choice, refusal: Refusal
) -> tuple[list[LogInput], dict[str, str]]:
    """Return the logs to take, and by name the split that the manifest of a set beside a log gives it.

    Raises
    ------
    UsageError
        A drive is of a refused split, or none is left.
    """
    manifests = cache(set_manifest)
    splits = {i.stem: str(manifests(i.path.parent).get(i.path.name, {}).get("split") or "") for i in inputs}
    if choice.split is not None:
        inputs = [i for i in inputs if splits[i.stem] == choice.split]
        if not inputs:
            there = ", ".join(sorted({s for s in splits.values() if s}))
            raise UsageError(
                expected=f"drives of split {choice.split}",
                got=f"drives of {there}" if there else "drives without a set's manifest beside them",
                where="--split",
            )
    refused = [f"{i.stem} ({splits[i.stem]})" for i in inputs if splits[i.stem] in refusal.splits]
    if refused and not choice.any_split:
        more = f" and {len(refused) - _NAMED} more" if len(refused) > _NAMED else ""
        raise UsageError(
            expected=refusal.expected,
            got=", ".join(refused[:_NAMED]) + more,
            where=refusal.where,
            remedy=refusal.remedy,
        )
    return list(inputs), {i.stem: splits[i.stem] for i in inputs if splits[i.stem]}
