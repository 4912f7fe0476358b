"""``docs/paper.md`` and its details, rendered from ``results.json`` and ``published.toml``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from studies.pages import table, template
from studies.paper.schemes import HYBRID, PAPER, PUBLISHED, SCHEMES
from truthsim.sensors import SensorNoise

#: Figures of the page; the folder of results contains all.
PAGE_FIGURES = (
    "figure09_convergence.png", "figure12_sideslip_a.png", "figure16_sideslip_b.png", "figure22_rmse.png",
    "figure23_step_time.png",
)  # fmt: skip
#: Rows of the sensitivity, with the symbols of the page.
CONSTANTS = {
    "start": "first point of the search",
    "forgetting": "θ (Eq 22)",
    "process_noise_gain": "γ (Eq 26)",
    "deviation_tops_m_s2": "tops of E_ay, m/s²",
    "intensity_tops": "tops of I_dyn",
    "ay_variance": "R_0 of a_y, m²/s⁴ (Eq 23)",
}
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
    """Return an improvement with its bounds, and whether it is significant."""
    text, low, high = percent(gain["value"]), gain["low"], gain["high"]
    if low is not None:
        text += f" [{percent(low)}, {percent(high)}]"
    significance = "better" if (low or 0.0) > 0.0 else "worse" if (high or 0.0) < 0.0 else "not significant"
    return f"{text} · {significance}"


def _errors(d: Document) -> str:
    """Return the table of the sideslip errors."""
    rows = []
    for scheme in SCHEMES:
        cells = [f"`{scheme}`"]
        for by_scheme in d["summary"].values():
            figures = by_scheme[scheme]
            share = f" · {percent(figures['sideslip_relative']['median'])}" if "sideslip_relative" in figures else ""
            cells.append(ranged(figures["sideslip_deg"]) + share if "sideslip_deg" in figures else "–")
        rows.append(cells)
    return table(("scheme", *(f"{s['name']}: {s['title']}" for s in d["scenarios"])), rows)


def _gains(d: Document) -> str:
    body = [[g["scenario"], f"`{g['scheme']}`", f"`{g['baseline']}`", gain_text(g)] for g in d["improvements"]]
    return table(("scenario", "scheme", "against", "lower sideslip RMSE"), body)


def _summary(d: Document) -> str:
    """Return the first paragraph: the gain of the hybrid filter, and how much of it is physics."""
    parts = []
    for scenario in "AB":
        errors = {n: d["summary"][scenario][n]["sideslip_deg"]["median"] for n in ("phy-ukf", PAPER, "physics", HYBRID)}
        phy, paper, physics, hybrid = errors.values()
        parts.append(
            f"In {scenario}, the sideslip RMSE is {number(phy)}° with `phy-ukf`, {number(paper)}° with `{PAPER}`, "
            f"{number(physics)}° with `physics` and {number(hybrid)}° with `{HYBRID}`: of the gain of `{HYBRID}` over "
            f"`phy-ukf`, {percent((phy - physics) / (phy - hybrid))} are physics."
        )
    return " ".join(parts)


def _sensitivity(constants: Document) -> str:
    """Return the errors around the chosen constants; the chosen values are bold."""

    def value(v: Any) -> str:
        return ", ".join(f"{x:g}" for x in v) if isinstance(v, list) else f"{v:g}" if v != "" else "–"

    rows = [
        [CONSTANTS[r["constant"]], f"**{value(r['value'])}**" if r["chosen"] else value(r["value"]),
         *(number(error) for error in r["errors_deg"].values())]
        for r in constants["rows"]
    ]  # fmt: skip
    return table(("constant", "value", *constants["rows"][0]["errors_deg"]), rows)


def _scenarios(d: Document) -> str:
    lines, speed_km_h, peak_g = [], PUBLISHED["dlc_speed_km_h"], PUBLISHED["dlc_peak_g"]
    for s in d["scenarios"]:
        drives = [f for f in d["drives"] if f["scenario"] == s["name"]]
        peak, slip = (max(f[key] for f in drives) for key in ("peak_ay_g", "peak_sideslip_deg"))
        fault = f", with `{', '.join(s['faults'])}`" if s["faults"] else ""
        speed = f"{s['speed_km_h']:g} km/h"
        lines.append(
            f"- **{s['name']}**: {s['title']} (`{s['manoeuvre']}`), {speed}, μ {s['friction']:g}{fault};"
            f" {drives[0]['duration_s']:g} s, |a_y| up to {number(peak)} g, sideslip up to {number(slip)}°."
        )
    lines += [
        "",
        f"The paper calls A an ISO 3888-2 course at {speed_km_h:g} km/h, which is beyond the friction.",
        f"Therefore A is the ISO 3888-1 course with its offset scaled to {peak_g:g} g.",
    ]
    return "\n".join(lines)


def _adaptation(d: Document) -> Iterator[tuple[str, ...]]:
    """Yield the same of the adaptive mechanism."""
    for scheme, r in d["r_factor"].items():
        paper = number(PUBLISHED["r_norm"][1] / PUBLISHED["r_norm"][0])
        yield "20", f"factor on R of a_y in the noise burst, `{scheme}`", paper, number(r["within"] / r["before"])
    for scenario, curves in d["trust"].items():
        for scheme, c in curves.items():
            here = f"{number(c['median'][0])} … {number(c['median'][-1])}"
            low, high = PUBLISHED["residual_gain"]
            yield "21", f"residual gain at low and high a_y in {scenario}, `{scheme}`", f"{low:g} … {high:g}", here


def _compared(d: Document) -> Iterator[tuple[str, ...]]:
    """Yield figure, quantity, value of the paper and value here."""
    for (name, values), theirs in zip(d["losses"].items(), PUBLISHED["losses"], strict=True):
        yield "9", f"{name.replace('_', ' ')} after {len(values)} epochs", f"{theirs:g}", number(values[-1])
    for paper_scheme, scheme, values in (
        ("PD-HEF", PAPER, PUBLISHED["rmse"]),
        ("PD-HEF", HYBRID, PUBLISHED["rmse"]),
        ("Phy-UKF", "phy-ukf", PUBLISHED["phy_rmse"]),
    ):
        for scenario, figure, value in ((s, f, v) for s, of in values.items() for f, v in of.items()):
            place = 11 if scenario == "A" else 15
            place += ("position_m", "sideslip_deg", "yaw_rate_rad_s", "ay_g").index(figure)
            if scheme in d["summary"][scenario]:
                here = ranged(d["summary"][scenario][scheme][figure])
                yield str(place), f"RMSE of {paper_scheme} in {scenario}, {figure}, `{scheme}`", f"{value:g}", here
    speed_m_s, duration_s = d["scenarios"][0]["speed_km_h"] / 3.6, d["drives"][0]["duration_s"]
    drift_m = 0.5 * speed_m_s * SensorNoise().yaw_rate_bias_rad_s * duration_s**2
    yield "11", "drift in A by the 1-sigma bias of the gyro alone, position_m", "–", number(drift_m)
    for scenario, figure in (("A", "10"), ("B", "19")):
        fit = d["residuals"][scenario]
        for name, share in zip(("v_y", "yaw rate"), fit["explained"], strict=True):
            yield figure, f"explained share of the residual of {name} in {scenario}", "–", percent(share)
        paper_text, here = (
            " … ".join(f"{v:.3g}".replace("-", "−") for v in limits)
            for limits in (PUBLISHED["network_output_rad_s"], fit["yaw_rate_increment_rad_s"])
        )
        yield figure, f"network output in {scenario}: yaw rate per step, rad/s", paper_text, here
    yield from _adaptation(d)
    for gain in d["improvements"]:
        if gain["baseline"] == "phy-ukf" and gain["scenario"] in "AB":
            text = f"reduction of the sideslip RMSE against Phy-UKF in {gain['scenario']}, `{gain['scheme']}`"
            yield "22", text, f"above {percent(PUBLISHED['improvement'])}", gain_text(gain)
    times = {scheme: t["median_us"] for scheme, t in d["step_time_us"].items()}
    ratio = number(PUBLISHED["step_ms"]["pd-hef"] / PUBLISHED["step_ms"]["phy-ukf"])
    for scheme in (PAPER, HYBRID):
        yield "23", f"step time over Phy-UKF, `{scheme}`", ratio, number(times[scheme] / times["phy-ukf"])


def _at_edges(constants: Document) -> int:
    """Return how many chosen constants are the first or the last value of their grid."""
    values: dict[str, list[Any]] = {}
    for row in constants["rows"][1:]:
        values.setdefault(row["constant"], []).append(row["value"])
    return sum(constants["chosen"][name] in (of[0], of[-1]) for name, of in values.items())


def write_page(d: Document, constants: Document) -> str:
    """Return the page: the gain, the scenarios, the sideslip errors, the constants, and the figures."""
    seeds = sorted({run["noise_seed"] for run in d["runs"]})
    return template(
        __file__,
        summary=_summary(d),
        run=_scenarios(d),
        seeds=f"{len(seeds)} noise seeds ({seeds[0]} to {seeds[-1]})",
        errors=_errors(d),
        gains=_gains(d),
        published=table(("figure", "quantity", "paper", "here"), _compared(d)),
        drives=constants["training_drives"],
        noise=f"{constants['noise_seeds'][0]} to {constants['noise_seeds'][-1]}",
        sensitivity=_sensitivity(constants),
        edges=_at_edges(constants),
    )
