"""Tables of the scores of recorded drives, and of the agreement of calibrated parameters between drives of a car."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.evaluation.statistics import pooled
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.signals import BoolArray
from studies import pages
from studies.peers.drives import FULL_SIZE, OFFSET, PEER_DRIVES, SMALL, PeerDrive, vehicle_of

SEDAN, CAUSAL, NO_FILE = "open-loop-sedan", "pd-hef, causal", "pd-hef, no file"
OURS = ("phy-ukf", "physics", "pd-hef", CAUSAL, NO_FILE)
PUBLISHED = (
    "linear-kf:open-loop", "linear-kf", "learned-single-track", "slip-ukf", "washout", "kinematic", "zero", SEDAN,
)  # fmt: skip
#: Share of missing estimates from which a figure is marked; peers that the ratio of a drive counts.
MARKED, BEST_PEERS = 0.05, 3
#: Parameters of the car; biases, offsets and delays belong to a drive.
STEERING, PEAK = "steering ratio", "peak force over the file's"
OF_CAR = (
    "rear cornering stiffness", PEAK, "yaw inertia", "relaxation length", STEERING,
    "roll gain", "lever of a_y",
)  # fmt: skip


def blocks(rows: pl.DataFrame, parameters: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return the parts of the page by name."""
    groups = {name: rows.filter(group=name) for name in (FULL_SIZE, SMALL, OFFSET)}
    means = dict(car_means(groups[FULL_SIZE]).select("estimator", "mean_deg").iter_rows())
    return pages.blocks(
        __file__,
        cars=groups[FULL_SIZE]["car"].n_unique(),
        means=means,
        best=min(PUBLISHED, key=lambda name: means[name]),
        names=(*PUBLISHED, *OURS),
        ours=OURS,
        estimators={name: estimator_table(of) for name, of in groups.items()},
        logs={name: _by_log(of) for name, of in groups.items()},
        parameters=agreements(parameters),
        ratio=_ratio,
        marked=MARKED,
    )


def _by_log(rows: pl.DataFrame) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the rows of each log by estimator, in the order of the tables."""
    logs = rows["log"].unique(maintain_order=True)
    found = {log: {row["estimator"]: row for row in rows.filter(log=log).iter_rows(named=True)} for log in logs}
    return {log.partition(".")[0]: {n: of[n] for n in (*PUBLISHED, *OURS) if n in of} for log, of in found.items()}


def _ratio(of_log: Mapping[str, dict[str, Any]]) -> float:
    """Return the error of `pd-hef` over the median of the best peers."""
    peers = sorted(of_log[name]["rmse_deg"] for name in PUBLISHED if name in of_log)[:BEST_PEERS]
    return float(of_log["pd-hef"]["rmse_deg"] / np.median(peers))


def car_means(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the geometric mean and spread of the RMSE over cars by estimator.

    That of a car is over its drives; logs of the same drive share its weight.
    """
    logs = rows.with_columns(pl.col("rmse_deg").log())
    for level in (["estimator", "car", "drive"], ["estimator", "car"]):
        logs = logs.group_by(level, maintain_order=True).agg(pl.col("rmse_deg").mean())
    mean = pl.col("rmse_deg").mean().exp().alias("mean_deg")
    spread = pl.col("rmse_deg").std().fill_null(0.0).exp().alias("spread")
    return logs.group_by("estimator", maintain_order=True).agg(mean, spread)


def estimator_table(rows: pl.DataFrame) -> str:
    """Return a line for each estimator, the lowest error of `zero` first."""
    zero, means = rows.filter(estimator="zero").select("log", of_zero="rmse_deg"), car_means(rows)
    estimators = []
    for (name,), own in rows.join(zero, on="log").group_by("estimator", maintain_order=True):
        weights, values, others = (own[c].to_numpy() for c in ("scored_s", "rmse_deg", "of_zero"))
        factors = {factor: own[factor].to_list() for factor in ("car", "drive")}
        error = pooled(weights, values, None, squares=True, positive=True, factors=factors)
        ratio = float(np.sqrt(np.average(values**2, weights=weights) / np.average(others**2, weights=weights)))
        about = {"name": name, "drives": len(own), "error": error, "ratio": ratio}
        averages = ("available", "coverage95", "winkler_deg", "seconds_per_hour")
        about |= {c: float(np.average(own[c].to_numpy(), weights=weights)) for c in averages}
        estimators.append(about | means.filter(estimator=name).row(0, named=True))
    return pages.template(Path(__file__).with_name("estimators"), estimators=estimators).rstrip("\n")


def agreements(documents: Sequence[dict[str, Any]]) -> Iterator[tuple[str, BoolArray, float]]:
    """Yield how parameters of pairs of drives of one car agree: within 1.96 sd [pairs], RMS of differences over sd.

    One for each parameter and one for all. Two logs of the same drive are no pair.
    """
    fitted = {d["log"]: {p["name"]: p for p in d["parameters"]} for d in documents}
    drives = [drive for drive in PEER_DRIVES if drive.log in fitted]
    pairs = [(a, b) for a, b in combinations(drives, 2) if a.car == b.car and a.drive != b.drive]
    every = {name: np.array([_difference(name, a, b, fitted) for a, b in pairs]) for name in OF_CAR}
    for name, rows in [*every.items(), ("all", np.concatenate(list(every.values())))]:
        yield name, np.abs(rows) <= NORMAL_95, float(np.sqrt(np.mean(rows**2)))


def _difference(name: str, a: PeerDrive, b: PeerDrive, fitted: Mapping[str, Mapping[str, dict[str, Any]]]) -> float:
    """Return the difference over its 1-sigma; steering ratios are over the file's, for the channels differ."""
    of_a, of_b = fitted[a.log][name], fitted[b.log][name]
    files = [vehicle_of(drive).steering_ratio if name == STEERING else 1.0 for drive in (a, b)]
    values = [of_one["value"] / file for of_one, file in zip((of_a, of_b), files, strict=True)]
    values = [math.log(value) if of_a["log"] else value for value in values]
    return float((values[0] - values[1]) / math.hypot(of_a["sd"], of_b["sd"]))
