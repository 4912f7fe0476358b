"""Finished runs as files, made without estimating: the input of a page."""

from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.results.parquet_sink import write_estimates
from pdhef_logtool.results.run_report import write_json
from pdhef_logtool.results.sink import Event
from tests import run_report
from tests.results import made_run
from tests.run_report import figures, ran, report

START_NS = 1_700_000_000_000_000_000
#: Those of `pdhef run --estimators all` with a network that has its baselines.
NAMES = (
    "pd-hef", "physics", "zero", "zero:no-lateral", "kinematic", "open-loop", "phy-ukf", "phy-ukf:tuned",
    "linear-regression", "pure-lstm", "pd-hef:fixed-r", "pd-hef-smoothed", "pd-hef-paper", "pd-hef:gain=1",
)  # fmt: skip


def drive_tracks(
    duration_s: float = 30.0, names: tuple[str, ...] = ("pd-hef", "physics", "zero"), *, truth: bool = True,
    speed_m_s: float = 20.0, rate_hz: float = 100.0,
) -> list[StateTrack]:  # fmt: skip
    """Return a drive with a little sideslip, noise that differs by estimator, and a stop in its middle fifth."""
    n = int(duration_s * rate_hz) + 1
    stamps = START_NS + (np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
    t = np.arange(n) / rate_hz
    rng = np.random.default_rng(0)
    vx = np.full(n, speed_m_s)
    vx[int(0.4 * n) : int(0.6 * n)] = 0.3 * min(speed_m_s, 1.0)
    beta = np.radians(2.0) * np.sin(0.7 * t) * np.cos(0.03 * t)
    heading = np.cumsum(0.1 * np.sin(0.2 * t)) / rate_hz
    pose = {
        "x_m": np.cumsum(vx * np.cos(heading)) / rate_hz,
        "y_m": np.cumsum(vx * np.sin(heading)) / rate_hz,
        "yaw_rad": heading,
    }
    ay = vx * 0.1 * np.sin(0.2 * t)
    tracks = []
    if truth:
        tracks.append(
            make_track("truth", stamps, vx_m_s=vx, vy_m_s=vx * np.tan(beta), sideslip_rad=beta, ay_m_s2=ay,
                       yaw_rate_rad_s=ay / np.maximum(vx, 1.0), **pose)
        )  # fmt: skip
    for i, name in enumerate(names):
        drift = np.radians(0.1 * (i + 1)) * np.sin(0.05 * t + i)
        own = beta + drift + np.radians(0.01) * rng.normal(size=n)
        filtered = {} if name in ("zero", "zero:no-lateral") else {
            "network_trust": 0.6 + 0.2 * np.sin(0.1 * t + i) + 0.01 * rng.normal(size=n),
            "r_scale": 1.0 + np.where(rng.random(n) < 0.01, 50.0 * rng.random(n), 0.0),
            "nis": rng.chisquare(3, size=n),
            "sideslip_std_rad": np.full(n, np.radians(0.1)) * (1.5 + np.sin(0.02 * t)),
            "reason": np.where((t > 0.1 * duration_s) & (t < 0.12 * duration_s), 16, 0).astype(np.int64),
        }  # fmt: skip
        tracks.append(
            make_track(name, stamps, vx_m_s=vx, vy_m_s=vx * np.tan(own), sideslip_rad=own,
                       ay_m_s2=ay + 0.1 * rng.normal(size=n), yaw_rate_rad_s=ay / np.maximum(vx, 1.0),
                       **pose, **filtered)
        )  # fmt: skip
    return tracks


def report_of(tracks: list[StateTrack], label: str = "drive", **changes: Any) -> dict[str, Any]:
    """Return a report.json of tracks, with changed entries."""
    truth = next((t for t in tracks if t.name == "truth"), None)
    others = [t for t in tracks if t.name != "truth"]
    start_ns, end_ns = int(tracks[0].stamps_ns[0]), int(tracks[0].stamps_ns[-1]) + 1
    log = {"name": label, "file": f"{label}.mcap", "kind": "mcap", "sha256": "0" * 64, "start_ns": start_ns,
           "end_ns": end_ns, "duration_s": (end_ns - start_ns) * 1e-9}  # fmt: skip
    metrics = figures(*((t.name, "sideslip_rad", "rmse", 0.001 * (i + 1)) for i, t in enumerate(others) if truth))
    metrics += figures(
        *((t.name, "state", m, v) for t in others if t.name != "zero" for m, v in (("nis", 3.1), ("nis_dof", 3.0)))
    )
    hashes = {"sha256": "2" * 64, "physics_sha256": "3" * 64, "network_sha256": None}
    document = report(
        None,
        log=log,
        vehicle={"name": "sedan", "file": None, "proven": False, "low_speed_blend_m_s": 3.0},
        estimators=[ran(t.name, causal=t.name != "pd-hef-smoothed", algorithm=hashes) for t in others],
        truth=run_report.truth() | {"available": truth is not None},
        friction=None,
        metrics=metrics,
        segments=[Event("straight", start_ns, int(tracks[0].stamps_ns[len(tracks[0]) // 3]), "")],
        largest_errors=largest_errors(others[0], truth, others[1:], 3.0),
    )
    answer = {"why": "for a test", "texts": {"result": "a result", "assumed": ""}}
    return document | {"selected_estimate": others[0].name, "answer": answer} | changes


def write_run(
    folder: Path, tracks: list[StateTrack], label: str = "drive", outcome: str = "ok", **changes: Any
) -> Path:
    """Write a finished run of one log and return its folder."""
    place, reports = folder / "logs" / label, {}
    place.mkdir(parents=True)
    if tracks:
        reports[label] = report_of(tracks, label, **changes)
        write_estimates(place / "estimates.parquet", tracks)
        write_json(place / "report.json", reports[label])
    entries = [made_run.entry(label, sha256=None, outcome=outcome, car=None)]
    return made_run.write_run(folder, {}, entries=entries, reports=reports)
