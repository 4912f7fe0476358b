"""``yaw_rate_rad_s.gain``: what the gyro reads of the yaw rate."""

from __future__ import annotations

from collections.abc import Iterator

from pdhef_logtool.drive.checks.fitting import SURE
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.checks.sensor_errors import errors_of_gyro
from pdhef_logtool.records.checks import Check

#: Production gyros are good to 1 %, cheap ones to 3 %.
GAIN_ERROR = 0.05


def _check(drive: CheckedDrive) -> Iterator[Check]:
    errors = errors_of_gyro(drive)
    if errors is None:
        return
    gain, error = errors.yaw_rate_gain / drive.vehicle.sensors.yaw_rate_gain, errors.gain_error
    evidence = f"the gyro reads {gain:.3f} +- {error:.3f} of the truth's yaw rate"
    if abs(gain - 1.0) > GAIN_ERROR and abs(gain - 1.0) > SURE * error:
        yield GAIN.failed(evidence, gain=errors.yaw_rate_gain)
    elif abs(gain - 1.0) + 2.0 * error < 2.0 * GAIN_ERROR:
        yield GAIN.passed(evidence)


GAIN = CheckKind(
    "yaw_rate_rad_s.gain",
    compares="the gyro with the truth's yaw rate",
    fails="its gain is off by 5 %",
    remedy="sensors.yaw_rate_gain = {gain:.3f} in the vehicle file, or pdhef learn --stages identify",
    function=_check,
)
CHECKS = (GAIN,)
