"""The straightforward pipeline that a run is held against: each step by the library that people reach for.

mcap and mcap_ros2 decode the messages one by one; at each one of the IMU, with the last ones of the others, torch steps
an LSTM of the shipped shape, filterpy updates one filter with its residual and one without, and mcap_ros2 writes both
estimates. It has no checks, no monitors and no scores.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.filtering import FRICTION, R_STD
from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters, rk4_step, substeps
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.filter_base import INITIAL_STD
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD
from pdhef_logtool.logs.schema_files import message_definition
from pdhef_logtool.results.mcap_sink import STATE_TYPE, topic_of

_IMU, _STEER, _WHEELS = "/imu/data", "/vehicle/status/steering_status", "/vehicle/wheel_speeds"


def _filter() -> Any:
    """Return filterpy's filter over v_x, v_y, yaw rate and the bias of a_x, with our compiled model."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    p = model_parameters(default_vehicle())

    def fx(x, dt, steer, ax, residual):  # type: ignore[no-untyped-def]
        n = substeps(x[0], dt, FRICTION, p)
        vx, vy, rate = rk4_step(x[0], x[1], x[2], steer, ax - x[3], FRICTION, dt, n, p)
        return np.array([vx, vy + dt * residual[0], rate + dt * residual[1], x[3]])

    def hx(x, steer):  # type: ignore[no-untyped-def]
        return np.array([measured_lateral_acceleration(x[0], x[1], x[2], steer, FRICTION, p), x[2], x[0]])

    points = MerweScaledSigmaPoints(4, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(dim_x=4, dim_z=3, dt=0.01, hx=hx, fx=fx, points=points)
    ukf.P = np.diag(np.square(INITIAL_STD))
    ukf.R = np.diag(np.square(R_STD))
    ukf.Q = np.diag(np.square(PHY_UKF_Q_STD)) * 0.01
    return ukf


def _state(stamp_ns: int, ukf: Any) -> dict[str, Any]:
    vx, vy, rate, _ = ukf.x.tolist()
    return {
        "header": {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": "base_link"},
        "vx_m_s": vx,
        "vy_m_s": vy,
        "yaw_rate_rad_s": rate,
        "sideslip_rad": float(np.arctan2(vy, vx)),
        "covariance": ukf.P[:3, :3].ravel().tolist(),
        "valid": True,
    }


def run_pipeline(log: Path, output: Path, end_ns: int) -> int:
    """Estimate the part of a simulated log before ``end_ns``; returns the number of steps."""
    import torch
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.writer import Writer

    from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork

    torch.set_num_threads(1)
    network = ResidualNetwork(Architecture()).eval()
    filters = {"pd-hef": _filter(), "physics": _filter()}
    memory = None
    steer, speed, steps = 0.0, 10.0, 0
    with log.open("rb") as file, output.open("wb") as out, torch.no_grad():
        writer = Writer(out)
        schema = writer.register_msgdef(STATE_TYPE, message_definition(STATE_TYPE))
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages([_IMU, _STEER, _WHEELS], ending_before=end_ns):
            if channel.topic == _STEER:
                steer = float(message.steering_tire_angle)
                continue
            if channel.topic == _WHEELS:
                speed = 0.5 * float(message.rl_m_s + message.rr_m_s)
                continue
            ax, ay = float(message.linear_acceleration.x), float(message.linear_acceleration.y)
            rate = float(message.angular_velocity.z)
            features = torch.tensor([[[speed, steer, ax, ay, rate, FRICTION, 0.0, 0.0]]])
            residual, memory = network(features, memory)
            # Weights that were never trained say nothing: what they cost counts, what they say does not.
            rates = 0.0 * residual[0, 0].numpy()
            for name, ukf in filters.items():
                ukf.predict(dt=0.01, steer=steer, ax=ax, residual=rates if name == "pd-hef" else (0.0, 0.0))
                ukf.update(np.array([ay, rate, speed]), steer=steer)
                writer.write_message(topic_of(name, "state"), schema, _state(raw.log_time, ukf), raw.log_time)
            steps += 1
        writer.finish()
    return steps
