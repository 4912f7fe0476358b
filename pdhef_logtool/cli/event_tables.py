"""What ``pdhef events`` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pdhef_logtool.cli.console import table

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.results.events import FoundEvents

#: Events, and drives that were left out for one reason, that are named.
_MOST_EVENTS, _MOST_NAMED = 50, 5


def render_events(events: FoundEvents, console: Console) -> None:
    """Print the events, and what was not searched."""
    if events.events:
        made = table("drive", ">from, s", ">to, s", ">for, s", ">peak", fold=1)
        for event in events.events[:_MOST_EVENTS]:
            peak = "-" if event.peak is None else f"{event.peak:.4g}"
            seconds = f"{event.end_s - event.start_s:.2f}"
            made.add_row(event.drive, f"{event.start_s:.2f}", f"{event.end_s:.2f}", seconds, peak)
        console.print(made)
        if (more := len(events.events) - _MOST_EVENTS) > 0:
            console.print(f"  and {more} more: --json, --parquet")
    seconds_in_all = sum(e.end_s - e.start_s for e in events.events)
    drives = len({e.drive for e in events.events})
    summary = f"{len(events.events)} event{'s' * (len(events.events) != 1)} in {drives} of {events.searched} drives"
    console.print(f"{summary}, {seconds_in_all:.2f} s in all")
    reasons: dict[str, list[str]] = {}
    for drive, reason in events.left_out.items():
        reasons.setdefault(reason, []).append(drive)
    for reason, names in reasons.items():
        more_names = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        console.print(f"not searched, {reason}: {', '.join(names[:_MOST_NAMED])}{more_names}")
    for clip in events.clips:
        console.print(f"clip: {clip}", soft_wrap=True)
