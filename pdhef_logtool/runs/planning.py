"""The plan of a run of several logs: their labels, the settings, and which drives are done already."""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pdhef_logtool.logs.discovery import LogInput, as_taken, hash_log, with_free_stem
from pdhef_logtool.records.errors import PdhefError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.results.no_position import neutral_stem
from pdhef_logtool.results.opened_run import PAGE_FILE, PARTS, REPORT_FILE
from pdhef_logtool.results.run_report import tool_versions
from pdhef_logtool.runs.cars import RunCars, car_record
from pdhef_logtool.runs.config import Keep, RunConfig
from pdhef_logtool.runs.journal import Entry, Journal, Place, changes, digest_of, is_unchanged
from pdhef_logtool.runs.working import DriveEnd, log_identity

#: Each choice keeps the files of the choices before it, too.
_KEPT = ("metrics", "estimates", "full")
#: Settings that change no kept file, or that are compared separately; and those that name a file.
_NO_SETTING = frozenset({"keep", "annotate", "car", "cars", "network"})
_FILES = ("mapping", "msgs", "plan", "cars", "model", "sensor_profile")
_READERS = 16
_REPEATED = "they are tried again"
_DAMAGED = "their outputs are damaged"
_GONE = "their outputs are gone"


@dataclass(frozen=True, slots=True)
class PlannedLog:
    """A log under its label."""

    log: LogInput
    place: Place
    identity: str | None = None


def plan_logs(
    inputs: Sequence[LogInput], journal: Journal, *, twice: bool, neutral: bool = False, reporter: Reporter
) -> list[PlannedLog]:
    """Return the logs of a run with their labels, without logs of equal content unless ``twice``.

    ``neutral`` labels are made from the content, not from the name.

    A log is not read if the journal has its path, size and time; a new one only if another log has its size.
    """
    places = [Place.of(log) for log in inputs]
    sizes = Counter(place.bytes for place in places if place.is_local)
    labels = _Labels(journal, neutral)
    later: dict[int, str | None] = {}
    for number, (log, place) in enumerate(zip(inputs, places, strict=True)):
        label, identity, unchanged = journal.known(place)
        if unchanged and place.is_local and label not in labels.claimed:
            labels.claim(number, PlannedLog(replace(log, stem=label), place, identity))
        else:
            later[number] = identity if unchanged and place.is_local else None
    unknown = [
        number
        for number, identity in later.items()
        if identity is None and (neutral or (size := places[number].bytes) in journal.sizes or sizes[size] > 1)
    ]
    with ThreadPoolExecutor(_READERS) as readers:  # several at a time because servers wait
        identities = later | dict(zip(unknown, readers.map(log_identity, [inputs[n] for n in unknown]), strict=True))
    for number, identity in identities.items():
        log = inputs[number]
        if identity in labels.owner and not twice:
            reporter.warn(f"{log.path.name} has the same content as {labels.owner[identity]}: the drive is run once")
        else:
            labels.claim(number, labels.of(log, places[number], identity))
    return [labels.planned[number] for number in sorted(labels.planned)]


@dataclass(slots=True)
class _Labels:
    """Labels of logs while they are assigned: labels of the journal stay with their content, else with their path."""

    journal: Journal
    neutral: bool
    planned: dict[int, PlannedLog] = field(default_factory=dict)
    owner: dict[str, str] = field(default_factory=dict)
    claimed: set[str] = field(default_factory=set)
    _taken: set[str] = field(init=False)

    def __post_init__(self) -> None:
        self._taken = {as_taken(label) for label in self.journal.entries}

    def claim(self, number: int, log: PlannedLog) -> None:
        """Assign the label of a planned log."""
        self.planned[number] = log
        self.claimed.add(log.log.stem)
        if log.identity is not None:
            self.owner.setdefault(log.identity, log.log.path.name)

    def of(self, log: LogInput, place: Place, identity: str | None) -> PlannedLog:
        """Return a log with the first label that is free: of its content, of its path, or a new one."""
        for label in () if identity is None else self.journal.labels.get(identity, ()):
            if label not in self.claimed:
                return PlannedLog(replace(log, stem=label), place, identity)
        if (was := self.journal.known(place)[0]) and was not in self.claimed:
            return PlannedLog(replace(log, stem=was), place, identity)  # another content: it is run again
        log = replace(log, stem=neutral_stem(identity)) if self.neutral else log
        new = with_free_stem(log, self._taken)
        self._taken.add(as_taken(new.stem))
        return PlannedLog(new, place, identity)


def settings_of(config: RunConfig) -> dict[str, str]:
    """Return, as texts, the settings that a drive's files depend on, besides the log and its car."""
    settings = {
        f"--{key.replace('_', '-')}": ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
        for key, value in config.to_dict().items()
        if key not in _NO_SETTING and key not in _FILES and value is not None
    }
    for key in _FILES:
        path = getattr(config, key)
        if path is not None:
            settings[f"--{key}"] = hash_log(path) if path.exists() else str(path)
    settings["--annotate"] = config.annotate or "none named"
    settings |= {f"version of {name}": version for name, version in tool_versions().items()}
    return settings


@dataclass(slots=True, eq=False)
class Plan:
    """The logs of a run, their settings, and the journal in the output folder.

    ``is_remote``: of the outputs only reports and figures are in the folder.
    """

    output: Path
    journal: Journal
    logs: Sequence[PlannedLog]
    settings: dict[str, str]
    cars: RunCars
    is_remote: bool = False
    _current_cars: dict[str, dict[str, Any]] | None = None
    _damages: dict[int, str | None] = field(default_factory=dict)
    setting: str = field(init=False)

    def __post_init__(self) -> None:
        self.setting = digest_of(self.settings)

    def begin(self) -> None:
        """Begin the journal with the settings."""
        self.journal.begin()
        self.journal.describe("setting", self.setting, self.settings)

    def entry(self, log: PlannedLog) -> Entry | None:
        """Return the journal's entry of a log if it is done, whichever files were kept."""
        entry = self.journal.entries.get(log.log.stem)
        if entry is None or self._reason(log, "metrics", retry=False) not in (None, _REPEATED):
            return None
        return entry

    def pending(self, names: Sequence[str] | None, keep: Keep, retry: bool, note: Reporter) -> list[PlannedLog]:
        """Return the logs to process, of all or of those named, and report why logs are repeated or left out."""
        chosen = [p for p in self.logs if names is None or p.log.stem in set(names)]
        reasons = {p.log.stem: self._reason(p, keep, retry) for p in chosen}
        if names is None and self.journal.entries:
            self._report(chosen, [r for r in reasons.values() if r], retry, note)
        elif damaged := sum(self._reason(p, "metrics", retry=False) == _DAMAGED for p in self.logs if p not in chosen):
            note.note(f"{damaged} other drives are left out of the run until --resume: {_DAMAGED}")
        return [p for p in chosen if reasons[p.log.stem] is not None]

    def worst(self, count: int) -> list[str]:
        """Return the labels of the scored drives with the largest sideslip errors of the selected estimate."""
        entries = [e for p in self.logs if (e := self.entry(p)) is not None and e.error_rad is not None]
        return [e.label for e in sorted(entries, key=lambda e: (-(e.error_rad or 0.0), e.label))[:count]]

    def cars_of_run(self) -> dict[str, dict[str, Any]]:
        """Return the records of the run's present cars by digest, without cars that cannot be read."""
        if self._current_cars is None:
            self._current_cars, cars = {}, replace(self.cars, warn=lambda _: None)
            for path in cars.paths:
                with suppress(PdhefError):
                    record = car_record(cars.read(path))
                    self._current_cars[digest_of(record["parts"])] = record
        return self._current_cars

    def check_only(self, names: Sequence[str]) -> None:
        """Check the names of ``--repeat``; raises UsageError if one names no log or the settings of the run differ."""
        labels = {p.log.stem for p in self.logs}
        if missing := [name for name in names if name not in labels]:
            near = ", ".join(sorted(labels)[:10]) + (" and more" if len(labels) > 10 else "")
            raise UsageError(expected=f"the name of a log ({near})", got=missing[0], where="--repeat")
        entries = (self.journal.entries.get(p.log.stem) for p in self.logs if names)
        for entry in entries:
            if entry is not None and (why := [*self._changes(entry)]):
                raise UsageError(
                    expected="the settings of the run in the folder",
                    got=", ".join(why),
                    where="--repeat",
                    remedy="--resume runs its logs again",
                )

    def _reason(self, log: PlannedLog, keep: str, retry: bool) -> str | None:
        """Return why a log is to be run, empty for a new one; None if it is done."""
        entry = self.journal.entries.get(log.log.stem)
        if entry is None:
            return ""
        if entry.quarantined:
            return _REPEATED if retry else None
        if entry.place != log.place and entry.identity != log.identity:
            return "their logs have changed"
        if why := [*self._changes(entry)]:
            return ", ".join(why)
        if entry.failed:
            return _REPEATED if retry or entry.again else None
        if _KEPT.index(entry.keep) < _KEPT.index(keep):
            return f"{keep} is to be kept of them"
        if entry.offset not in self._damages:
            changed = self._changed_outputs(entry, pages=False)
            gone = any(not (self.output / name).is_file() for name in changed)
            self._damages[entry.offset] = _GONE if gone else _DAMAGED if changed else None
        return self._damages[entry.offset]

    def _changed_outputs(self, entry: Entry, *, pages: bool) -> list[str]:
        """Return the pages or other files of a drive that are not as they were written, as far as they are here."""
        files = {n: s for n, s in self.journal.outputs(entry).items() if n.endswith(f"/{PAGE_FILE}") == pages}
        if self.is_remote:
            files = {n: s for n, s in files.items() if n == entry.part or n.endswith(f"/{REPORT_FILE}")}
        return [name for name, state in files.items() if not is_unchanged(self.output / name, state)]

    def damaged_pages(self) -> set[str]:
        """Return the labels of drives with changed pages."""
        entries = (entry for p in self.logs if (entry := self.entry(p)) is not None)
        return {e.label for e in entries if self._changed_outputs(e, pages=True)}

    def record(self, log: PlannedLog, end: DriveEnd, keep: str, *, quarantined: bool) -> None:
        """Write how a drive ended, and its car, into the journal, then remove its former figures."""
        car = None if end.car is None else digest_of(end.car["parts"])
        if car is not None and end.car is not None:
            self.journal.describe("car", car, end.car)
            self.cars_of_run()[car] = end.car
        failed = end.outcome.failed is not None and end.part is None
        entry = Entry(
            log.log.stem, log.place, end.identity or log.identity, self.setting, car, keep, end.part, end.error_rad,
            failed, end.again, quarantined,
        )  # fmt: skip
        before = self.journal.entries.get(entry.label)
        self._damages[self.journal.add(entry, end.outcome, end.outputs).offset] = None
        if before is not None and before.part not in (None, entry.part):
            (self.output / str(before.part)).unlink(missing_ok=True)

    def _changes(self, entry: Entry) -> Iterator[str]:
        """Yield as texts which settings and car of a drive have changed."""
        if entry.setting != self.setting:
            yield from changes(self.journal.described["setting"].get(entry.setting, {}), self.settings)
        if entry.car is not None and entry.car not in self.cars_of_run():
            old = self.journal.described["car"].get(entry.car, {})
            new = next((c for c in self.cars_of_run().values() if c["name"] == old.get("name")), {})
            yield from [*changes(old.get("parts", {}), new.get("parts", {}))] if new else ["another car"]

    def _report(self, chosen: Sequence[PlannedLog], reasons: Sequence[str], retry: bool, reporter: Reporter) -> None:
        """Report which drives of an earlier run are kept, repeated or left out."""
        for why, count in Counter(reasons).most_common():
            reporter.note(f"{count} of {len(chosen)} drives are run again: {why}")
        entries = [e for p in chosen if (e := self.journal.entries.get(p.log.stem)) is not None]
        quarantined = sum(e.quarantined for e in entries)
        if quarantined and not retry:
            reporter.note(f"{quarantined} logs that took their worker along are not tried again; --repeat failed does")
        if other := len(self.journal.entries) - len(entries):
            reporter.note(
                f"{other} drives in the output are of logs that are not named now: they are left out of the run"
            )


def sweep_parts(journal: Journal, output: Path) -> None:
    """Remove parts of tables that no drive of the journal has, and the remains of killed workers."""
    kept = {entry.part for entry in journal.entries.values()}
    root = output / PARTS
    for path in list(itertools.chain(root.rglob("*.parquet"), root.rglob(".*.partial"))):
        if path.relative_to(output).as_posix() not in kept:
            path.unlink(missing_ok=True)
