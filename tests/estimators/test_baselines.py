"""Frozen accuracy of the baselines and identities of the shipped presets: no flag updates the values."""

import math
from dataclasses import dataclass, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool import Car, RunConfig, read_drive
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import SPECS, all_names, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.errors import UsageError

SAMPLES = Path(__file__).parents[2] / "sample_logs"
#: Sideslip RMSE in degrees on sample logs with the shipped car: friction from the file, or from the user (sweep).
STRENGTH = {
    ("dlc", None): {"kinematic": 0.7728, "open-loop": 0.2991, "phy-ukf": 0.3721, "physics": 0.0609},
    ("road", None): {"kinematic": 1.8236, "open-loop": 0.1216, "phy-ukf": 0.1218, "physics": 0.0690},
    ("sweep", 0.3): {"kinematic": 0.5005, "open-loop": 0.4858, "phy-ukf": 0.6236, "physics": 0.0634},
}


@pytest.fixture(scope="module")
def car():
    return Car.load("saloon", network="none")


@pytest.fixture(scope="module", params=STRENGTH, ids=lambda key: key[0])
def drive(car, request):
    name, friction = request.param
    options = RunConfig().read_options
    with read_drive(SAMPLES / f"{name}.mcap", car, None, replace(options, friction=friction or options.friction)) as d:
        return d.whole(), STRENGTH[request.param]


@pytest.mark.slow
def test_no_baseline_is_weaker_than_it_was(car, drive):
    whole, strength = drive
    assert whole.truth is not None
    for name, rmse_deg in strength.items():
        track = run_estimator(make_estimator(name, car), whole.signals)
        error = signal_error(track, whole.truth, "sideslip_rad", 3.0)
        found = math.degrees(math.sqrt(float(np.nanmean(error**2))))
        assert found <= 1.005 * rmse_deg, f"{name}: {found:.4f}"


_HYBRID = "adaptive-physics 3 (physics=vehicle-ukf, residual_noise=0.5, trust=0.75)"
#: Identity and digest of the presets on the shipped car. The digest covers noise, physics and network as well.
SHIPPED = {
    "zero": ("pass-through 1 (claims_zero_sideslip=True)", "bb9a4e4a0fd4"),
    "zero:no-lateral": ("pass-through 1 (claims_zero_sideslip=False)", "103764c41c2d"),
    "kinematic": ("kinematic 1", "8208c390e51c"),
    "open-loop": ("open-loop 1", "5afc5962fabb"),
    "linear-regression": ("linear-regression 1", "9de17837d3ad"),
    "phy-ukf": ("vehicle-ukf 1 (equations=nominal)", "cead32189ec2"),
    "physics": ("adaptive-physics 3 (physics=vehicle-ukf)", "2a61d9bedc99"),
    "phy-ukf:tuned": ("vehicle-ukf 1 (equations=nominal, roll_correction=True)", "2e213229f481"),
    "pure-lstm": ("direct-network 1", "4441758f4188"),
    "pd-hef": (_HYBRID, "32c5f2999d6e"),
    "pd-hef:fixed-r": ("adaptive-physics 3 (adaptive=False, physics=vehicle-ukf, trust=1.0)", "7db611b8f5e4"),
    "pd-hef-smoothed": (
        "smoothed-physics 3 (filtered=adaptive-physics, filtered.physics=vehicle-ukf, filtered.trust=0.75, "
        "filtered.version=3)",
        "69002a15a2ab",
    ),
    "pd-hef-paper": ("paper-hybrid-ukf 2", "87a835dda35a"),
}
#: Fields that are no option: names, texts, noise, physics and network.
ROLES = {"name", "causal", "notes", "vehicle", "network", "model", "q_std", "r_std", "use_speed"}


@pytest.fixture(scope="module")
def saloon():
    return Car.load("saloon")


def test_the_identities_of_the_shipped_presets_are_frozen(saloon):
    found = {name: resolve(make_estimator(name, saloon)) for name in all_names(saloon)}
    assert {name: (a.identity, a.sha256[:12]) for name, a in found.items()} == SHIPPED


def test_a_new_option_at_its_default_changes_no_identity(saloon):
    estimator = make_estimator("pd-hef", saloon)
    assert isinstance(estimator, AdaptivePhysics)
    kind = make_dataclass("VehicleUkf", [("probe", bool, False)], bases=(VehicleUkf,), frozen=True)
    kind.options = (*VehicleUkf.options, "probe")
    values = {f.name: getattr(estimator.physics, f.name) for f in fields(VehicleUkf)}
    assert resolve(replace(estimator, physics=kind(**values))) == resolve(estimator)
    changed = resolve(replace(estimator, physics=kind(**values, probe=True)))
    assert changed.identity == _HYBRID.replace("vehicle-ukf,", "vehicle-ukf, physics.probe=True,")
    kind.version = 2
    assert "physics.version=2" in resolve(replace(estimator, physics=kind(**values))).identity


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.name)
def test_every_field_of_an_estimator_is_an_option_or_has_a_role(spec, saloon):
    if spec.missing(saloon):
        assert spec.name == "open-loop:calibrated"  # the class of open-loop
        return
    parts: list[Any] = [make_estimator(spec.name, saloon)]
    while parts:
        part = parts.pop()
        assert {f.name for f in fields(part)} <= {*getattr(part, "options", ()), *ROLES}, type(part).__name__
        parts += [p for name in getattr(part, "options", ()) if is_dataclass(p := getattr(part, name))]


def test_a_class_without_an_identity_is_refused():
    @dataclass(frozen=True)
    class Nameless:
        name: str = "nameless"
        causal: bool = True

    with pytest.raises(UsageError, match="version = 1 in class Nameless"):
        resolve(Nameless())
