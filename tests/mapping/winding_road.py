"""A car of 2.7 m wheelbase on a winding road, 30 s at 100 Hz: metres, seconds, radians; ground truth and sensors."""

import math

import numpy as np

N = 3000
T = 1_700_000_000_000_000_000 + np.arange(N, dtype=np.int64) * 10_000_000
S = np.arange(N) * 0.01
DEG, G = math.pi / 180.0, 9.80665
V = 15.0 + 3.0 * np.sin(0.3 * S)
RATE = 0.25 * np.sin(0.9 * S)
AX, AY, STEER = np.gradient(V, 0.01), V * RATE, 2.7 * RATE / V
YAW = np.cumsum(RATE) * 0.01
EAST, NORTH = V * np.cos(YAW), V * np.sin(YAW)
FIX = {
    "latitude": 48.0 + np.cumsum(NORTH) * 0.01 / 111_200.0,
    "longitude": 11.0 + np.cumsum(EAST) * 0.01 / (111_200.0 * math.cos(math.radians(48.0))),
}
