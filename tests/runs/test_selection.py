"""Default estimators and the selected estimate: by the car's evidence, else by consistency, never by ground truth."""

from collections.abc import Sequence

import numpy as np
import pytest

from pdhef_logtool import Car, RunConfig
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.signals import ALIGNED_SIGNALS
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.results.selected_estimate import MainFacts
from pdhef_logtool.runs import selection
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.referencing import audit_truth
from pdhef_logtool.runs.selection import choose_main, default_names

EVERY = frozenset(ALIGNED_SIGNALS)
#: Truth as it is, and the same shuffled: the sideslip of something else at another speed.
TRUTH = """
fill_recognised = true
[truth.vx_m_s]
topic = "/truth/perfect/odometry"
field = "twist.twist.linear.x"
[truth.vy_m_s]
topic = "/truth/perfect/odometry"
field = "twist.twist.linear.y"
"""
SHUFFLED = TRUTH.replace('linear.y"', 'angular.z"\nscale = -7.0').replace('linear.x"', 'linear.x"\nscale = 0.5')


def d2(unexplained: str = "zero", /, **values: float) -> list[MetricRow]:
    """Return figures of estimators that explain the yaw rate; one does not."""
    rows = []
    for name, value in values.items():
        estimator = name.replace("_", "-")
        rows.append(MetricRow("drive", estimator, "vy_m_s", "all", "d2", value, "m/s", 9))
        yaw = 0.1 if estimator == unexplained else 0.01
        rows.append(MetricRow("drive", estimator, "yaw_rate_rad_s", "all", "yaw_consistency", yaw, "rad/s", 9))
    return rows


def main(names: str, rows: Sequence[MetricRow] = (), *, proven: bool = False, named: bool = False) -> MainFacts:
    return choose_main(names.split(), rows, proven=proven, named=named)


def test_a_proven_car_runs_three_and_an_unproven_one_what_guards_it_as_well():
    assert default_names(Car.load("saloon"), EVERY) == ("zero", "physics", "pd-hef")
    unproven = default_names(Car(default_vehicle()), EVERY)
    assert set(unproven) == {"zero", "open-loop", "phy-ukf", "physics", "pd-hef"}
    assert "linear-regression" not in unproven


@pytest.mark.parametrize(("lacks", "instead"), [({"steer_rad"}, {"kinematic"}), ({"steer_rad", "ay_m_s2"}, set())])
@pytest.mark.parametrize("car", ["saloon", None])
def test_a_log_that_lacks_what_physics_needs_runs_what_does_with_less(lacks, instead, car):
    assert set(default_names(Car.load(car), EVERY - lacks)) == {"zero", "physics", "pd-hef", *instead}


def test_the_main_one_is_the_best_of_its_kind_whatever_the_order():
    assert main("zero kinematic physics pd-hef", proven=True).name == "pd-hef"
    assert main("zero phy-ukf open-loop").name == "phy-ukf"
    assert main("zero kinematic").name == "kinematic"
    assert main("zero pure-lstm zero:no-lateral").name == "pure-lstm"
    assert main("zero:no-lateral zero").name == "zero"


def test_evidence_goes_before_d2_and_d2_before_the_order():
    rows = d2(pd_hef=0.5, physics=0.5, open_loop=0.1, zero=0.9)
    names = "zero open-loop physics pd-hef"
    proven = main(names, rows, proven=True)
    assert (proven.name, proven.distrusted) == ("pd-hef", False) and "validated" in proven.why
    found = main(names, rows)
    assert (found.name, found.distrusted) == ("open-loop", True)
    assert "pd-hef contradicts the sensors more than open-loop" in found.why
    within = main(names, d2(pd_hef=0.11, open_loop=0.1, zero=0.9))
    assert (within.name, within.distrusted) == ("pd-hef", False) and "no simple" in within.why
    assert "the log's signals" in main(names).why


def test_what_only_the_yaw_rate_contradicts_stays_selected():
    """At the limit of the tyres the yaw rate of the right sideslip differs from the gyro's."""
    names = "zero open-loop physics pd-hef"
    assert main(names, d2("pd-hef", pd_hef=0.5, open_loop=3.0)).name == "pd-hef"
    assert main(names, d2("open-loop", pd_hef=0.5, physics=0.45, open_loop=0.1)).name == "pd-hef"


def test_what_integrates_the_residual_is_no_better_one_and_zero_counts_only_where_it_ran():
    rows = d2(pd_hef=0.11, kinematic=0.01, open_loop=0.1)
    without = main("kinematic open-loop pd-hef", rows)
    assert (without.name, without.distrusted, without.naive) == ("pd-hef", False, None)


def test_zero_sideslip_is_a_baseline_and_never_chosen_by_its_agreement():
    """At the rear axle of a car the lateral velocity is small: an accelerometer there agrees with ``zero``."""
    names = "zero open-loop physics pd-hef"
    least_bad = main(names, d2(pd_hef=0.5, physics=0.5, open_loop=0.6, zero=0.1))
    assert (least_bad.name, least_bad.distrusted) == ("pd-hef", True)
    assert least_bad.why.endswith("as well as sideslip 0 does; pd-hef is the least bad one")
    assert not main(names, d2(pd_hef=0.11, physics=0.5, open_loop=0.6, zero=0.1)).distrusted
    assert not main(names, d2(pd_hef=0.5, zero=0.1), proven=True).distrusted


def test_three_are_shown_the_answer_first_unless_they_were_named():
    names = "zero open-loop phy-ukf physics pd-hef"
    assert list(main(names).shown) == ["pd-hef", "physics", "zero"]
    assert list(main(names, named=True).shown) == names.split()
    assert list(main(names, d2(pd_hef=1.0, phy_ukf=0.1)).shown) == ["phy-ukf", "physics", "zero"]


@pytest.mark.slow
def test_the_truth_of_a_log_never_chooses(sample_logs_dir, tmp_path, monkeypatch):
    """The best estimator by consistency is always selected here, so that a choice by ground truth would show."""
    monkeypatch.setattr(selection, "FACTOR", 0.0)
    answers, best = [], set()
    for name, text in (("right", TRUTH), ("shuffled", SHUFFLED)):
        (tmp_path / f"{name}.toml").write_text(text)
        config = RunConfig(mapping=tmp_path / f"{name}.toml", keep="estimates", end="+4s")
        result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / name, config, report=False).results[0]
        answer = result.report["answer"] | {"name": result.report["selected_estimate"]}
        best.add(min(m["value"] for m in result.report["metrics"] if m["metric"] == "rmse" and m["segment"] == "all"))
        answers.append({key: answer[key] for key in ("name", "why", "shown")})
    assert len(best) == 2  # the two truths are not the same
    assert answers[0] == answers[1]
    a, b = ((tmp_path / n / "logs/dlc/metrics.parquet").read_bytes() for n in ("right", "shuffled"))
    assert a != b


@pytest.mark.parametrize("lacks", [{"ay_m_s2"}, {"yaw_rate_rad_s"}, {"ay_m_s2", "yaw_rate_rad_s"}])
def test_physics_runs_without_a_measurement(lacks):
    assert {"physics", "pd-hef"} <= set(default_names(Car.load("saloon"), EVERY - lacks))


N, RATE_HZ = 6000, 100
STAMPS = np.arange(N, dtype=np.int64) * (1_000_000_000 // RATE_HZ)
SECONDS = STAMPS * 1e-9
SIDESLIP = np.radians(2.0) * np.sin(0.5 * SECONDS)


def _track(name, sideslip, **columns):
    vx = np.full(N, 20.0)
    return make_track(name, STAMPS, vx_m_s=vx, vy_m_s=vx * np.tan(sideslip), yaw_rate_rad_s=np.zeros(N), **columns)


REFERENCE = _track("reference", SIDESLIP, sideslip_std_rad=np.full(N, np.radians(0.2)))


def test_a_sound_ground_truth_is_not_contradicted():
    assert audit_truth(_track("truth", SIDESLIP + np.radians(0.3)), REFERENCE, 3.0) == ()


@pytest.mark.parametrize(
    ("sideslip", "named"),
    [
        (SIDESLIP + np.radians(1.0), "turned by +1.00°"),
        (SIDESLIP + np.radians(2.0 * SECONDS / 60.0), "drifts by +2.00° per minute"),
        (SIDESLIP - np.radians(1.5) * ((SECONDS > 20.0) & (SECONDS < 30.0)), "mean difference -1.50°"),
        (np.where((SECONDS > 20.0) & (SECONDS < 32.0), SIDESLIP[2000], SIDESLIP), "repeats its values"),
    ],
    ids=["turned", "drifting", "wrong for a while", "held"],
)
def test_a_wrong_ground_truth_is_named(sideslip, named):
    (text,) = audit_truth(_track("truth", sideslip), REFERENCE, 3.0)
    assert named in text
    assert "estimated sideslip reference" in text


def test_where_the_reference_is_not_valid_nothing_is_stated():
    nothing = _track("reference", SIDESLIP, sideslip_std_rad=np.full(N, 0.003), valid=np.zeros(N, dtype=np.bool_))
    assert audit_truth(_track("truth", SIDESLIP + 0.1), nothing, 3.0) == ()
