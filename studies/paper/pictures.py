"""All pictures of the page from the results, under the names that the page uses."""

from __future__ import annotations

from pathlib import Path

from studies.paper import figures
from studies.paper.experiment import A, B
from studies.paper.results import Results


def draw(results: Results, folder: Path) -> None:
    """Write the PNGs of Figures 9 to 23 into a folder."""
    r = results
    schemes = figures.drawn(r.ran)
    if r.histories:
        figures.convergence(folder, dict(r.histories))
    seed = r.models[0].seed
    figures.residuals(folder, "figure10_residual_fit", r.fits[A.name][0], f"scenario A, training seed {seed}")
    figures.residuals(folder, "figure19_residual_verification", r.fits[B.name][0], f"scenario B, training seed {seed}")
    for scenario, letter, first in ((A.name, "a", 11), (B.name, "b", 15)):
        figures.position(folder, f"figure{first}_position_{letter}", r.experiment, scenario, schemes)
        for i, signal in enumerate(figures.SIGNALS, start=1):
            figures.history(folder, f"figure{first + i}_{signal}_{letter}", r.experiment, scenario, signal, schemes)
    compared = [n for n in ("phy-ukf", "pd-hef-fixed-r", "pd-hef-paper", "pd-hef") if n in r.ran]
    figures.noise_adaptation(folder, r.experiment, list(r.inflations), compared)
    if any(r.curves.values()):
        figures.trust(folder, {s: dict(c) for s, c in r.curves.items() if c})
    figures.rmse_bars(folder, r.experiment, r.ran, (A.name, B.name))
    if r.times:
        figures.step_time_bars(folder, dict(r.times))
