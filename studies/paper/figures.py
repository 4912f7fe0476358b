"""The pictures of Figures 9 to 23 with our data, in colours that colour-blind readers can tell apart (Okabe-Ito)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.metrics import position_error
from pdhef_logtool.records.geometry import dead_reckon, wrap_angle
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack
from studies.paper.comparison import spread
from studies.paper.experiment import BURST_S, GRAVITY_M_S2, Experiment
from studies.paper.probes import RESIDUAL_ROWS, History, ResidualFit, TrustCurve
from studies.paper.step_time import StepTime

COLOURS = {
    "truth": "#8c8c8c",
    "phy-ukf": "#0072B2",
    "phy-ukf-tuned": "#56B4E9",
    "physics-plus": "#CC79A7",
    "pure-lstm": "#D55E00",
    "pd-hef-paper": "#E69F00",
    "pd-hef-fixed-r": "#000000",
    "pd-hef-trust0": "#666666",
    "pd-hef": "#009E73",
}
DASHES = {"phy-ukf": (0, (4, 1.5)), "pure-lstm": (0, (1.5, 1)), "pd-hef-paper": (0, (5, 1, 1, 1))}
OTHERS = "#999999"
#: The paper's three, drawn in this order in the time histories.
DRAWN = ("phy-ukf", "pure-lstm", "pd-hef")
#: Stands in for ``pd-hef`` where this version has none.
STAND_IN = "pd-hef-fixed-r"
BARS = ("phy-ukf", "phy-ukf-tuned", "physics-plus", "pure-lstm", "pd-hef-paper", "pd-hef-fixed-r", "pd-hef")

#: Signal, factor to the unit drawn, label.
SIGNALS = {
    "sideslip": ("sideslip_rad", math.degrees(1.0), "sideslip, deg"),
    "yaw_rate": ("yaw_rate_rad_s", 1.0, "yaw rate, rad/s"),
    "ay": ("ay_m_s2", 1.0 / GRAVITY_M_S2, "lateral acceleration, g"),
}


def drawn(ran: Sequence[str]) -> tuple[str, ...]:
    """Return the schemes of the time histories that ran."""
    return tuple(n for n in (*DRAWN[:-1], hybrid_of(ran)) if n in ran)


def hybrid_of(ran: Sequence[str]) -> str:
    """Return the name of our hybrid filter among those that ran."""
    return DRAWN[-1] if DRAWN[-1] in ran else STAND_IN


def _axes(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, Any]:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "font.size": 9,
            "axes.grid": True,
            "grid.alpha": 0.3,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "lines.linewidth": 1.3,
            "legend.fontsize": 8,
            "legend.frameon": False,
            "axes.titlesize": 9.5,
        }
    )
    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, layout="constrained", **options)


def _save(fig: Any, folder: Path, name: str) -> None:
    """Write a small PNG without a time in it, so that the same figure is the same file."""
    import matplotlib.pyplot as plt

    fig.savefig(folder / f"{name}.png", dpi=100, metadata={"Software": None})
    plt.close(fig)


def _style(name: str) -> dict[str, Any]:
    return {"color": COLOURS.get(name, OTHERS), "linestyle": DASHES.get(name, "-"), "label": name}


def _thin(name: str) -> dict[str, Any]:
    """Style of errors: noise in dashes cannot be read."""
    return {"color": COLOURS.get(name, OTHERS), "linewidth": 0.9, "label": name}


def _time_s(track: StateTrack) -> FloatArray:
    return np.asarray((track.stamps_ns - track.stamps_ns[0]) * 1e-9)


def convergence(folder: Path, histories: dict[int, History]) -> None:
    """Figure 9: loss over epochs, each training seed."""
    fig, axes = _axes(1, 1, 7.4, 3.2)
    ax = axes[0, 0]
    for number, (seed, history) in enumerate(sorted(histories.items())):
        shade = {"alpha": 1.0 if number == 0 else 0.45}
        mark = {} if len(history.epoch) > 1 else {"marker": "o"}
        ax.plot(history.epoch, history.train_loss, color="#0072B2", **shade, **mark, label=f"training, seed {seed}")
        ax.plot(
            history.epoch,
            history.validation_loss,
            color="#D55E00",
            linestyle=DASHES["phy-ukf"],
            **shade,
            **mark,
            label=f"validation, seed {seed}",
        )
    ax.set(yscale="log", xlabel="epoch", ylabel="mean square error,\nshare of the residual's mean square")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _save(fig, folder, "figure09_convergence")


def residuals(folder: Path, name: str, fit: ResidualFit, title: str) -> None:
    """Figures 10 and 19: residual and network over time, and one over the other."""
    fig, axes = _axes(2, 2, 8.6, 4.6, width_ratios=(2.6, 1.0))
    for row, (what, unit) in enumerate(RESIDUAL_ROWS):
        target, output = fit.target[:, row], fit.output[:, row]
        ax = axes[row, 0]
        ax.plot(fit.time_s, output, color="#E69F00", linewidth=2.4, label="network")
        ax.plot(fit.time_s, target, color="#0072B2", linewidth=0.8, label="residual of the nominal model")
        ax.set(ylabel=f"residual of {what}, {unit}")
        ax = axes[row, 1]
        reach = 1.05 * float(np.percentile(np.abs(np.concatenate([target, output])), 99.8))
        ax.plot([-reach, reach], [-reach, reach], color=COLOURS["truth"], linewidth=1.0)
        ax.plot(target, output, ".", markersize=2.0, color="#009E73", rasterized=True)
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel=f"residual, {unit}", ylabel="network")
    axes[0, 1].set_title(title)
    _legend_above(axes[0, 0])
    axes[1, 0].set_xlabel("time, s")
    _save(fig, folder, name)


def history(
    folder: Path, name: str, experiment: Experiment, scenario: str, signal: str, schemes: Sequence[str]
) -> None:
    """Figures 12 to 14 and 16 to 18: a state over time, and the absolute error below it."""
    attribute, factor, label = SIGNALS[signal]
    truth = experiment.drives[scenario].truth
    time_s, real = _time_s(truth), factor * getattr(truth, attribute)
    fig, axes = _axes(2, 1, 7.4, 4.4, sharex=True)
    axes[0, 0].plot(time_s, real, color=COLOURS["truth"], linewidth=3.0, label="truth")
    for scheme in schemes:
        track = experiment.tracks[scenario, scheme]
        value = np.where(track.valid, getattr(track, attribute), np.nan) * factor
        error = value - real
        if signal == "sideslip":
            error = np.degrees(wrap_angle(np.radians(error)))
        axes[0, 0].plot(time_s, value, **_style(scheme))
        axes[1, 0].plot(time_s, np.abs(error), **_thin(scheme))
    axes[0, 0].set(ylabel=label)
    axes[1, 0].set(ylabel=f"absolute error, {label.rsplit(', ', 1)[1]}", xlabel="time, s", ylim=(0.0, None))
    _legend_above(axes[0, 0])
    _save(fig, folder, name)


def _legend_above(ax: Any) -> None:
    ax.legend(ncols=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.1)


def position(folder: Path, name: str, experiment: Experiment, scenario: str, schemes: Sequence[str]) -> None:
    """Figures 11 and 15: dead-reckoned trajectory beside the true one, and the distance between them over time."""
    truth = experiment.drives[scenario].truth
    fig, axes = _axes(2, 1, 7.4, 4.6)
    axes[0, 0].plot(truth.x_m, truth.y_m, color=COLOURS["truth"], linewidth=3.0, label="truth")
    for scheme in schemes:
        track = experiment.tracks[scenario, scheme]
        known = track.valid & np.isfinite(track.vx_m_s) & np.isfinite(track.vy_m_s) & np.isfinite(truth.x_m)
        first = int(np.flatnonzero(known)[0])
        start = (float(truth.x_m[first]), float(truth.y_m[first]), float(truth.yaw_rad[first]))
        part = slice(first, None)
        x, y, _ = dead_reckon(
            track.stamps_ns[part], track.vx_m_s[part], track.vy_m_s[part], track.yaw_rate_rad_s[part], start
        )
        axes[0, 0].plot(x, y, **_style(scheme))
        axes[1, 0].plot(_time_s(truth), position_error(track, truth), **_thin(scheme))
    axes[0, 0].set(xlabel="x, m", ylabel="y, m (axes not equal)")
    axes[1, 0].set(xlabel="time, s", ylabel="distance to truth, m", ylim=(0.0, None))
    _legend_above(axes[0, 0])
    _save(fig, folder, name)


def noise_adaptation(folder: Path, experiment: Experiment, adaptive: Sequence[str], compared: Sequence[str]) -> None:
    """Figure 20: yaw rate in the burst, the factor on R, and the sideslip error."""
    drive = experiment.drives["A-burst"]
    truth, signals = drive.truth, drive.signals
    time_s = _time_s(truth)
    fig, axes = _axes(3, 1, 7.4, 5.8, sharex=True)
    axes[0, 0].plot(time_s, signals.yaw_rate_rad_s, color="#56B4E9", linewidth=0.7, label="measured")
    axes[0, 0].plot(time_s, truth.yaw_rate_rad_s, color="#000000", linewidth=1.6, label="truth")
    axes[0, 0].set(ylabel="yaw rate, rad/s")
    for scheme in adaptive:
        track = experiment.tracks["A-burst", scheme]
        axes[1, 0].plot(time_s, np.where(track.valid, track.r_scale, np.nan), **_style(scheme))
    axes[1, 0].set(yscale="log", ylabel="factor on R")
    for scheme in compared:
        track = experiment.tracks["A-burst", scheme]
        error = np.degrees(np.abs(wrap_angle(track.sideslip_rad - truth.sideslip_rad)))
        axes[2, 0].plot(time_s, np.where(track.valid, error, np.nan), **_thin(scheme))
    axes[2, 0].set(ylabel="absolute sideslip\nerror, deg", xlabel="time, s", ylim=(0.0, None))
    for ax in axes[:, 0]:
        ax.axvspan(*BURST_S, color="#F0E442", alpha=0.25, linewidth=0)
        if ax.get_legend_handles_labels()[0]:
            _legend_above(ax)
    _save(fig, folder, "figure20_noise_adaptation")


def trust(folder: Path, curves: dict[str, dict[str, TrustCurve]]) -> None:
    """Figure 21: β over |a_y|, a column each scenario, schemes one over the other; the paper's end points dashed."""
    from studies.paper.published import TRUST

    fig, axes = _axes(1, len(curves), 7.4, 3.3, sharey=True)
    for ax, (scenario, by_scheme) in zip(axes[0], curves.items(), strict=True):
        for scheme, curve in by_scheme.items():
            colour = COLOURS.get(scheme, OTHERS)
            ax.plot(curve.ay_g, curve.trust, ".", markersize=2.0, alpha=0.35, color=colour)
            ax.fill_between(curve.centre_g, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
            ax.plot(curve.centre_g, curve.median, "o-", markersize=4, color=colour, label=f"{scheme}, median of a bin")
        for level in TRUST:
            ax.axhline(level, color=COLOURS["truth"], linestyle="--", linewidth=1.0)
        ax.set(xlabel="true |lateral acceleration|, g", ylim=(0.0, 1.0), title=f"scenario {scenario}")
    axes[0, 0].set(ylabel="β")
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(0.0, 0.87))
    _save(fig, folder, "figure21_trust")


#: Figure of the tables, axis label, for the bars of Figure 22.
BAR_FIGURES = {
    "sideslip_deg": "sideslip, deg",
    "yaw_rate_rad_s": "yaw rate, rad/s",
    "ay_g": "lateral accel., g",
    "lateral_1s_m": "lateral after 1 s, m",
}


def rmse_bars(folder: Path, experiment: Experiment, ran: Sequence[str], scenarios: Sequence[str]) -> None:
    """Figure 22: median RMSE with smallest and largest over the seeds; the paper's value of its PD-HEF as a line."""
    from studies.paper.published import RMSE

    names = [n for n in BARS if n in ran][::-1]
    fig, axes = _axes(
        len(scenarios), len(BAR_FIGURES), 9.4, 0.6 + len(scenarios) * (0.7 + 0.26 * len(names)), sharey=True
    )
    for i, scenario in enumerate(scenarios):
        for j, (figure, label) in enumerate(BAR_FIGURES.items()):
            ax = axes[i, j]
            spreads = [(k, n, spread(experiment, scenario, n, figure)) for k, n in enumerate(names)]
            for k, name, s in spreads:
                if s is None:
                    continue
                ax.barh(k, s.median, color=COLOURS.get(name, OTHERS), height=0.72)
                ax.plot([s.low, s.high], [k, k], color="#222222" if name != STAND_IN else "#bbbbbb", linewidth=1.1)
            published = RMSE.get((scenario, figure))
            if published is not None:
                ax.axvline(published, color="#222222", linestyle=":", linewidth=1.4)
            ax.set_yticks(range(len(names)), names)
            ax.grid(axis="y", visible=False)
            ax.set_xlim(left=0.0)
            if i == len(scenarios) - 1:
                ax.set_xlabel(f"RMSE of {label}" if j < 3 else f"RMSE, {label}")
        axes[i, 0].set_title(f"scenario {scenario}", loc="left")
    _save(fig, folder, "figure22_rmse")


def step_time_bars(folder: Path, times: dict[str, StepTime]) -> None:
    """Figure 23: processor time a step, beside the paper's and the 10 ms cycle."""
    from studies.paper.published import CYCLE_MS, STEP_MS

    names = list(times)[::-1]
    fig, axes = _axes(1, 1, 7.0, 0.9 + 0.26 * len(names))
    ax = axes[0, 0]
    for k, name in enumerate(names):
        ax.barh(k, times[name].median_us, color=COLOURS.get(name, OTHERS), height=0.72)
    for scheme, value in STEP_MS.items():
        ax.axvline(1e3 * value, color=COLOURS[scheme], linestyle=":", linewidth=1.5, label=f"paper, {scheme}")
    ax.axvline(1e3 * CYCLE_MS, color="#222222", linestyle="--", linewidth=1.2, label=f"{CYCLE_MS:g} ms cycle")
    ax.set(xscale="log", xlabel="processor time a step, µs (log scale)")
    ax.set_yticks(range(len(names)), names)
    ax.grid(axis="y", visible=False)
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.1)
    _save(fig, folder, "figure23_step_time")
