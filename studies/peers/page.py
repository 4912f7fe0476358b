"""The page of the peers, of the template beside it."""

from __future__ import annotations

from collections.abc import Sequence

from studies.pages import number, table, template
from studies.peers.drives import FULL_SIZE, OFFSET, SMALL
from studies.peers.scoring import (
    BEST_PEERS,
    DriveErrors,
    best_of,
    best_peers_median,
    car_means,
    geometric,
    spread,
)

#: Model, car and preset of each run. The peers use the vehicle file as it is.
OURS = {
    "phy-ukf": ("auto", "file", "phy-ukf"),
    "physics": ("auto", "file", "physics"),
    "pd-hef": ("auto", "file", "pd-hef"),
    "pd-hef, causal": ("earlier", "file", "pd-hef"),
    "pd-hef, no file": ("auto", "none", "pd-hef"),
}
_PUBLISHED = {"open-loop-linear": "linear-kf:open-loop"} | {
    name: name for name in ("linear-kf", "learned-single-track", "slip-ukf", "washout", "kinematic", "zero")
}
ESTIMATORS = {
    **{name: ("off", "file", preset) for name, preset in _PUBLISHED.items()},
    "open-loop-sedan": ("off", "none", "linear-kf:open-loop"),
    **OURS,
}
#: Share of missing estimates from which a figure is marked.
MARKED = 0.05


def page(errors: Sequence[DriveErrors], parameters: str) -> str:
    """Return the page; ``parameters`` : table of their agreement."""
    groups = {group: [e for e in errors if e.drive.group == group] for group in (FULL_SIZE, SMALL, OFFSET)}
    full_size = groups[FULL_SIZE]
    offsets = ", ".join(f"{_name(e)} {number(e.offset_deg, 2)}°" for e in groups[OFFSET])
    return template(
        __file__,
        verdict=_verdict(full_size),
        logs=len(full_size),
        means=means_table(full_size),
        full_size=drives_table(full_size),
        best=BEST_PEERS,
        intervals=intervals_table(full_size),
        small_means=means_table(groups[SMALL]),
        small=drives_table(groups[SMALL]),
        offsets=offsets,
        offset=drives_table(groups[OFFSET]),
        marked=MARKED,
        parameters=parameters,
    )


def _name(errors: DriveErrors) -> str:
    return errors.drive.log.partition(".")[0]


def peer_names(errors: DriveErrors) -> list[str]:
    """Return the names of the peers."""
    return [name for name in errors.rmse_deg if name not in OURS]


def _verdict(errors: Sequence[DriveErrors]) -> str:
    means = {name: geometric([*car_means(errors, name).values()]) for name in errors[0].rmse_deg}
    best = min(peer_names(errors[0]), key=lambda name: means[name])
    ours = "pd-hef"
    return (
        f"Geometric mean over {len(car_means(errors, ours))} full-size cars: `{ours}` {number(means[ours], 2)}°, "
        f"lowest of the peers `{best}` {number(means[best], 2)}°."
    )


def means_table(errors: Sequence[DriveErrors]) -> str:
    """Return the means by car and over cars, a line an estimator."""
    names = [*errors[0].rmse_deg]
    lowest = [best_of(e, names) for e in errors]
    body = []
    for name in names:
        cars = car_means(errors, name)
        cells = [number(value, 2) for value in (*cars.values(), geometric([*cars.values()]), spread([*cars.values()]))]
        body.append([f"`{name}`", *cells, str(lowest.count(name))])
    head = ["estimator", *car_means(errors, names[0]), "geometric mean", "spread", "lowest"]
    return table(head, body, right_from=1)


def intervals_table(errors: Sequence[DriveErrors]) -> str:
    """Return coverage and half-width of the 95 % intervals, a line a drive."""
    names = [name for name in OURS if name in errors[0].coverage]
    body = [
        [f"`{_name(e)}`", *(f"{e.coverage[name]:.0%}, {number(e.half_width_deg[name], 2)}" for name in names)]
        for e in errors
    ]
    return table(["drive", *(f"`{name}`" for name in names)], body, right_from=1)


def drives_table(errors: Sequence[DriveErrors]) -> str:
    """Return the errors, a line a drive; the lowest one is bold."""
    names = [*errors[0].rmse_deg]
    body = []
    for e in errors:
        cells = []
        for name in names:
            text = number(e.rmse_deg[name], 2) + ("†" if e.missing[name] > MARKED else "")
            cells.append(f"**{text}**" if name == best_of(e, names) else text)
        ratio = e.rmse_deg["pd-hef"] / best_peers_median(e, peer_names(e))
        body.append([f"`{_name(e)}`", *cells, number(ratio, 2)])
    return table(["drive", *(f"`{name}`" for name in names), "ratio"], body, right_from=1)
