"""The answers that were written by hand for recordings of other people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.mapping import SignalSource
from studies.pages import ROOT, read_toml
from studies.strangers.cars import Series
from studies.strangers.recordings import Expected
from studies.strangers.scoring import read_answers

SHARED = ROOT.parent / "shared"
ANSWERS = Path(__file__).with_name("answers.toml")


@dataclass(frozen=True, slots=True)
class Answer:
    """Right sources of one recording by channel (alternatives), sources that are also allowed, and faulty channels."""

    file: str
    right: dict[str, tuple[SignalSource, ...]]
    allowed: dict[str, tuple[SignalSource, ...]]
    at_fault: frozenset[str]

    @property
    def path(self) -> Path:
        """Where the recording lies, if it is there."""
        return SHARED / self.file

    def expected(self) -> Expected:
        """Read the right and the allowed channels."""
        right, allowed = (_read(self.path, sources) for sources in (self.right, self.allowed))
        return Expected(self.file, "recording", "", right, allowed, at_fault=self.at_fault)


def load_answers() -> Iterator[Answer]:
    """Yield all of them, whether the recordings are there or not."""
    for file, table in read_toml(ANSWERS).items():
        if "same_as" not in table:
            yield Answer(
                file, _sources(table), _sources(table.get("allowed", {})), frozenset(table.get("at_fault", ()))
            )


def answered_files() -> frozenset[str]:
    """Return the recordings that somebody has looked at."""
    return frozenset(read_toml(ANSWERS))


def _sources(table: dict[str, Any]) -> dict[str, tuple[SignalSource, ...]]:
    sources_by_name = {}
    for name, given in table.items():
        if name not in ("allowed", "at_fault"):
            texts = given if isinstance(given, list) else [given]
            sources_by_name[name] = tuple(_source(name.removeprefix("truth."), text) for text in texts)
    return sources_by_name


def _source(name: str, text: str) -> SignalSource:
    topic, field, *numbers = text.split()
    scale, offset = (*map(float, numbers), *(1.0, 0.0)[len(numbers) :])
    if name.endswith("ecef_velocity_m_s"):
        return SignalSource(name, topic, field)
    return SignalSource(name, topic, field, scale=scale, offset=offset)


def _read(path: Path, sources: dict[str, tuple[SignalSource, ...]]) -> dict[str, tuple[Series, ...]]:
    sources_by_name: dict[str, tuple[Series, ...]] = {}
    for turn in range(max((len(s) for s in sources.values()), default=0)):
        here = {n: s[turn] for n, s in sources.items() if turn < len(s)}
        truth = {n.removeprefix("truth."): s for n, s in here.items() if n.startswith("truth.")}
        signals = {n: s for n, s in here.items() if not n.startswith("truth.")}
        for name, series in read_answers(path, SignalMapping(signals=signals, truth=truth)).items():
            sources_by_name[name] = (*sources_by_name.get(name, ()), *series)
    return sources_by_name
