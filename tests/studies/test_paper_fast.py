"""The paper's experiment in small: one noise seed, the shipped network, no pictures, held against bounds.

The bounds are looser than the results of the full run (docs/paper.md); a change that loses the gain fails here.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from studies.pages import DOCS, RESULTS
from studies.paper.comparison import improvement, spread
from studies.paper.experiment import FIRST_NOISE_SEED, A, B, Experiment, Run, run_experiment
from studies.paper.page import number, percent, write_details, write_page

pytestmark = pytest.mark.slow

#: Largest sideslip RMSE in degrees by scenario and scheme.
SIDESLIP_BOUNDS_DEG: dict[tuple[str, str], float] = {
    ("A", "pd-hef:fixed-r"): 0.05,
    ("A", "pd-hef"): 0.05,
    ("B", "pd-hef:fixed-r"): 0.06,
    ("B", "pd-hef"): 0.06,
    ("A", "phy-ukf"): 0.40,
    ("B", "phy-ukf"): 0.60,
}
#: Least relative reduction of the sideslip RMSE of the first scheme against the second, by scenario.
LEAST_GAIN: dict[tuple[str, str, str], float] = {
    ("A", "pd-hef", "phy-ukf"): 0.6,
    ("B", "pd-hef", "phy-ukf"): 0.6,
    ("A", "pd-hef", "phy-ukf:tuned"): 0.4,
    ("B", "pd-hef", "phy-ukf:tuned"): 0.4,
}
SCHEMES = ("zero", "zero:no-lateral", "phy-ukf", "phy-ukf:tuned", "pd-hef:fixed-r", "pd-hef")


@pytest.fixture(scope="module")
def shipped() -> Experiment:
    cars = {0: Car.load("saloon")}
    return run_experiment(cars, scenarios=(A, B), noise_seeds=(FIRST_NOISE_SEED,), names=SCHEMES)


def test_sideslip_stays_below_its_bounds(shipped: Experiment) -> None:
    found = {key: spread(shipped, *key, "sideslip_deg") for key in SIDESLIP_BOUNDS_DEG}
    assert None not in found.values(), shipped.missing
    broken = {key: s.median for key, s in found.items() if s is not None and s.median > SIDESLIP_BOUNDS_DEG[key]}
    assert not broken


@pytest.mark.parametrize("key", list(LEAST_GAIN), ids="-".join)
def test_the_hybrid_filter_keeps_its_gain(shipped: Experiment, key: tuple[str, str, str]) -> None:
    found = improvement(shipped, *key)
    assert found is not None, shipped.missing
    assert found.value > LEAST_GAIN[key]


def test_drives_are_the_papers() -> None:
    """A scenario is judged on its own truth: 0.7 g in A, at least 0.9 μ g in B, the sensors differ by seed alone."""
    drives = run_experiment({0: Car.of(default_vehicle())}, noise_seeds=(1, 2), scenarios=(A, B), names=()).facts
    a, b = ([f for f in drives if f["scenario"] == s] for s in ("A", "B"))
    assert [f["peak_ay_g"] for f in a] == [pytest.approx(0.7, abs=0.01)] * 2
    assert all(float(str(f["peak_ay_g"])) >= 0.9 * 0.3 for f in b)
    assert a[0]["peak_sideslip_deg"] == a[1]["peak_sideslip_deg"]
    assert all(f["truth_latency_ms"] == pytest.approx(0.0, abs=3.0) for f in drives)


def _experiment(ours: dict[tuple[int, int | None], float], theirs: dict[int, float]) -> Experiment:
    runs = [Run("A", noise, "ours", seed, {"sideslip_deg": v}) for (noise, seed), v in ours.items()]
    runs += [Run("A", noise, "theirs", None, {"sideslip_deg": v}) for noise, v in theirs.items()]
    return Experiment(tuple(runs), {}, {}, {}, ())


def test_improvement_is_that_of_pooled_errors_and_pairs_the_noise_seeds() -> None:
    theirs = {1: 1.0, 2: 2.0, 3: 4.0}
    # Half the error on every drive: paired seeds remove all variation, however different the drives are.
    gain = improvement(_experiment({(s, 0): 0.5 * v for s, v in theirs.items()}, theirs), "A", "ours", "theirs")
    assert gain is not None
    assert (gain.value, gain.low, gain.high) == pytest.approx((0.5, 0.5, 0.5))
    assert gain.proven

    mixed = improvement(_experiment({(1, 0): 0.1, (2, 0): 2.5, (3, 0): 4.0}, theirs), "A", "ours", "theirs")
    assert mixed is not None
    expected = 1.0 - math.sqrt((0.1**2 + 2.5**2 + 4.0**2) / (1.0 + 4.0 + 16.0))
    assert mixed.value == pytest.approx(expected)
    assert mixed.low < mixed.value < mixed.high
    assert not mixed.proven


def test_improvement_shows_the_range_over_networks() -> None:
    theirs = {1: 1.0, 2: 1.0}
    ours = {(1, 0): 0.2, (2, 0): 0.2, (1, 1): 0.6, (2, 1): 0.6}
    gain = improvement(_experiment(ours, theirs), "A", "ours", "theirs")
    assert gain is not None
    assert gain.value == pytest.approx(1.0 - math.sqrt((0.2**2 + 0.6**2) / 2.0))
    assert (gain.seeds_low, gain.seeds_high) == pytest.approx((0.4, 0.8))


def test_one_noise_seed_proves_nothing() -> None:
    gain = improvement(_experiment({(1, 0): 0.5}, {1: 1.0}), "A", "ours", "theirs")
    assert gain is not None
    assert math.isnan(gain.low)
    assert not gain.proven


def test_the_pages_are_those_of_the_stored_results() -> None:
    folder = RESULTS / "paper"
    stored = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    assert write_page(stored) == (DOCS / "paper.md").read_text(encoding="utf-8")
    assert write_details(stored, folder) == (folder / "details.md").read_text(encoding="utf-8")


def test_numbers_have_three_digits_and_no_powers() -> None:
    rng = np.random.default_rng(0)
    for value in 10.0 ** rng.uniform(-6.0, 5.0, 200) * rng.choice([-1.0, 1.0], 200):
        text = number(float(value))
        assert "e" not in text
        assert float(text.replace("−", "-")) == pytest.approx(value, rel=0.0051)
    assert number(0.0336) == "0.0336"
    assert percent(-0.005) == "−0.5 %"
    assert number(math.nan) == "unknown"
