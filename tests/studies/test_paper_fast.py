"""The paper's experiment in small: one noise seed, the shipped network, no pictures, held against bounds.

The bounds are looser than the results of the full run (docs/paper.md); a change that loses the gain fails here.
"""

import json
import math

import polars as pl
import pytest

from pdhef_logtool.estimators.hybrid_paper import CHOSEN, Constants
from studies.gates.tool import Tool
from studies.pages import DOCS, RESULTS, ROOT
from studies.paper.constants import FILE
from studies.paper.experiment import FIRST_NOISE_SEED, A, B, improvement, run_experiment, spread
from studies.paper.page import write_page

pytestmark = pytest.mark.slow

#: Largest sideslip RMSE in degrees by scenario and scheme.
SIDESLIP_BOUNDS_DEG = {
    (scenario, scheme): bound
    for scheme, bounds in {"pd-hef:fixed-r": (0.05, 0.06), "pd-hef": (0.05, 0.06), "phy-ukf": (0.4, 0.6)}.items()
    for scenario, bound in zip("AB", bounds, strict=True)
}
#: Least relative reduction of the sideslip RMSE of the first scheme against the second, by scenario.
GAINS = {
    ("pd-hef", "phy-ukf"): 0.6, ("pd-hef", "phy-ukf:tuned"): 0.4,
    ("pd-hef-paper", "phy-ukf"): 0.2, ("pd-hef-paper, esp", "phy-ukf, esp"): 0.1,
}  # fmt: skip
LEAST_GAIN = {(scenario, *pair): gain for pair, gain in GAINS.items() for scenario in "AB"}
SCHEMES = (
    "phy-ukf", "phy-ukf:tuned", "pd-hef:fixed-r", "pd-hef-paper", "pd-hef", "phy-ukf, esp", "pd-hef-paper, esp",
)  # fmt: skip


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    tool = Tool(ROOT, tmp_path_factory.mktemp("paper"))
    return run_experiment(tool, scenarios=(A, B), noise_seeds=(FIRST_NOISE_SEED,), names=SCHEMES)


def test_sideslip_stays_below_its_bounds(shipped):
    found = {key: spread(shipped.metrics, *key, "sideslip_deg") for key in SIDESLIP_BOUNDS_DEG}
    assert None not in found.values()
    broken = {key: s["median"] for key, s in found.items() if s and s["median"] > SIDESLIP_BOUNDS_DEG[key]}
    assert not broken


@pytest.mark.parametrize("key", list(LEAST_GAIN), ids="-".join)
def test_the_hybrid_filter_keeps_its_gain(shipped, key):
    found = improvement(shipped.metrics, *key)
    assert found is not None and found["value"] > LEAST_GAIN[key]


def test_drives_are_the_papers(shipped):
    """A scenario is judged on its own truth: 0.7 g in A, at least 0.9 μ g in B."""
    a, b = ([f for f in shipped.facts if f["scenario"] == s] for s in ("A", "B"))
    assert [f["peak_ay_g"] for f in a] == [pytest.approx(0.7, abs=0.01)]
    assert all(float(str(f["peak_ay_g"])) >= 0.9 * 0.3 for f in b)


def _metrics(ours: dict[int, float], theirs: dict[int, float]) -> pl.DataFrame:
    about = {"scenario": "A", "figure": "sideslip_deg"}
    schemes = {"ours": ours, "theirs": theirs}
    return pl.DataFrame(
        [about | {"noise_seed": n, "scheme": name, "value": v} for name, of in schemes.items() for n, v in of.items()]
    )


def test_improvement_is_that_of_pooled_errors_and_pairs_the_noise_seeds():
    theirs = {1: 1.0, 2: 2.0, 3: 4.0}
    # Half the error on every drive: paired seeds remove all variation, however different the drives are.
    gain = improvement(_metrics({s: 0.5 * v for s, v in theirs.items()}, theirs), "A", "ours", "theirs")
    assert (gain["value"], gain["low"], gain["high"]) == pytest.approx((0.5, 0.5, 0.5))

    mixed = improvement(_metrics({1: 0.1, 2: 2.5, 3: 4.0}, theirs), "A", "ours", "theirs")
    expected = 1.0 - math.sqrt((0.1**2 + 2.5**2 + 4.0**2) / (1.0 + 4.0 + 16.0))
    assert mixed["value"] == pytest.approx(expected)
    assert mixed["low"] < mixed["value"] < 0.0 < mixed["high"]


def test_the_pages_are_those_of_the_stored_results():
    folder = RESULTS / "paper"
    stored, constants = (json.loads((folder / name).read_text("utf-8")) for name in ("results.json", "constants.json"))
    assert write_page(stored, constants) == (DOCS / "paper.md").read_text(encoding="utf-8")


def test_the_shipped_constants_are_those_of_the_study():
    chosen = json.loads(FILE.read_text(encoding="utf-8"))["chosen"]
    assert Constants(*(tuple(v) if isinstance(v, list) else v for v in chosen.values())) == CHOSEN
    assert tuple(chosen) == Constants._fields
