"""A sensor that fails for a while accuses no other signal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.mapping import MappedChannels
from tests.drive.test_checks import checked, survey, verdicts


@pytest.fixture(scope="module")
def sweep(sample_logs_dir: Path) -> MappedChannels:
    return survey(sample_logs_dir / "sweep.mcap")


def spoilt(found: MappedChannels, name: str, kind: str, share: tuple[float, float]) -> MappedChannels:
    """Return the log with a channel dead, stuck or noisy from one share of its samples to another."""
    channel = found.signals[name]
    values, n = channel.values.copy(), len(channel)
    part = slice(int(share[0] * n), int(share[1] * n))
    if kind == "dead":
        values[part] = 0.0
    elif kind == "stuck":
        values[part] = values[part.start]
    else:
        values[part] += 3.0 * np.random.default_rng(1).standard_normal(values[part].shape[0])
    return replace(found, signals={**found.signals, name: replace(channel, values=values)})


@pytest.mark.parametrize("kind", ["dead", "stuck"])
def test_a_gyro_that_is_silent_for_a_while_fails_nothing_else(sweep: MappedChannels, kind: str) -> None:
    known = verdicts(checked(sweep), "failed")
    assert known == set()
    assert verdicts(checked(spoilt(sweep, "yaw_rate_rad_s", kind, (0.4, 0.7))), "failed") == set()
    most = checked(spoilt(sweep, "yaw_rate_rad_s", kind, (0.2, 0.9)))
    assert verdicts(most, "failed") == {"yaw_rate_rad_s.gain"}


def test_a_burst_of_noise_fails_nothing(sweep: MappedChannels) -> None:
    found = spoilt(sweep, "ay_m_s2", "noise", (0.4, 0.7))
    assert verdicts(checked(found), "failed") == set()
