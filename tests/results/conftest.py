import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.records.reasons import SPIKE_AY, STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

START_NS = 1_700_000_000_000_000_123
STEP_NS = 10_000_000
RADIUS_M = 40.0
SPEED_M_S = 10.0
SIDESLIP_RAD = 0.05


def adaptive_columns(at: np.ndarray) -> dict[str, np.ndarray]:
    """Return further columns of an adaptive estimator: gyro stuck at 100 to 149, spikes of a_y at 30 and 400."""
    reason = np.where((at >= 100) & (at < 150), STUCK_YAW_RATE, 0) | np.where(np.isin(at, [30, 400]), SPIKE_AY, 0)
    return {"mixture_weight": np.where(at % 50 == 49, np.nan, 0.5 + 0.4 * np.sin(at / 50)), "reason": reason}


@pytest.fixture
def circle():
    """Return a maker of a window of a steady circle drive; rows [first, first + n) of it."""

    def make(
        name: str, first: int = 0, n: int = 200, bias: float = 0.0, covariance: bool = True, adaptive: bool = False
    ) -> StateTrack:
        at = np.arange(first, first + n)
        stamps_ns = START_NS + STEP_NS * at.astype(np.int64)
        rate = SPEED_M_S / RADIUS_M
        course = rate * at * STEP_NS * 1e-9
        beta = SIDESLIP_RAD + bias + 0.01 * np.sin(at / 30)
        cov = np.tile(np.array([[0.04, 0.001, 0.0], [0.001, 0.09, 0.002], [0.0, 0.002, 0.0004]]), (n, 1, 1))
        estimate = name != "truth"
        nis = np.where(at % 7 == 3, np.nan, 1.5 + 0.001 * at) if estimate else np.full(n, np.nan)
        pose = {"x_m": RADIUS_M * np.sin(course), "y_m": RADIUS_M * (1 - np.cos(course)), "yaw_rad": course - beta}
        of_estimates = {"sideslip_std_rad": 0.03, "network_trust": 0.25, "r_scale": 1.25}
        return make_track(
            name,
            stamps_ns,
            vx_m_s=SPEED_M_S * np.cos(beta),
            vy_m_s=SPEED_M_S * np.sin(beta),
            yaw_rate_rad_s=np.full(n, rate) + bias,
            ay_m_s2=np.full(n, SPEED_M_S * rate),
            covariance=cov if covariance and estimate else np.empty((0, 3, 3)),
            **pose,
            **{column: np.full(n, value if estimate else np.nan) for column, value in of_estimates.items()},
            nis=nis,
            nis_dof=np.where(np.isfinite(nis), 2.0, np.nan),
            friction=np.full(n, 0.85),
            valid=at % 50 != 49,
            diverged=at == 120,
            **(adaptive_columns(at) if adaptive else {}),
        )

    return make


@pytest.fixture
def circle_signals():
    """Return a maker of the inputs of the same drive."""

    def make(first: int = 0, n: int = 200) -> Signals:
        at = np.arange(first, first + n)
        stamps_ns = START_NS + STEP_NS * at.astype(np.int64)
        columns = {"steer_rad": 0.07, "ax_m_s2": 0.0, "ay_m_s2": 2.5, "yaw_rate_rad_s": 0.25}
        speed = np.where(at % 2 == 0, SPEED_M_S, np.nan)
        return signals_at(stamps_ns, stamps_ns + 2_000_000, speed_m_s=speed, **columns)

    return make
