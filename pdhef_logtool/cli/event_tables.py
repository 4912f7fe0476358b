"""Output of ``pdhef events``."""

from __future__ import annotations

from rich.console import Console

from pdhef_logtool.cli.console import table, three_lines
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.events import FoundEvents

#: Largest number of events in the output.
_MOST_EVENTS = 50


def render_events(events: FoundEvents, console: Console) -> None:
    """Print the events, and the drives that were not searched."""
    total_s = sum(e.end_s - e.start_s for e in events.events)
    drives, count = len({e.drive for e in events.events}), len(events.events)
    summary = f"{count} event{'s' * (count != 1)} in {drives} of {events.searched} drives, {total_s:.2f} s in all"
    left_out = f"; {len(events.left_out)} drives are not searched, see below" if events.left_out else ""
    following = "no action needed" if not count or events.clips else "--clip writes one MCAP file per event"
    console.print(three_lines(summary, f"{events.where} of {events.of}{left_out}", following))
    console.print()
    if events.events:
        made = table("drive", ">from, s", ">to, s", ">for, s", ">peak", fold=1)
        for event in events.events[:_MOST_EVENTS]:
            peak = "-" if event.peak is None else f"{event.peak:.4g}"
            lasts = f"{event.end_s - event.start_s:.2f}"
            made.add_row(event.drive, f"{event.start_s:.2f}", f"{event.end_s:.2f}", lasts, peak)
        console.print(made)
        if (more := len(events.events) - _MOST_EVENTS) > 0:
            console.print(f"  and {more} more: --json")
    for reason, names in gathered((reason, drive) for drive, reason in events.left_out.items()).items():
        console.print(f"not searched, {reason}: {listed(names)}")
    for clip in events.clips:
        console.print(f"clip: {clip}", soft_wrap=True)
