"""Clips: one MCAP per event, with the messages of the source around it and our tracks."""

from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from pdhef_logtool.logs.discovery import hash_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import OutputError, PdhefError
from pdhef_logtool.records.signals import NS_PER_S
from pdhef_logtool.results.events import FoundEvents
from pdhef_logtool.results.mcap_sink import NAMESPACE, AnnotatedMcap
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog, OpenedRun
from pdhef_logtool.results.parquet_sink import list_estimators, read_track
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.outputs import FolderTransaction, OutputFolder

#: Folder of clips in the outputs of a run; it contains the clips of the last search.
CLIPS = "clips"
_ANNOTATED = "annotated.mcap"


def write_clips(
    run: OpenedRun,
    found_events: FoundEvents,
    *,
    pad_s: float,
    named: Collection[str] = (),
    source: Path | None = None,
    tell: Callable[[str], None] = lambda _text: None,
) -> FoundEvents:
    """Write one clip per event to ``OUT/clips``, in place of earlier clips; return the events with their files.

    Parameters
    ----------
    pad_s : seconds before and after the event.
    named : tracks that clips have beside the ground truth and those that the report shows.
    source : folder (or file) with the logs; None takes the full copies that the run wrote.
    tell : called with a line for people on parts that a clip lacks.

    Raises
    ------
    OutputError : The clips cannot be written.
    """
    logs = {log.label: log for log in run.logs}
    names: list[str] = []
    incomplete, pad_ns = 0, round(pad_s * NS_PER_S)
    with OutputFolder(run.folder), FolderTransaction(run.folder / CLIPS, keep=False) as change:
        for label, events in groupby(found_events.events, key=lambda event: event.drive):
            log = logs[label]
            try:
                opened = open_log(_source_of(log, source))
            except PdhefError as error:
                incomplete += 1
                tell(f"{label}: no clip: {error}")
                continue
            with closing(opened):
                if opened.messages is None or all(t.name.startswith(NAMESPACE) for t in opened.topics):
                    what = "no messages to copy; --source DIR names the log"
                    tell(f"{label}: clips contain the tool's tracks only: {what}")
                report, estimates = log.report() or {}, log.file(ESTIMATES_FILE)
                assert estimates is not None
                wanted = {TRUTH, log.main(), *((report.get("answer") or {}).get("shown") or ()), *named}
                tracks = [read_track(estimates, name) for name in list_estimators(estimates) if name in wanted]
                for event in events:
                    span_ns = max(event.start_ns - pad_ns, opened.start_ns), min(event.end_ns + pad_ns, opened.end_ns)
                    name = f"{label}_{event.start_s:.2f}s.mcap"
                    cut = [track.between(*span_ns) for track in tracks]
                    with AnnotatedMcap(change.file(name), opened, span_ns=span_ns) as clip:
                        clip.write(cut)
                        clip.finish(report, cut)
                    names.append(str(run.folder / CLIPS / name))
                incomplete += any(loss.severity == "lost" for loss in opened.lost)
    return replace(found_events, clips=tuple(names), unreadable=found_events.unreadable + incomplete)


def _source_of(log: OpenedLog, folder: Path | None) -> Path:
    """Return a file with all messages of the source of a drive; raises OutputError if it does not exist."""
    sha256, name = log.entry.get("sha256"), str(log.entry.get("file", ""))
    if folder is not None:
        candidates = [folder] if folder.name == name else sorted(p for p in folder.rglob("*") if p.name == name)
        for path in candidates:
            if sha256 is not None and hash_log(path) == sha256:
                return path
        got = f"{len(candidates)} of that name with other content" if candidates else "none of that name"
        raise OutputError(expected=f"the log {name}", got=got, where=folder, remedy="name its folder by --source")
    if (copy := log.file(_ANNOTATED)) is not None:
        return copy
    raise OutputError(
        expected=f"a full copy of {name}, {_ANNOTATED}",
        got="a run without one",
        where=log.folder,
        remedy="name the folder of the logs: --source DIR",
    )
