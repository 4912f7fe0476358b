"""``docs/paper.md`` and its details, rendered from ``results.json`` and :mod:`studies.paper.published`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.pages import table
from studies.paper import published
from studies.paper.comparison import BOOTSTRAP_DRAWS, LEVEL
from studies.paper.schemes import HYBRID, SCHEMES
from studies.paper.withheld import WITHHELD
from truthsim.manoeuvres import GRAVITY_M_S2, PATH_STEP_M, iso_3888_2_line_m
from truthsim.sensors import SensorNoise

#: Column of the tables: heading, figure of the results, and the figure relative to the ground truth.
TABLE: tuple[tuple[str, str, str | None], ...] = (
    ("sideslip, deg", "sideslip_deg", "sideslip_relative"),
    ("v_y, m/s", "vy_m_s", "vy_relative"),
    ("yaw rate, rad/s", "yaw_rate_rad_s", "yaw_rate_relative"),
    ("a_y, g", "ay_g", "ay_relative"),
    ("position, m", "position_m", None),
    ("lateral 1 s, m", "lateral_1s_m", None),
    ("lag of sideslip, ms", "sideslip_lag_ms", None),
    ("lag of yaw rate, ms", "yaw_rate_lag_ms", None),
)
GAINS = {"sideslip_deg": "sideslip", "yaw_rate_rad_s": "yaw rate", "ay_g": "a_y", "lateral_1s_m": "lateral 1 s"}
#: Figures of the page; the details contain all.
PAGE_FIGURES = ("figure12_sideslip_a.png", "figure16_sideslip_b.png", "figure22_rmse.png")
Document = Mapping[str, Any]


def number(value: float | None) -> str:
    """Three significant digits with a minus sign, never in powers of ten."""
    if value is None or not math.isfinite(value):
        return "unknown"
    if value == 0.0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}".replace("-", "−")


def percent(share: float) -> str:
    """A share as a whole number of percent, one decimal below 10 %."""
    return f"{100.0 * share:.{0 if abs(share) >= 0.1 else 1}f} %".replace("-", "−")


def ranged(spread: Mapping[str, Any]) -> str:
    """Median with smallest and largest."""
    span = f" ({number(spread['low'])} … {number(spread['high'])})" if spread.get("n") != 1 else ""
    return number(spread["median"]) + span


def gain_text(gain: Mapping[str, Any]) -> str:
    """Return an improvement with its bounds, its range over networks, and whether it is significant."""
    text, low, high = percent(gain["value"]), gain["low"], gain["high"]
    if low is not None:
        text += f" [{percent(low)}, {percent(high)}]"
    if gain["seeds_high"] - gain["seeds_low"] > 1e-9:
        text += f"; by network {percent(gain['seeds_low'])} … {percent(gain['seeds_high'])}"
    significance = "better" if (low or 0.0) > 0.0 else "worse" if (high or 0.0) < 0.0 else "not significant"
    return f"{text} · {significance}"


def _schemes(d: Document) -> list[str]:
    return [scheme for scheme in SCHEMES if any(scheme in by_scheme for by_scheme in d["summary"].values())]


def _errors(d: Document, scenario: str, columns: Sequence[tuple[str, str, str | None]] = TABLE) -> list[list[str]]:
    """Return the cells of all schemes in a scenario."""
    rows = []
    for scheme in _schemes(d):
        figures, cells = d["summary"][scenario].get(scheme, {}), [f"`{scheme}`"]
        for _, figure, relative in columns:
            share = f" · {percent(figures[relative]['median'])}" if relative in figures else ""
            cells.append(ranged(figures[figure]) + share if figure in figures else "–")
        rows.append(cells)
    return rows


def _gains(d: Document, figures: Mapping[str, str]) -> str:
    by_pair: dict[tuple[str, str], dict[str, str]] = {}
    for gain in d["improvements"]:
        by_pair.setdefault((gain["scenario"], gain["baseline"]), {})[gain["figure"]] = gain_text(gain)
    body = [[s, f"`{b}`", *(texts.get(f, "–") for f in figures)] for (s, b), texts in by_pair.items()]
    return table(("scenario", "against", *figures.values()), body)


def _scenarios(d: Document) -> str:
    lines = []
    for s in d["scenarios"]:
        drives = [f for f in d["drives"] if f["scenario"] == s["name"]]
        peak, slip = (max(f[key] for f in drives) for key in ("peak_ay_g", "peak_sideslip_deg"))
        fault = f", with `{', '.join(s['faults'])}`" if s["faults"] else ""
        speed = f"{s['speed_km_h']:g} km/h"
        training = ", a cell held out of training suites" if s["held_out_of_training_suites"] else ""
        lines.append(
            f"- **{s['name']}**: {s['title']} (`{s['manoeuvre']}`), {speed}, μ {s['friction']:g}{fault};"
            f" {drives[0]['duration_s']:g} s, |a_y| up to {number(peak)} g, sideslip up to {number(slip)}°{training}."
        )
    curvature = float(np.abs(np.diff(np.array(iso_3888_2_line_m()), n=2)).max()) / PATH_STEP_M**2
    needed_g = curvature * (published.DLC_SPEED_KM_H / 3.6) ** 2 / GRAVITY_M_S2
    lines += [
        "",
        f"The paper calls A an ISO 3888-2 course at {published.DLC_SPEED_KM_H:g} km/h. At this speed, the line of",
        f"least curvature through the lanes needs {number(needed_g)} g. Therefore A is the ISO 3888-1 course with its",
        f"offset scaled to {published.DLC_PEAK_G:g} g.",
    ]
    return "\n".join(lines)


def _sensors() -> str:
    n = SensorNoise()
    return (
        f"white noise (Student-t, 4 degrees of freedom) of {n.acceleration_m_s2:g} m/s², {n.yaw_rate_rad_s:g} rad/s, "
        f"{n.steer_rad:g} rad at the wheels and {n.wheel_speed_m_s:g} m/s; biases, drawn for each drive, of 1-sigma "
        f"{n.acceleration_bias_m_s2:g} m/s², {n.yaw_rate_bias_rad_s:g} rad/s and {n.steer_bias_rad:g} rad, and "
        f"{percent(n.wheel_scale)} in the scale of wheel speeds; a slow random walk; {1e3 * n.can_delay_s:g} ms delay "
        "of all sensors."
    )


def _withheld(d: Document) -> str:
    """Return the training drives by manoeuvre, and the errors of a network without :data:`WITHHELD`."""
    if (w := d.get("withheld")) is None:
        return ""
    counts = ", ".join(f"{n} {m}" for m, n in sorted(w["drives"].items(), key=lambda item: -item[1]))
    rows = [[f"`{s}`", *(ranged(d["summary"][c][s]["sideslip_deg"]) for c in "AB")] for s in ("physics", HYBRID)]
    rows.append([f"`{HYBRID}`, network trained without them", *(ranged(w["sideslip_deg"][c]) for c in "AB")])
    return f"""### Manoeuvres in the training

The networks of this page were trained on other drives of the shipped car: {counts}. The same training without
{", ".join(f"`{m}`" for m in WITHHELD)} (gain limit {w["gain_limit"]:g} by the same procedure) results in these
sideslip errors in degrees:

{table(("scheme", "A", "B"), rows)}

"""


def _adaptation(d: Document) -> Iterator[tuple[str, ...]]:
    """Yield the same of the adaptive mechanism."""
    for scheme, r in d["r_factor"].items():
        paper = number(published.R_NORM[1] / published.R_NORM[0])
        yield "20", f"factor on R of a_y in the noise burst, `{scheme}`", paper, number(r["within"] / r["before"])
        yield "20", f"the same interval without a burst, `{scheme}`", "–", number(r["without_burst"])
    for scenario, curves in d["trust"].items():
        for scheme, c in curves.items():
            here = f"{number(c['median'][0])} … {number(c['median'][-1])}"
            low, high = published.TRUST
            yield "21", f"residual gain at low and high a_y in {scenario}, `{scheme}`", f"{low:g} … {high:g}", here


def _compared(d: Document) -> Iterator[tuple[str, ...]]:
    """Yield figure, quantity, value of the paper and value here."""
    for paper_scheme, scheme, values in (
        ("PD-HEF", HYBRID, published.RMSE),
        ("Phy-UKF", "phy-ukf", published.PHY_RMSE),
    ):
        for (scenario, figure), value in values.items():
            place = 11 if scenario == "A" else 15
            place += ("position_m", "sideslip_deg", "yaw_rate_rad_s", "ay_g").index(figure)
            if scheme in d["summary"][scenario]:
                here = ranged(d["summary"][scenario][scheme][figure])
                yield str(place), f"RMSE of {paper_scheme} in {scenario}, {figure}", f"{value:g}", here
    for scenario, figure in (("A", "10"), ("B", "19")):
        fits = d["residuals"][scenario]
        for row, name in enumerate(("v_y", "yaw rate")):
            shares = [percent(f([fit["explained"][row] for fit in fits])) for f in (min, max)]
            yield figure, f"explained share of the residual of {name} in {scenario}", "–", " … ".join(shares)
        increments = [f["yaw_rate_increment_rad_s"] for f in fits]
        low, high = min(i[0] for i in increments), max(i[1] for i in increments)
        theirs = " … ".join(f"{v:g}".replace("-", "−") for v in published.NETWORK_OUTPUT_RAD_S)
        here = f"{number(low)} … {number(high)}"
        yield figure, f"network output in {scenario}: yaw rate per step, rad/s", theirs, here
    yield from _adaptation(d)
    for gain in d["improvements"]:
        if (gain["baseline"], gain["figure"]) == ("phy-ukf", "sideslip_deg") and gain["scenario"] in "AB":
            text = f"reduction of the sideslip RMSE against Phy-UKF in {gain['scenario']}"
            yield "22", text, f"above {percent(published.IMPROVEMENT)}", gain_text(gain)
    times = {scheme: t["median_us"] for scheme, t in d["step_time_us"].items()}
    if {HYBRID, "phy-ukf"} <= times.keys():
        theirs = number(published.STEP_MS["pd-hef"] / published.STEP_MS["phy-ukf"])
        yield "23", "step time of PD-HEF over Phy-UKF", theirs, number(times[HYBRID] / times["phy-ukf"])


def _notes(d: Document) -> str:
    """Return remarks on the published values."""
    noise, speed_m_s, duration_s = SensorNoise(), d["scenarios"][0]["speed_km_h"] / 3.6, d["drives"][0]["duration_s"]
    drift_m = 0.5 * speed_m_s * noise.yaw_rate_bias_rad_s * duration_s**2
    return f"""- The published position errors are not possible by dead reckoning with this gyro: its 1-sigma bias of
  {noise.yaw_rate_bias_rad_s:g} rad/s alone results in {number(drift_m)} m after {number(duration_s)} s.
- The published yaw-rate errors in A are higher than those of the gyro itself (`zero:no-lateral`).
- An increment of 0.04 rad/s per step of 10 ms is a yaw acceleration of 4 rad/s², above that of the manoeuvre.
- The published step times are those of MATLAB; the step times here are those of compiled code over a whole log."""


def write_details(d: Document, folder: Path) -> str:
    """Return the setup, all tables, and the published values beside ours, with the pictures of a folder."""
    seeds = sorted({run["noise_seed"] for run in d["runs"]})
    latency = max(abs(f["truth_latency_ms"]) for f in d["drives"])
    networks = "; ".join(f"seed {m['training_seed']} `{m['sha256'][:12]}`" for m in d["models"])
    schemes = "\n".join(f"- `{n}`: {SCHEMES[n]}." for n in _schemes(d))
    missing = "".join(f"\n- `{name}` did not run: {reason}." for name, reason in d["missing"].items())
    head = ("scheme", *(column[0] for column in TABLE))
    errors = "\n\n".join(
        f"### {s['name']}: {s['title']}\n\n{table(head, _errors(d, s['name']))}" for s in d["scenarios"]
    )
    times = [
        [f"`{n}`", number(t["median_us"]), f"{number(t['low_us'])} … {number(t['high_us'])}"]
        for n, t in d["step_time_us"].items()
    ]
    pictures = "\n\n".join(f"![{f.stem}]({f.name})" for f in sorted(folder.glob("figure*.png")))
    return f"""# Details of the paper's experiment

Command: `make paper` (`python -m studies.paper`). `results.json` contains the numbers.

{_scenarios(d)}

Sensors: {_sensors()} {len(seeds)} noise seeds ({seeds[0]} to {seeds[-1]}), {len(d["models"])} training seeds. The
latency of the ground truth, estimated from the gyro, is at most {number(latency)} ms. All schemes get the true friction
through the vehicle file. Vehicle: {d["vehicle"]["name"]}. Networks: {networks}.

Schemes:

{schemes}{missing}

## Results

Median (smallest … largest) over noise seeds and, for schemes with a network, training seeds; after the dot, RMSE over
the RMS of the ground truth. `position`: dead reckoning over the whole drive. `lateral 1 s`: lateral error one second
after the true pose. A positive lag means that the estimate is late.

{errors}

{_withheld(d)}### `{HYBRID}` against the others

Reduction of the RMSE, pooled over the seeds; in brackets the {percent(LEVEL)} CI of a bootstrap over noise seeds, in
pairs ({BOOTSTRAP_DRAWS} draws of {len(seeds)}; with so few seeds the CI is too narrow). Each scenario is one manoeuvre
with different sensor errors. The figures do not apply to other manoeuvres.

{_gains(d, GAINS)}

## Published values

{table(("figure", "quantity", "paper", "here"), list(_compared(d)))}

{_notes(d)}

Processor time per step on scenario B:

{table(("scheme", "µs, median", "fastest … slowest round"), times)}

## Figures

{pictures}
"""


def write_page(d: Document) -> str:
    """Return the page: the scenarios, the sideslip errors, and three figures."""
    scenarios = [s["name"] for s in d["scenarios"]]
    columns = [_errors(d, name, TABLE[:1]) for name in scenarios]
    body = [[rows[0][0], *(cells[1] for cells in rows)] for rows in zip(*columns, strict=True)]
    head = ["scheme", *(f"{s['name']}: {s['title']}" for s in d["scenarios"])]
    gains = _gains(d, {"sideslip_deg": "lower sideslip RMSE"})
    return PAGE.format(run=_scenarios(d), errors=table(head, body), gains=gains)


PAGE = """# The paper's experiment

This page shows the experiment of the paper, repeated with our estimators on our simulator. Command: `make paper`.

Paper: Zhou et al., *Physics-Driven Hybrid Framework for Vehicle State Estimation Using Residual Learning and Adaptive
UKF*, Appl. Sci. 2026, 16(9), 4230. The paper uses CarSim and MATLAB, this page uses `truthsim`
([simulated car](truthsim.md)). Therefore the order of the schemes is comparable, the level of the errors is not.

{run}

Sideslip RMSE in degrees: median (smallest … largest) over noise seeds and training seeds; after the dot, relative to
the RMS of the true sideslip. All schemes get the true friction.

{errors}

![Sideslip, double lane change](paper/figure12_sideslip_a.png)

![Sideslip, sine sweep](paper/figure16_sideslip_b.png)

Reduction of the sideslip RMSE by `pd-hef`, pooled over seeds, with the 95 % CI of a bootstrap over noise seeds, and the
range over networks:

{gains}

![RMSE](paper/figure22_rmse.png)

`studies/results/paper/details.md` compares the published values with ours, and contains yaw rate, lateral
acceleration, position, lags, step times and all figures. `results.json` in the same folder contains all numbers.
"""
