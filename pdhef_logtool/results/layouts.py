"""foxglove.json and plotjuggler.xml: what to plot of an annotated log, to be opened in Foxglove or PlotJuggler."""

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.dead_reckoned import pose_known
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.mcap_sink import LOG_TOPIC, MAP_FRAME, topic_of
from pdhef_logtool.results.plotted import ERRORS, STATES, colour_rgb
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import template

#: Fields of a track's topic ``state`` with their titles; :data:`_STATES` change rarely.
_FILTER = {
    "nis": "Normalised innovation squared",
    "valid": "Valid",
    "diverged": "Diverged",
    "reason": "Reason (sum of bits)",
}
_STATES = ("valid", "diverged", "reason")


def write_layouts(
    foxglove: Path,
    plotjuggler: Path,
    tracks: Sequence[StateTrack],
    colours: Mapping[str, int],
    *,
    shown: Collection[str],
    fixes: Sequence[str] = (),
) -> None:
    """Write the layouts for the topics that :class:`~.mcap_sink.AnnotatedMcap` writes of the same tracks.

    Parameters
    ----------
    foxglove, plotjuggler : the finished files.
    colours : 0xRRGGBB by estimator. shown : tracks with lines and intervals that are visible at first.
    fixes : topics of satellite fixes in the log, for a map.
    """
    drawn = {t.name: "#{:02x}{:02x}{:02x}".format(*colour_rgb(t.name, colours)) for t in tracks}
    estimates = [name for name in drawn if name != TRUTH]
    tabs = {
        "Estimates": [_panel(p.title, p.name, [*drawn], limits=p.limits) for p in STATES],
        "Errors": [_panel(p.error_title, p.error, estimates) for p in ERRORS if TRUTH in drawn],
        "Filter": [_panel(title, field, estimates, topic="state") for field, title in _FILTER.items()],
    }
    tabs = {title: [panel for panel in panels if panel["tracks"]] for title, panels in tabs.items()}
    fields = {
        "tracks": drawn,
        "tabs": tabs,
        "plots": [panel for panels in tabs.values() for panel in panels if panel["field"] not in _STATES],
        "states": _STATES,
        "shown": shown,
        "on_map": {t.name for t in tracks if pose_known(t).any()},
        "fixes": fixes,
    }
    context = {"topic_of": topic_of, "TRUTH": TRUTH, "MAP_FRAME": MAP_FRAME, "LOG_TOPIC": LOG_TOPIC}
    layout, xml = (
        template(TEMPLATES / name, **context).render(fields) for name in ("foxglove.json", "plotjuggler.xml")
    )
    write_bytes(foxglove, json_bytes(json.loads(layout)))
    write_bytes(plotjuggler, xml.encode())


def _panel(
    title: str, field: str, tracks: Sequence[str], *, limits: Sequence[str] = (), topic: str = "plot"
) -> dict[str, Any]:
    """Return a plot of one field of tracks, and of the ``limits`` of its interval; ``panel``: its name in Foxglove."""
    of = {"panel": f"Plot!{field}", "title": title, "field": field}
    return of | {"tracks": tracks, "limits": limits, "topic": topic}
