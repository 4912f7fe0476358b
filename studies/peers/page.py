"""The page of the peers."""

from __future__ import annotations

from collections.abc import Sequence

from studies.pages import number, table
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

#: The presets of the tool: calibration, car and track.
OURS = {
    "phy-ukf": ("log", "file", "phy-ukf"),
    "physics": ("log", "file", "physics"),
    "pd-hef": ("log", "file", "pd-hef"),
    "pd-hef, causal": ("off", "file", "pd-hef"),
    "pd-hef, no file": ("log", "none", "pd-hef"),
}
#: Share of missing estimates from which a figure is marked.
MARKED = 0.05
PAGE = """# Peers

This page shows the sideslip error of this tool and of published estimators on every recorded drive with ground truth.
Command: `make peers`. {verdict}

All estimators get the published vehicle file of the car and the same mapped and aligned signals, without ground truth
and without tuning per drive. Errors are sideslip RMSE in degrees at the CG, on all stamps above 3 m/s (1 m/s for 1:10
cars). A missing estimate counts as 0°.

## Full-size cars

Geometric mean over cars with one vote for each; the figure of a car is the geometric mean over its drives. The two
logs of the V40 sine with dwell share the weight of one drive. `stanford_wet_1` counts as a drive of the GTI. The spread
is the geometric standard deviation over the cars. *lowest*: number of logs, of {logs}, with the lowest error of all
estimators.

{means}

{full_size}

The last column is the error of `pd-hef` over the median of the {best} best peers of the drive. The speed of the 250 LM
and the GTI comes from the ground truth, that of `lunda_v40` from a GNSS receiver. The accelerometer position in the
TT-S file was regressed on ground truth and is left out here.

## Small and off-road cars

{small_means}

{small}

## Drives with an offset in the ground truth

The heading or the mounting of the ground truth of these drives has an offset: the median of its sideslip on straights
({offsets}) is subtracted from it. The Polaris vehicle file is a guess, the RAV4 hardly slips.

{offset}

## Estimators

| estimator | method | source of method and noise |
| --- | --- | --- |
| `linear-kf` | Kalman filter on the linear single track, measures a_y and yaw rate | Leanza, Reina, Blanco-Claraco (2021) |
| `learned-single-track` | Kalman filter of stiffness factor, steering ratio, offsets and road roll; stationary single track | openpilot `paramsd` |
| `open-loop-linear` | linear single track from steering and speed | Riekert, Schunck (1940) |
| `slip-ukf` | unscented Kalman filter on kinematics, measures axle forces with the tyre curves of the file | Goblirsch, Weinmann, Betz (2024); Bechtloff (2018) |
| `open-loop-sedan` | `open-loop-linear` with the default sedan, without vehicle file | |
| `kinematic` | leaky integral of a_y − v_x r, without vehicle file | time constant chosen on simulated drives |
| `zero` | sideslip 0 | |
| `phy-ukf`, `physics`, `pd-hef` | presets of `pdhef run`; `physics` and `pd-hef` are calibrated on the same log without ground truth (not causal) | [estimators](estimators.md) |
| `pd-hef, causal` | the same with `--calibrate off` | |
| `pd-hef, no file` | the same without `--car` | |

A † marks an error where more than {marked:.0%} of the estimates are missing. The speeds and forces in the noise of
`slip-ukf` are scaled to the car. Module `studies.peers.models` contains all differences from the published versions.
"""


def page(errors: Sequence[DriveErrors]) -> str:
    """Return the page."""
    groups = {group: [e for e in errors if e.drive.group == group] for group in (FULL_SIZE, SMALL, OFFSET)}
    full_size = groups[FULL_SIZE]
    offsets = ", ".join(f"{_name(e)} {number(e.offset_deg, 2)}°" for e in groups[OFFSET])
    return PAGE.format(
        verdict=_verdict(full_size),
        logs=len(full_size),
        means=means_table(full_size),
        full_size=drives_table(full_size),
        best=BEST_PEERS,
        small_means=means_table(groups[SMALL]),
        small=drives_table(groups[SMALL]),
        offsets=offsets,
        offset=drives_table(groups[OFFSET]),
        marked=MARKED,
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
        f"Geometric mean over {len(car_means(errors, ours))} full-size cars: `{ours}` {number(means[ours], 2)}°, the best "
        f"peer, `{best}`, {number(means[best], 2)}°."
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
