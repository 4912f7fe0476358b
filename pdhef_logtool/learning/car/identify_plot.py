"""The plot of an identification: axle forces against slip with the fitted curves, and what each parameter came to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.learning.car.identify import Identification
from pdhef_logtool.learning.plots import new_figure, png_bytes
from pdhef_logtool.records.signals import FloatArray

_POINTS = 6000


def plot_identification(identification: Identification) -> bytes:
    """Return the plot as PNG."""
    figure = new_figure(11.0, 7.0)
    top = figure.subplots(2, 2, height_ratios=[3, 2])
    samples = identification.samples
    for axes, name, is_front, slip, force in (
        (top[0][0], "front", True, samples.front_slip_rad, samples.front_force_n),
        (top[0][1], "rear", False, samples.rear_slip_rad, samples.rear_force_n),
    ):
        step = max(1, slip.size // _POINTS)
        axes.plot(
            np.degrees(slip[::step]), force[::step] * 1e-3, ".", ms=1.5, color="0.65", label="from ground truth, 2 Hz"
        )
        reach = 1.1 * float(np.max(np.abs(slip), initial=math.radians(2.0)))
        grid = np.linspace(-reach, reach, 200)
        modelled = _force(identification.vehicle, is_front, grid) * 1e-3
        axes.plot(np.degrees(grid), modelled, color="#0072B2", lw=2, label="identified")
        axes.set(title=f"{name} axle", xlabel="slip angle (°)", ylabel="lateral force (kN)")
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", frameon=False)
    _plot_parameters(top[1][0], identification)
    _plot_scores(top[1][1], identification)
    return png_bytes(figure)


def _force(vehicle: VehicleParameters, is_front: bool, slip_rad: FloatArray) -> FloatArray:
    b, c, d, e = vehicle.magic_formula(is_front, vehicle.assumed_friction)
    ba = b * slip_rad
    return d * np.sin(c * np.arctan(ba - e * (ba - np.arctan(ba))))


def _plot_parameters(axes: Any, identification: Identification) -> None:
    """Draw each parameter's interval in units of its prior's: 0 is the prior."""
    car = [p for p in identification.parameters if not p.tuning]
    rows = np.arange(len(car))[::-1]
    for row, p in zip(rows, car, strict=True):
        if not p.excited:
            axes.plot(0.0, row, "o", mfc="none", color="0.5")
            continue
        scale = abs(p.prior) or max(abs(p.low), abs(p.high))
        middle, low, high = ((v - p.prior) / scale * 100.0 for v in (p.value, p.low, p.high))
        axes.plot([low, high], [row, row], color="#0072B2", lw=2)
        axes.plot(middle, row, "o", color="#0072B2")
    axes.axvline(0.0, color="0.3", lw=0.8)
    axes.set_yticks(rows, [p.name if p.excited else f"{p.name} (kept)" for p in car], fontsize=8)
    axes.set(xlabel="change from the prior (%), 95 % interval", title="parameters")
    axes.grid(alpha=0.3, axis="x")


def _plot_scores(axes: Any, identification: Identification) -> None:
    names = ("β = 0", "starting file", "identified", "physics")
    width = 0.8 / len(identification.scores)
    for i, score in enumerate(identification.scores):
        values = (score.zero_deg, score.start_file_deg, score.identified_deg, score.physics_deg)
        positions = np.arange(len(names)) + (i - (len(identification.scores) - 1) / 2) * width
        bars = axes.bar(positions, values, width * 0.95, label=f"{score.part}, {score.seconds:.0f} s")
        axes.bar_label(bars, fmt="%.3f", fontsize=8)
    axes.set_xticks(range(len(names)), names)
    axes.set(ylabel="sideslip RMSE (°)", title="error of the filter")
    axes.margins(y=0.15)
    axes.legend(frameon=False)
