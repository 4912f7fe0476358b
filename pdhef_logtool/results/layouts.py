"""foxglove.json and plotjuggler.xml: what to plot of an annotated log, to be opened in Foxglove or PlotJuggler."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pdhef_logtool.evaluation.dead_reckoned import pose_known
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.mcap_sink import LOG_TOPIC, MAP_FRAME, topic_of
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import template


@dataclass(frozen=True, slots=True)
class _Plot:
    """One plot: title, topic and field of a track, fields of the limits of its interval.

    ``of_truth``: not all fields mean something for the ground truth; an error needs one.
    """

    title: str
    field: str
    topic: str = "plot"
    limits: tuple[str, ...] = ()
    of_truth: bool = True

    @property
    def panel(self) -> str:
        """The name of its panel in Foxglove."""
        return f"Plot!{self.field}"

    def tracks(self, tracks: Mapping[str, str]) -> list[str]:
        """Return the tracks that it shows; an error only where there is a ground truth."""
        if "_error_" in self.field and TRUTH not in tracks:
            return []
        return [name for name in tracks if self.of_truth or name != TRUTH]


#: By tab of PlotJuggler.
_TABS = {
    "Estimates": (
        _Plot("Sideslip [deg]", "sideslip_deg", limits=("sideslip_low_deg", "sideslip_high_deg")),
        _Plot("Yaw rate [deg/s]", "yaw_rate_deg_s", limits=("yaw_rate_low_deg_s", "yaw_rate_high_deg_s")),
        _Plot("Lateral acceleration [m/s²]", "ay_m_s2"),
        _Plot("Longitudinal velocity [m/s]", "vx_m_s"),
        _Plot("Lateral velocity [m/s]", "vy_m_s"),
    ),
    "Errors": (
        _Plot("Error of sideslip [deg]", "sideslip_error_deg", of_truth=False),
        _Plot("Error of yaw rate [deg/s]", "yaw_rate_error_deg_s", of_truth=False),
        _Plot("Error of lateral velocity [m/s]", "vy_error_m_s", of_truth=False),
    ),
    "Filter": (
        _Plot("Normalised innovation squared", "nis", "state", of_truth=False),
        _Plot("Valid", "valid", "state", of_truth=False),
        _Plot("Diverged", "diverged", "state", of_truth=False),
        _Plot("Reason (sum of bits)", "reason", "state", of_truth=False),
    ),
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
    tabs = {title: [plot for plot in plots if plot.tracks(drawn)] for title, plots in _TABS.items()}
    fields = {
        "tracks": drawn,
        "tabs": tabs,
        "plots": [plot for plots in tabs.values() for plot in plots if plot.field not in _STATES],
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
