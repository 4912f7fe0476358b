"""The identification of a car for ``physics``, on small drives of cars in plain Python."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from physics_oracle import parts
from reference_car import FRONT_TYRE, REAR_TYRE, Drive, drive, keep, with_noise

from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.records.tracks import make_track
from studies.defaults.axle_forces import FitDrive, axle_samples
from studies.defaults.fit_physics import STARTS, build_car, drive_errors, fit_physics, make_priors

STATIC = PhysicsParts()
#: Slope of the true tyres at no slip, N/rad at friction 0.85.
STIFFNESS = tuple(0.85 * b * c * d for b, c, d, _ in (FRONT_TYRE, REAR_TYRE))


def weaving(seed: int):
    rng = np.random.default_rng(seed)
    tones = [(rng.uniform(0.1, 1.0), rng.uniform(0.0, 6.3)) for _ in range(4)]
    return lambda t: 0.017 * sum(math.sin(2.0 * math.pi * f * t + p) for f, p in tones)


def fit_drive(made: Drive, seed: int, **changes) -> FitDrive:
    """Drive as identification sees it, at 50 Hz: sensors with noise, truth without."""
    half = np.arange(len(made.signals)) % 2 == 0
    signals = keep(with_noise(made.signals, seed), half)
    columns = {"vx_m_s": made.vx, "vy_m_s": made.vy, "yaw_rate_rad_s": made.r, "ay_m_s2": made.ay}
    truth = make_track("truth", signals.stamps_ns, valid=np.ones(half.sum(), dtype=bool),
                       **{name: column[half] for name, column in columns.items()})  # fmt: skip
    return replace(FitDrive(f"made {seed}", signals, truth), **changes)


@cache
def static_drive(seed: int, seconds: float = 24.0) -> FitDrive:
    return fit_drive(drive(weaving(seed), seconds, speed=24.0, speed_every=1), seed)


def guess(front: float = 1.0, rear: float = 1.0, **changes) -> VehicleParameters:
    """The sedan without roll, its tyres known by a stiffness that is wrong by these factors."""
    tyres = [AxleTyre(cornering_stiffness_n_per_rad=k * s) for k, s in zip((front, rear), STIFFNESS, strict=True)]
    update = {"tyres": Tyres(front=tyres[0], rear=tyres[1]), "roll_gradient_rad_per_m_s2": 0.0, **changes}
    return default_vehicle().model_copy(update=update)


@pytest.fixture(scope="module")
def static() -> FitDrive:
    return static_drive(1)


# ---- the fit ----


@pytest.mark.slow
def test_stiffness_is_found_within_the_posteriors_interval(static: FitDrive) -> None:
    start = guess(0.7, 1.4)
    found = fit_physics([static], start, STATIC, starts=STARTS[:1], iterations=12)
    by_name = {p.name: (p.value(t), p.value(t - 2.5 * s), p.value(t + 2.5 * s), s)
               for p, t, s in zip(found.priors, found.theta, found.std, strict=True)}  # fmt: skip
    for axle, true, front in (("front", STIFFNESS[0], True), ("rear", STIFFNESS[1], False)):
        value, low, high, std = by_name[f"{axle} cornering stiffness"]
        assert low < true < high
        assert value == pytest.approx(true, rel=0.1)
        assert std < 0.7, "the drive must say more than the prior"
        assert found.vehicle.cornering_stiffness_n_per_rad(front, 0.85) == pytest.approx(value, rel=1e-4)
    (before,) = drive_errors([static], start, *build_car(start, STATIC, found.priors, np.zeros(len(found.priors))))
    assert found.rms_deg < 0.6 * math.degrees(before.rms)
    (after,) = drive_errors([static], start, found.vehicle, found.noise)
    assert math.degrees(after.rms) == pytest.approx(found.rms_deg, rel=1e-3)
    (unseen,) = drive_errors([static_drive(2)], start, found.vehicle, found.noise)
    assert math.degrees(unseen.rms) < 0.1
    assert 0.3 < after.nis < 3.0


# ---- priors and the car that they make ----

CORE = [f"{axle} {what}" for axle in ("front", "rear") for what in ("cornering stiffness", "peak force", "shape")]
CORE += ["yaw inertia", "roll gradient"]
CONSTANT = {"steering offset", "a_y bias", "yaw rate bias"}
OF_PARTS = {
    "lag": {"relaxation length"},
    "load_transfer": {"load sensitivity"},
    "roll": {"roll frequency", "roll damping", "CG over roll axis"},
}


@pytest.mark.parametrize("names", [(), *((name,) for name in PhysicsParts.model_fields)], ids="+".join)
def test_only_parameters_that_the_parts_use_are_fitted(names: tuple[str, ...]) -> None:
    nothing = axle_samples([static_drive(1, 2.0)], guess())
    priors = make_priors(guess(), parts(*names), nothing, 0.0)
    fitted = {p.name for p in priors if not p.tuning}
    constant = set() if "biases" in names else CONSTANT  # as states they are those of a drive
    assert fitted == {*CORE, *constant}.union(*(OF_PARTS.get(name, ()) for name in names))
