"""The pictures of Figures 9 to 23 with our data, in the colours that estimators have everywhere."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.records.geometry import DEGREES, GRAVITY_M_S2, dead_reckon, wrap_angle
from pdhef_logtool.records.signals import FloatArray
from studies.paper.experiment import BURST, BURST_S, SCENARIO_PAIR, A, B, Experiment, spread, time_s, valid
from studies.paper.probes import RESIDUAL_ROWS, ResidualFit, TrustCurve
from studies.paper.results import ADAPTIVE, Results
from studies.paper.schemes import DRAWN, PAPER, PUBLISHED
from studies.pictures import STYLE, save, subplots

COLOURS = {"truth": "#8c8c8c", **{s.name: f"#{s.colour:06x}" for s in SPECS}}
DASHES = {"phy-ukf": (0, (4, 1.5)), "pure-lstm": (0, (1.5, 1)), "pd-hef-paper": (0, (5, 1, 1, 1))}
BARS = ("phy-ukf", "phy-ukf:tuned", "physics", "pure-lstm", "pd-hef-paper", "pd-hef:fixed-r", "pd-hef")

#: Signal, factor to the unit drawn, label.
SIGNALS = {
    "sideslip": ("sideslip_rad", DEGREES, "sideslip, deg"),
    "yaw_rate": ("yaw_rate_rad_s", 1.0, "yaw rate, rad/s"),
    "ay": ("ay_m_s2", 1.0 / GRAVITY_M_S2, "lateral acceleration, g"),
}


_STYLE = {**STYLE, "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 1.3,
          "legend.frameon": False, "axes.titlesize": 9.5}  # fmt: skip


def _style(name: str) -> dict[str, Any]:
    return {"color": COLOURS[name], "linestyle": DASHES.get(name, "-"), "label": name}


def _thin(name: str) -> dict[str, Any]:
    """Style of errors: noise in dashes cannot be read."""
    return {"color": COLOURS[name], "linewidth": 0.9, "label": name}


def convergence(folder: Path, losses: Mapping[str, Sequence[float]]) -> None:
    """Figure 9: losses of the paper's network over the epochs; the paper's values after 150 epochs dotted."""
    fig, axes = subplots(1, 1, 7.4, 3.0, _STYLE)
    for (name, values), colour, theirs in zip(losses.items(), ("#0072B2", "#D55E00"), PUBLISHED["losses"], strict=True):
        axes[0, 0].semilogy(range(1, len(values) + 1), values, color=colour, label=name.replace("_", " "))
        axes[0, 0].axhline(theirs, color=colour, linestyle=":", label="paper")
    axes[0, 0].set(xlabel="epoch", ylabel="mean square of\nnormalised targets")
    _legend_above(axes[0, 0])
    save(fig, folder / "figure09_convergence.png")


def step_time_bars(folder: Path, times: Mapping[str, Mapping[str, float]]) -> None:
    """Figure 23: processor time of a step; the paper's values as dots, and the controller's cycle dotted."""
    names = BARS[::-1]
    fig, axes = subplots(1, 1, 7.4, 3.0, _STYLE)
    axes[0, 0].barh(names, [times[n]["median_us"] for n in names], color=[COLOURS[n] for n in names], height=0.72)
    theirs = {"phy-ukf": PUBLISHED["step_ms"]["phy-ukf"], "pd-hef-paper": PUBLISHED["step_ms"]["pd-hef"]}
    axes[0, 0].plot([1e3 * ms for ms in theirs.values()], list(theirs), "o", color="#222222", label="paper, MATLAB")
    axes[0, 0].axvline(1e3 * PUBLISHED["cycle_ms"], color="#222222", linestyle=":", label="cycle of a controller")
    axes[0, 0].set(xscale="log", xlabel="processor time per step, µs")
    axes[0, 0].grid(axis="y", visible=False)
    _legend_above(axes[0, 0])
    save(fig, folder / "figure23_step_time.png")


def residuals(folder: Path, name: str, fit: ResidualFit, title: str) -> None:
    """Figures 10 and 19: residual and network over time, and one over the other."""
    fig, axes = subplots(2, 2, 8.6, 4.6, _STYLE, width_ratios=(2.6, 1.0))
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
    save(fig, folder / f"{name}.png")


Curve = tuple[FloatArray, FloatArray, Mapping[str, Any]]


def panels(
    path: Path, height: float, stack: Sequence[tuple[Sequence[Curve], Mapping[str, Any]]], span: Sequence[float] = (),
    **options: Any,
) -> None:  # fmt: skip
    """Draw panels one below the other: curves as x, y and style, and the settings of the axes; ``span`` is shaded."""
    fig, axes = subplots(len(stack), 1, 7.4, height, _STYLE, **options)
    for ax, (curves, settings) in zip(axes[:, 0], stack, strict=True):
        for x, y, style in curves:
            ax.plot(x, y, **style)
        ax.set(**settings)
        if span:
            ax.axvspan(*span, color="#F0E442", alpha=0.25, linewidth=0)
        if ax is axes[0, 0] or span:
            _legend_above(ax)
    save(fig, path)


def _legend_above(ax: Any) -> None:
    ax.legend(ncols=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.1)


_TRUTH = {"color": COLOURS["truth"], "linewidth": 3.0, "label": "truth"}
_ERROR = {"xlabel": "time, s", "ylim": (0.0, None)}


def history(folder: Path, name: str, experiment: Experiment, scenario: str, signal: str) -> None:
    """Figures 12 to 14 and 16 to 18: a state over time, and the absolute error below it."""
    column, factor, label = SIGNALS[signal]
    truth = experiment.truth(scenario)
    at_s, real = time_s(truth), truth[column].to_numpy()
    states: list[Curve] = [(at_s, factor * real, _TRUTH)]
    errors: list[Curve] = []
    for scheme in DRAWN:
        value = valid(experiment.track(scenario, scheme), column)
        error = wrap_angle(value - real) if signal == "sideslip" else value - real
        states.append((at_s, factor * value, _style(scheme)))
        errors.append((at_s, factor * np.abs(error), _thin(scheme)))
    below = {"ylabel": f"absolute error, {label.rsplit(', ', 1)[1]}", **_ERROR}
    panels(folder / f"{name}.png", 4.4, [(states, {"ylabel": label}), (errors, below)], sharex=True)


def position(folder: Path, name: str, experiment: Experiment, scenario: str) -> None:
    """Figures 11 and 15: dead-reckoned trajectory beside the true one, and the distance between them over time."""
    truth, columns = experiment.truth(scenario), ("x_m", "y_m", "yaw_rad")
    poses = truth.select(columns).to_numpy()
    paths: list[Curve] = [(poses[:, 0], poses[:, 1], _TRUTH)]
    distances: list[Curve] = []
    for scheme in DRAWN:
        track = experiment.track(scenario, scheme)
        motion = np.stack([valid(track, c) for c in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")])
        first = int(np.flatnonzero(np.isfinite(motion[0] + motion[1] + poses[:, 0]))[0])
        stamps, start = track["stamp_ns"].to_numpy()[first:], tuple(poses[first].tolist())
        vx, vy, rate = motion[:, first:]
        x, y, _ = dead_reckon(stamps, vx, vy, rate, start)
        paths.append((x, y, _style(scheme)))
        away = np.hypot(x - poses[first:, 0], y - poses[first:, 1])
        distances.append((time_s(truth)[first:], away, _thin(scheme)))
    above = {"xlabel": "x, m", "ylabel": "y, m (axes not equal)"}
    below = {"ylabel": "distance to ground truth, m", **_ERROR}
    panels(folder / f"{name}.png", 4.6, [(paths, above), (distances, below)])


#: Schemes of Figure 20.
COMPARED = ("phy-ukf", "pd-hef:fixed-r", "pd-hef-paper", "pd-hef")


def noise_adaptation(folder: Path, experiment: Experiment) -> None:
    """Figure 20: yaw rate in the burst, the factor on R, and the sideslip error."""
    truth = experiment.truth(BURST.name)
    tracks = {name: experiment.track(BURST.name, name) for name in ("zero:no-lateral", *COMPARED)}
    at_s, real = time_s(truth), truth["sideslip_rad"].to_numpy()
    measured = {"color": "#56B4E9", "linewidth": 0.7, "label": "measured"}
    rates: list[Curve] = [
        (at_s, tracks["zero:no-lateral"]["yaw_rate_rad_s"].to_numpy(), measured),
        (at_s, truth["yaw_rate_rad_s"].to_numpy(), {"color": "#000000", "linewidth": 1.6, "label": "truth"}),
    ]
    scales: list[Curve] = [(at_s, valid(tracks[n], "r_scale"), _style(n)) for n in ADAPTIVE]
    errors: list[Curve] = [
        (at_s, np.degrees(np.abs(wrap_angle(valid(tracks[n], "sideslip_rad") - real))), _thin(n)) for n in COMPARED
    ]
    stack: list[tuple[list[Curve], dict[str, Any]]] = [
        (rates, {"ylabel": "yaw rate, rad/s"}),
        (scales, {"yscale": "log", "ylabel": "factor on R"}),
        (errors, {"ylabel": "absolute sideslip\nerror, deg", **_ERROR}),
    ]
    panels(folder / "figure20_noise_adaptation.png", 5.8, stack, BURST_S, sharex=True)


def trust(folder: Path, curves: Mapping[str, TrustCurve]) -> None:
    """Figure 21: β of the paper's filter over |a_y|, a column each scenario; the paper's end points dashed."""
    fig, axes = subplots(1, len(curves), 7.4, 3.3, _STYLE, sharey=True)
    colour = COLOURS[PAPER]
    for ax, (scenario, curve) in zip(axes[0], curves.items(), strict=True):
        ax.plot(curve.ay_g, curve.trust, ".", markersize=2.0, alpha=0.35, color=colour)
        ax.fill_between(curve.centre_g, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
        ax.plot(curve.centre_g, curve.median, "o-", markersize=4, color=colour, label=f"{PAPER}, median of a bin")
        for level in PUBLISHED["residual_gain"]:
            ax.axhline(level, color=COLOURS["truth"], linestyle="--", linewidth=1.0)
        ax.set(xlabel="true |lateral acceleration|, g", ylim=(0.0, 1.0), title=f"scenario {scenario}")
    axes[0, 0].set(ylabel="β")
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(0.0, 0.87))
    save(fig, folder / "figure21_trust.png")


#: Figure of the tables, axis label, for the bars of Figure 22.
BAR_FIGURES = {
    "sideslip_deg": "sideslip, deg",
    "yaw_rate_rad_s": "yaw rate, rad/s",
    "ay_g": "lateral accel., g",
    "lateral_1s_m": "lateral after 1 s, m",
}


def rmse_bars(folder: Path, experiment: Experiment) -> None:
    """Figure 22: median RMSE with smallest and largest over the seeds; the paper's value of its PD-HEF as a line."""
    names, rows = BARS[::-1], len(SCENARIO_PAIR)
    fig, axes = subplots(rows, len(BAR_FIGURES), 9.4, 0.6 + rows * (0.7 + 0.26 * len(names)), _STYLE, sharey=True)
    for i, scenario in enumerate(s.name for s in SCENARIO_PAIR):
        for j, (figure, label) in enumerate(BAR_FIGURES.items()):
            ax = axes[i, j]
            for k, name in enumerate(names):
                if s := spread(experiment.metrics, scenario, name, figure):
                    ax.barh(k, s["median"], color=COLOURS[name], height=0.72)
                    ax.plot([s["low"], s["high"]], [k, k], color="#222222", linewidth=1.1)
            theirs = PUBLISHED["rmse"][scenario].get(figure)
            if theirs is not None:
                ax.axvline(theirs, color="#222222", linestyle=":", linewidth=1.4)
            ax.set_yticks(range(len(names)), names)
            ax.grid(axis="y", visible=False)
            ax.set_xlim(left=0.0)
            if i == rows - 1:
                ax.set_xlabel(f"RMSE of {label}" if j < 3 else f"RMSE, {label}")
        axes[i, 0].set_title(f"scenario {scenario}", loc="left")
    save(fig, folder / "figure22_rmse.png")


def draw(r: Results, folder: Path) -> None:
    """Write the PNGs of Figures 9 to 23 into a folder, under the names that the page uses."""
    residuals(folder, "figure10_residual_fit", r.fits[A.name], "scenario A")
    residuals(folder, "figure19_residual_verification", r.fits[B.name], "scenario B")
    for scenario, letter, first in ((A.name, "a", 11), (B.name, "b", 15)):
        position(folder, f"figure{first}_position_{letter}", r.experiment, scenario)
        for i, signal in enumerate(SIGNALS, start=1):
            history(folder, f"figure{first + i}_{signal}_{letter}", r.experiment, scenario, signal)
    noise_adaptation(folder, r.experiment)
    trust(folder, r.curves)
    rmse_bars(folder, r.experiment)
    convergence(folder, r.losses)
    step_time_bars(folder, r.times)
