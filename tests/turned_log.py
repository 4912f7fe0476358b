"""A log with a rotated IMU: every reading of the IMU is rotated before use."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

TRIADS = tuple(tuple(f"{part}.{axis}" for axis in "xyz") for part in ("linear_acceleration", "angular_velocity"))


class TurnedLog:
    """Wraps ``log``; ``car_from_sensor`` [3, 3] rotates the new readings of its topic into the original ones."""

    def __init__(self, log: Any, car_from_sensor: NDArray[np.float64], topic: str = "/imu/data") -> None:
        self._log, self._topic, self._turn = log, topic, car_from_sensor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def read(self, requests: dict[str, list[str]], start_ns: int, end_ns: int, **options: bool) -> dict[str, Any]:
        asked = dict(requests)
        if self._topic in asked:
            asked[self._topic] = [*dict.fromkeys([*asked[self._topic], *TRIADS[0], *TRIADS[1]])]
        found = dict(self._log.read(asked, start_ns, end_ns, **options))
        if self._topic in found:
            columns = found[self._topic]
            fields = dict(columns.fields)
            for paths in TRIADS:
                turned = np.stack([fields[p] for p in paths], axis=1) @ self._turn
                fields.update({p: turned[:, i] for i, p in enumerate(paths)})
            found[self._topic] = replace(columns, fields=fields)
        return found


def rotation(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Return the rotation [3, 3] of a sensor that is turned by yaw, then pitch, then roll (deg) into the car's axes."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians([roll, pitch, yaw])) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
