"""250 LM: identify on 0 to 150 s, score once on 155 to 300 s, against what needs no vehicle model.

Needs the recorded drive in ``../shared``, which may not be redistributed; says so and ends with 0 where it is absent.
Linear regression gets the same corrected signals at the same stamps, delayed as the estimators are, and the same 150 s;
its seven features are δ, a_y, r, r/v_x, a_y/v_x², δ v_x and a_x, raw and through a causal 2 Hz low pass.

Run: ``python -m studies.identify_250lm``
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfilt

from pdhef_logtool.car.vehicle import load_vehicle
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.evaluation.bootstrap import block_bootstrap_interval
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive
from pdhef_logtool.learning.car.identify_command import run_identification
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.records.release import released_steps
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.run.pipeline import run_logs
from pdhef_logtool.sinks.parquet import read_track

ROOT = Path(__file__).resolve().parents[1]
LOG = ROOT.parent / "shared" / "data" / "drives" / "revs_250lm_a.mcap"
REFERENCE = ROOT / "tests" / "reference"
FIT_END_S, SCORE_START_S = 150, 155


def _features(drive: FitDrive, *, low_pass: bool) -> np.ndarray:
    s = drive.signals
    speed = np.interp(s.stamps_ns, s.stamps_ns[np.isfinite(s.speed_m_s)], s.speed_m_s[np.isfinite(s.speed_m_s)])
    columns = [
        s.steer_rad,
        s.ay_m_s2,
        s.yaw_rate_rad_s,
        s.yaw_rate_rad_s / speed,
        s.ay_m_s2 / speed**2,
        s.steer_rad * speed,
        s.ax_m_s2,
    ]
    x = np.nan_to_num(np.stack(columns, axis=1))
    if low_pass:
        x = sosfilt(butter(2, 2.0, fs=100.0, output="sos"), x, axis=0)
    x = x[np.maximum(released_steps(s.ready_ns, s.stamps_ns), 0)]
    return np.column_stack([x, np.ones(len(x))])


def main() -> None:
    """Identify, score, print the table."""
    if not LOG.is_file():
        print("needs ../shared beside the repository (a recorded drive that may not be redistributed)")
        return
    mapping_file = REFERENCE / "mappings" / "revs_250lm.toml"
    catalogue_file = REFERENCE / "vehicles" / "revs_250lm.toml"
    rows: list[tuple[str, float, float, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        identified_file = Path(folder) / "car.toml"
        run_identification(
            [str(LOG)],
            identified_file,
            RunConfig(vehicle=catalogue_file, mapping=mapping_file, end=str(FIT_END_S)),
            holdout=0.0,
        )
        for label, vehicle, names in (
            ("catalogue tyres", catalogue_file, ("zero", "kinematic", "open-loop", "phy-ukf")),
            ("identified", identified_file, ("open-loop", "phy-ukf", "phy-ukf-tuned")),
        ):
            out = Path(folder) / label
            config = RunConfig(
                vehicle=vehicle, mapping=mapping_file, start=str(SCORE_START_S), annotate="none", estimators=names
            )
            run_logs([str(LOG)], out, config)
            file = out / "logs" / LOG.stem / "estimates.parquet"
            truth = read_track(file, "truth")
            for name in names:
                error = signal_error(read_track(file, name), truth, "sideslip_rad", 3.0)
                model_free = name in ("zero", "kinematic")
                rows.append((name if model_free else f"{name}, {label}", *_rmse_deg(error, truth.stamps_ns)))
    catalogue, mapping = load_vehicle(catalogue_file), load_mapping(mapping_file)
    _, fit = load_fit_drive(LogInput(LOG, "fit"), catalogue, mapping, ReadOptions(end=str(FIT_END_S)))
    _, score = load_fit_drive(LogInput(LOG, "score"), catalogue, mapping, ReadOptions(start=str(SCORE_START_S)))
    assert fit is not None and score is not None
    for low_pass in (False, True):
        known = np.isfinite(fit.truth.sideslip_rad)
        weights, *_ = np.linalg.lstsq(
            _features(fit, low_pass=low_pass)[known], fit.truth.sideslip_rad[known], rcond=None
        )
        error = _features(score, low_pass=low_pass) @ weights - score.truth.sideslip_rad
        name = "linear regression, 7 features" + (", 2 Hz" if low_pass else "")
        rows.append((name, *_rmse_deg(error, score.truth.stamps_ns)))
    print(f"sideslip RMSE in degrees on {SCORE_START_S} to 300 s, 95 % interval by bootstrap of 10 s blocks")
    for name, rmse, low, high in rows:
        print(f"{name:36s} {rmse:6.3f}  [{low:.3f}, {high:.3f}]")


def _rmse_deg(error: np.ndarray, stamps_ns: np.ndarray) -> tuple[float, float, float]:
    known = np.isfinite(error)
    interval = block_bootstrap_interval(error[known], stamps_ns[known], block_s=10.0, n=1000, seed=0)
    rmse = float(np.sqrt(np.mean(error[known] ** 2)))
    low, high = interval if isinstance(interval, tuple) else (interval.low, interval.high)
    return math.degrees(rmse), math.degrees(low), math.degrees(high)


if __name__ == "__main__":
    main()
