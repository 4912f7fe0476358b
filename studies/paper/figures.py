"""Figures 9, 12, 16, 22 and 23 of the page with our data, in the colours that estimators have everywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.records.geometry import wrap_angle
from studies.paper.experiment import DRAWN, PUBLISHED, A, B, Experiment, time_s, valid
from studies.pictures import STYLE, save, subplots

COLOURS = {"truth": "#8c8c8c", **{s.name: f"#{s.colour:06x}" for s in SPECS}}
DASHES = {"phy-ukf": (0, (4, 1.5)), "pure-lstm": (0, (1.5, 1))}
BARS = ("phy-ukf", "phy-ukf:tuned", "physics", "pure-lstm", "pd-hef-paper", "pd-hef:fixed-r", "pd-hef")

_STYLE = {**STYLE, "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 1.3,
          "legend.frameon": False, "axes.titlesize": 9.5}  # fmt: skip


def convergence(path: Path, losses: Mapping[str, Sequence[float]]) -> None:
    """Figure 9: losses of the paper's network over the epochs; the paper's values after 150 epochs dotted."""
    fig, axes = subplots(1, 1, 7.4, 3.0, _STYLE)
    for (name, values), colour, theirs in zip(losses.items(), ("#0072B2", "#D55E00"), PUBLISHED["losses"], strict=True):
        axes[0, 0].semilogy(range(1, len(values) + 1), values, color=colour, label=name.replace("_", " "))
        axes[0, 0].axhline(theirs, color=colour, linestyle=":", label="paper")
    axes[0, 0].set(xlabel="epoch", ylabel="mean square of\nnormalised targets")
    _legend_above(axes[0, 0])
    save(fig, path)


def step_time_bars(path: Path, times: Mapping[str, Mapping[str, float]]) -> None:
    """Figure 23: processor time of a step; the paper's values as dots, and the controller's cycle dotted."""
    names = [n for n in BARS if n in times][::-1]
    fig, axes = subplots(1, 1, 7.4, 3.0, _STYLE)
    axes[0, 0].barh(names, [times[n]["median_us"] for n in names], color=[COLOURS[n] for n in names], height=0.72)
    theirs = {"phy-ukf": PUBLISHED["step_ms"]["phy-ukf"], "pd-hef-paper": PUBLISHED["step_ms"]["pd-hef"]}
    axes[0, 0].plot([1e3 * ms for ms in theirs.values()], list(theirs), "o", color="#222222", label="paper, MATLAB")
    axes[0, 0].axvline(1e3 * PUBLISHED["cycle_ms"], color="#222222", linestyle=":", label="cycle of a controller")
    axes[0, 0].set(xscale="log", xlabel="processor time per step, µs")
    axes[0, 0].grid(axis="y", visible=False)
    _legend_above(axes[0, 0])
    save(fig, path)


def _legend_above(ax: Any) -> None:
    ax.legend(ncols=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.1)


def sideslip(path: Path, experiment: Experiment, scenario: str) -> None:
    """Figures 12 and 16: sideslip over time, and the absolute error below it."""
    truth = experiment.truth(scenario)
    at_s, real = time_s(truth), truth["sideslip_rad"].to_numpy()
    fig, axes = subplots(2, 1, 7.4, 4.4, _STYLE, sharex=True)
    states, errors = axes[:, 0]
    states.plot(at_s, np.degrees(real), color=COLOURS["truth"], linewidth=3.0, label="truth")
    for scheme in DRAWN:
        value, colour = valid(experiment.track(scenario, scheme), "sideslip_rad"), COLOURS[scheme]
        states.plot(at_s, np.degrees(value), color=colour, linestyle=DASHES.get(scheme, "-"), label=scheme)
        # Noise in dashes cannot be read.
        errors.plot(at_s, np.degrees(np.abs(wrap_angle(value - real))), color=colour, linewidth=0.9)
    states.set(ylabel="sideslip, deg")
    errors.set(xlabel="time, s", ylabel="absolute error, deg", ylim=(0.0, None))
    _legend_above(states)
    save(fig, path)


#: Figure of the tables, axis label, for the bars of Figure 22.
BAR_FIGURES = {
    "sideslip_deg": "sideslip, deg",
    "yaw_rate_rad_s": "yaw rate, rad/s",
    "ay_g": "lateral accel., g",
    "lateral_1s_m": "lateral after 1 s, m",
}


def rmse_bars(path: Path, summary: Mapping[str, Mapping[str, Any]], scenarios: Sequence[str]) -> None:
    """Figure 22: median RMSE with smallest and largest over the seeds; the paper's value of its PD-HEF as a line."""
    names = [n for n in BARS if n in summary[scenarios[0]]][::-1]
    height = 0.6 + len(scenarios) * (0.7 + 0.26 * len(names))
    fig, axes = subplots(len(scenarios), len(BAR_FIGURES), 9.4, height, _STYLE, sharey=True)
    for row, scenario in zip(axes, scenarios, strict=True):
        for ax, (figure, label) in zip(row, BAR_FIGURES.items(), strict=True):
            for k, name in enumerate(names):
                if (s := summary[scenario][name].get(figure)) is not None:
                    ax.barh(k, s["median"], color=COLOURS[name], height=0.72)
                    ax.plot([s["low"], s["high"]], [k, k], color="#222222", linewidth=1.1)
            if (theirs := PUBLISHED["rmse"][scenario].get(figure)) is not None:
                ax.axvline(theirs, color="#222222", linestyle=":", linewidth=1.4)
            ax.set_yticks(range(len(names)), names)
            ax.grid(axis="y", visible=False)
            ax.set_xlim(left=0.0)
            ax.set_xlabel(f"RMSE, {label}" if scenario == scenarios[-1] else "")
        row[0].set_title(f"scenario {scenario}", loc="left")
    save(fig, path)


def draw(experiment: Experiment, document: Mapping[str, Any], folder: Path) -> None:
    """Write the PNGs into a folder, under the names that the page uses."""
    convergence(folder / "figure09_convergence.png", document["losses"])
    sideslip(folder / "figure12_sideslip_a.png", experiment, A.name)
    sideslip(folder / "figure16_sideslip_b.png", experiment, B.name)
    rmse_bars(folder / "figure22_rmse.png", document["summary"], (A.name, B.name))
    step_time_bars(folder / "figure23_step_time.png", document["step_time_us"])
