"""Stage intervals: known scales are recovered, unseen drives are covered, and a run uses what it wrote."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.car import Car, load_intervals
from pdhef_logtool.car.parts import Inflation
from pdhef_logtool.estimators.error_features import grip_share
from pdhef_logtool.estimators.intervals import SIDESLIP_TERMS, YAW_RATE_TERMS, combined, grip_factor
from pdhef_logtool.learning.drives import LearnSettings, choose_drives
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.evidence.calibrate import (
    FOLDS,
    Samples,
    bin_numbers,
    bin_weights,
    coverage_rows,
    covering_factor,
    fit_coefficients,
    fit_inflation,
    folds,
    grip_factors,
    share_for,
)
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

pytestmark = pytest.mark.slow


def _sideslip(inflation: Inflation) -> tuple[float, ...]:
    return tuple(getattr(inflation.sideslip, term) for term in SIDESLIP_TERMS)


def _yaw_rate(inflation: Inflation) -> tuple[float, ...]:
    return tuple(getattr(inflation.yaw_rate, term) for term in YAW_RATE_TERMS)


def _samples(rng: np.random.Generator, std: FloatArray, terms: FloatArray, drives: int = 30) -> Samples:
    """Samples of drives whose errors have a size of their own, [n], as those of real drives have."""
    n = std.shape[0]
    drive = np.arange(n) * drives // n
    size = np.exp(rng.normal(0.0, 0.2, drives))[drive]
    error = std * size * rng.standard_t(6.0, n)
    return Samples(
        terms=terms,
        yaw_rate_terms=terms[:, [0, 1, 6]],
        vy_per_sideslip=np.full(n, 20.0),
        sideslip_error=error,
        vy_error=20.0 * error,
        yaw_rate_error=2.0 * terms[:, 1] * rng.standard_normal(n),
        own_std=terms[:, 1],
        bin=np.asarray(rng.integers(0, 3, n)),
        drive=drive,
        wrong=drive % 3 == 0,
    )


def _terms(rng: np.random.Generator, n: int) -> FloatArray:
    terms = rng.lognormal(-6.0, 0.7, (n, len(SIDESLIP_TERMS)))
    terms[:, 0] = 1e-4
    terms[:, 3] = 3e-3 * rng.uniform(0.0, 0.9, n)
    return terms


def test_a_known_scale_is_recovered() -> None:
    rng = np.random.default_rng(1)
    n = 20_000
    terms = _terms(rng, n)
    error = 2.5 * terms[:, 1] * rng.standard_normal(n)
    k = fit_coefficients(terms, error, np.full(n, 1.0 / n))
    assert k[1] == pytest.approx(2.5, rel=0.05)
    np.testing.assert_allclose(np.median(combined(terms, k) / terms[:, 1]), 2.5, rtol=0.05)


def test_two_causes_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    n = 40_000
    terms = _terms(rng, n)
    std = np.hypot(1.5 * terms[:, 1], 0.6 * terms[:, 5])
    k = fit_coefficients(terms, std * rng.standard_normal(n), np.full(n, 1.0 / n))
    assert k[1] == pytest.approx(1.5, rel=0.1)
    assert k[5] == pytest.approx(0.6, rel=0.2)
    assert max(k[i] for i in (2, 3, 4, 6)) < 0.25


def test_what_widens_nothing_is_0_but_the_first_coefficient() -> None:
    rng = np.random.default_rng(5)
    k = fit_coefficients(rng.uniform(0.5, 1.5, (400, 3)), 1e-5 * rng.standard_normal(400), np.full(400, 1 / 400))
    assert 0.0 < k[0] < 1e-3 and k[1:] == (0.0, 0.0)


def test_new_drives_are_covered_where_errors_are_small_and_where_they_are_large() -> None:
    rng = np.random.default_rng(3)
    terms = _terms(rng, 30_000)
    std = np.hypot(1.5 * terms[:, 1], 0.6 * terms[:, 2])
    fitted = fit_inflation(_samples(rng, std, terms, drives=300))
    fresh_terms = _terms(rng, 60_000)
    fresh_std = np.hypot(1.5 * fresh_terms[:, 1], 0.6 * fresh_terms[:, 2])
    fresh = _samples(rng, fresh_std, fresh_terms, drives=200)
    interval = 1.96 * combined(fresh_terms, _sideslip(fitted.inflation))
    interval *= grip_factor(grip_share(fresh_terms), fitted.inflation.grip_factors)
    order = np.argsort(fresh_std)
    for part in np.array_split(order, 4):
        covered = np.mean(np.abs(fresh.sideslip_error[part]) <= interval[part])
        assert covered == pytest.approx(0.95, abs=0.015)
    # Before, a single drive in the least favourable part was covered far less.
    assert np.mean(np.abs(fresh.sideslip_error) <= 1.96 * fresh.own_std) < 0.8
    rate = combined(fresh.yaw_rate_terms, _yaw_rate(fitted.inflation))
    assert np.mean(np.abs(fresh.yaw_rate_error) <= 1.96 * rate) == pytest.approx(0.95, abs=0.01)
    assert fitted.inflation.vy_factor == pytest.approx(1.0, abs=1e-9)


def test_a_wrong_vehicle_widens_by_what_it_asks_for() -> None:
    """Its errors grow with the sideslip; with the file as given they do not, and the filter's 1-sigma says it all."""
    rng = np.random.default_rng(7)

    def drives(n: int, count: int) -> Samples:
        terms = _terms(rng, n)
        samples = _samples(rng, 1.5 * terms[:, 1], terms, count)
        extra = 3.0 * terms[:, 2] * rng.standard_normal(n)
        return replace(samples, sideslip_error=samples.sideslip_error + np.where(samples.wrong, extra, 0.0))

    samples = drives(60_000, 400)
    fitted = fit_inflation(samples)
    narrow = fit_inflation(samples.where(~samples.wrong))
    fresh = drives(60_000, 300)
    covered = {}
    for name, one in (("both", fitted), ("given", narrow)):
        inside = np.abs(fresh.sideslip_error) <= 1.96 * combined(fresh.terms, _sideslip(one.inflation))
        covered[name] = [np.mean(inside[fresh.wrong == wrong]) for wrong in (False, True)]
    assert covered["given"][0] == pytest.approx(0.95, abs=0.015)
    assert covered["given"][1] < 0.7
    assert np.mean(covered["both"]) == pytest.approx(0.95, abs=0.02)
    assert 0.9 < covered["both"][1] < covered["both"][0]
    k, given = np.array(_sideslip(fitted.inflation)), np.array(_sideslip(narrow.inflation))
    assert int(np.argmax(k - given)) == 2


def test_unseen_drives_decide_the_factor() -> None:
    """Terms that know each drive's own error size by chance fit it, and mean nothing on another drive."""
    rng = np.random.default_rng(4)
    drives, each = 10, 200
    drive = np.repeat(np.arange(drives), each)
    kind = drive % FOLDS  # the drives of a fold have a size and a term that no other has
    n = drives * each
    terms = np.full((n, len(SIDESLIP_TERMS)), 1e-6)
    terms[np.arange(n), 1 + kind] = 1e-3
    samples = replace(
        _samples(rng, np.full(n, 1e-3), terms, drives),
        drive=drive,
        sideslip_error=1e-3 * 2.0**kind * rng.standard_normal(n),
        bin=np.zeros(n, dtype=np.int64),
        wrong=np.zeros(n, dtype=np.bool_),
    )
    weight = np.full(n, 1.0 / n)
    seen = combined(terms, fit_coefficients(terms, samples.sideslip_error, weight))
    assert covering_factor(samples.sideslip_error, seen, weight) == pytest.approx(1.0, abs=0.02)
    assert fit_inflation(samples).unseen_factor > 3.0


def test_a_drive_that_is_lost_near_the_limit_widens_nothing_elsewhere() -> None:
    """With the drive that is lost above 0.6 of the grip, the factor there grows, and no other."""
    rng = np.random.default_rng(11)
    n, drives = 20_000, 20
    terms = _terms(rng, n)
    share = terms[:, 3] / 3e-3
    samples = replace(_samples(rng, 1.5 * terms[:, 1], terms, drives), bin=bin_numbers(share))
    lost = (samples.drive == 3) & (share > 0.6)
    worse = replace(samples, sideslip_error=np.where(lost, 0.3, samples.sideslip_error))
    weight = np.full(n, 1.0 / n)
    calm, wild = (grip_factors(s, share, 1.5 * terms[:, 1], weight) for s in (samples, worse))
    assert wild[:2] == calm[:2]
    assert wild[2] > 1.3 * calm[2]
    few = samples.where((share < 0.6) | (samples.drive < 2))
    _, middle, high = grip_factors(few, few.terms[:, 3] / 3e-3, 1.5 * few.terms[:, 1], np.ones(len(few)))
    assert high >= middle, "two drives near the limit say nothing"


def test_the_covering_factor_is_the_weighted_quantile() -> None:
    error, std = np.arange(1.0, 100.0), np.full(99, 1.0 / 1.959963984540054)
    alike = np.full(99, 1.0 / 99.0)
    assert covering_factor(error, std, alike) == pytest.approx(95.0)
    assert covering_factor(-error, 2.0 * std, alike) == pytest.approx(47.5)
    assert covering_factor(error, std, np.where(error <= 10.0, 0.1, 0.0)) == pytest.approx(10.0)


def test_the_covering_factor_is_the_least_that_covers_whatever_the_weights_add_up_to() -> None:
    rng = np.random.default_rng(8)
    error, std = 3.0 * rng.standard_normal(400), rng.uniform(0.5, 1.5, 400)
    for scale in (1.0, 7.0, 1e-3):
        weight = scale * rng.uniform(0.1, 1.0, 400)
        for covered in (0.5, 0.85):
            factor = covering_factor(error, std, weight, covered)

            def share(g: float, weight: FloatArray = weight) -> float:
                inside = np.abs(error) <= 1.959963984540054 * g * std
                return float(np.sum(weight[inside]) / np.sum(weight))

            assert share(factor * (1 - 1e-9)) < covered <= share(factor * (1 + 1e-9))


def test_the_fit_minimises_the_pinball_loss_of_the_files_head() -> None:
    rng = np.random.default_rng(9)
    terms = rng.uniform(0.5, 2.0, (500, 2))
    error = np.hypot(2.0 * terms[:, 0], 1.0) * rng.standard_normal(500)
    error[0] = 0.0
    weight = rng.uniform(0.5, 1.5, 500)
    k = np.array(fit_coefficients(terms, error, weight, 0.85))

    def loss(k: FloatArray) -> float:
        s = np.sqrt(np.square(terms) @ np.square(k))
        r = np.log(np.maximum(np.abs(error), 1e-6)) - np.log(1.959963984540054 * s)
        return float(np.sum(weight * np.where(r > 0.0, 0.85 * r, -0.15 * r)))

    assert k[0] > 0.5
    for i, factor in ((i, f) for i in range(2) for f in (0.9, 1.1)):
        aside = np.maximum(k, 0.05)
        aside[i] *= factor
        assert loss(aside) > loss(k)


def test_few_drives_must_be_covered_further() -> None:
    assert share_for(0.95, 10**6) == pytest.approx(0.95, abs=1e-5)
    assert share_for(0.95, 60) == pytest.approx(0.95 * 61 / 60)
    assert share_for(0.95, 5) == 0.975
    assert share_for(0.85, 5) == 0.925


def test_bins_count_alike() -> None:
    weight = bin_weights(np.array([0] * 900 + [2] * 100), np.zeros(1000, dtype=np.int64))
    assert weight.sum() == pytest.approx(1.0)
    assert weight[:900].sum() == pytest.approx(0.5)
    assert np.ptp(weight[900:]) == 0.0


def test_drives_of_a_bin_count_alike_but_for_those_that_hardly_see_it() -> None:
    drive = np.repeat([4, 7, 9], [600, 60, 5])
    weight = bin_weights(np.zeros(665, dtype=np.int64), drive)
    shares = [weight[drive == d].sum() for d in (4, 7, 9)]
    assert shares[0] == pytest.approx(shares[1])
    assert shares[2] == pytest.approx(shares[1] * 5 / 20)


def test_a_drive_is_never_on_both_sides() -> None:
    drive = np.random.default_rng(0).permutation(np.repeat([3, 8, 9, 20, 21, 40, 41], 5))
    held = np.zeros(drive.size, dtype=int)
    for seen, out in folds(drive):
        assert not set(drive[seen]) & set(drive[out])
        held += out
    assert np.all(held == 1)


def test_bins_and_coverage() -> None:
    assert bin_numbers(np.array([0.0, 0.29, 0.3, 0.6, 2.0, np.nan])).tolist() == [0, 0, 1, 2, 2, -1]
    rng = np.random.default_rng(5)
    n = 50_000
    samples = replace(_samples(rng, np.ones(n), np.ones((n, 9))), sideslip_error=rng.standard_normal(n))
    for row in coverage_rows(samples, np.full(n, 2.0)):
        assert row.covered_before == pytest.approx(0.95, abs=0.01)
        assert row.covered_after > 0.999
        assert (row.width_before, row.width_after) == pytest.approx((1.0, 2.0), rel=0.03)
    hand = replace(
        samples.where(np.arange(n) < 4),
        sideslip_error=np.array([1.0, -3.0, 0.1, 0.0]),
        own_std=np.array([1.0, 1.0, 2.0, 2.0]),
        bin=np.array([0, 0, 2, 1]),
        drive=np.array([3, 4, 3, 3]),
        wrong=np.array([False, False, False, True]),
    )
    low, high, middle = coverage_rows(hand, np.array([1.0, 2.0, 0.01, 1.0]))
    assert (low.bin, low.wrong_vehicle, low.drives, low.samples) == ("low", False, 2, 2)
    assert (low.covered_before, low.covered_after, low.rmse_rad) == (0.5, 1.0, pytest.approx(5.0**0.5))
    assert (low.width_before, low.width_after) == pytest.approx((5.0**-0.5, 1.5 * 5.0**-0.5))
    assert (high.bin, high.covered_before, high.covered_after) == ("high", 1.0, 0.0)
    assert (middle.bin, middle.wrong_vehicle, middle.width_before) == ("middle", True, pytest.approx(2e6))


def test_few_drives_are_refused() -> None:
    rng = np.random.default_rng(6)
    with pytest.raises(ValueError, match="5 drives"):
        fit_inflation(_samples(rng, np.ones(400), np.ones((400, 9)), drives=4))


# ---- the command ----


def _settings(sample_logs_dir: Path, estimators: tuple[str, ...] = ("phy-ukf", "zero")) -> LearnSettings:
    car = sample_logs_dir / "vehicle.toml"
    config = RunConfig(estimators=estimators, car=car, network=Path("none"), end="+6s")
    return LearnSettings(config=config, stages=("intervals",), spread=0.1)


@pytest.fixture(scope="module")
def calibration(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibration")
    logs = [str(sample_logs_dir / f"{n}.mcap") for n in ("dlc", "step", "fishhook", "sweep", "road", "no_truth")]
    told: list[str] = []
    result = learn(logs, folder / "mycar", _settings(sample_logs_dir), reporter=Reporter(warn=told.append))
    assert result.exit_code == 3
    assert [d.name for d in result.left_out] == ["no_truth"]
    assert [r.counts for r in result.drives] == [
        {"scored_stamps": r.counts["scored_stamps"], "runs": 3} for r in result.drives
    ]
    assert any("no_truth" in t for t in told)
    again = learn(logs[:5], folder / "again", _settings(sample_logs_dir))
    assert again.exit_code == 0
    assert (again.car / "intervals.json").read_bytes() == (result.car / "intervals.json").read_bytes()
    return result.car / "intervals.json"


def test_the_file_says_where_it_is_from(calibration: Path, sample_logs_dir: Path) -> None:
    assert calibration.name == "intervals.json"
    document = json.loads(calibration.read_text())
    assert [e["estimator"] for e in document["entries"]] == ["phy-ukf"]  # zero claims no interval
    assert document["entries"][0]["algorithm"]["algorithm"] == "physics-ukf"
    assert len(document["drives"]) == 5
    assert document["spread"] == document["settings"]["spread"] == 0.1
    assert document["settings"]["estimators"] == ["phy-ukf", "zero"]
    assert document["physics_sha256"] == Car.load(sample_logs_dir / "vehicle.toml").physics_sha256
    assert str(calibration.parent) not in calibration.read_text()
    assert {c["wrong_vehicle"] for c in document["entries"][0]["coverage"]} == {False, True}


def test_a_run_uses_it_and_says_so(
    calibration: Path, sample_logs_dir: Path, tmp_path: Path
) -> None:
    figures = {}
    for name, made in (("plain", Path("none")), ("whole", calibration)):
        config = RunConfig(
            estimators=("phy-ukf", "zero"),
            car=sample_logs_dir / "vehicle.toml",
            network=Path("none"),
            intervals=made,
            annotate="none",
        )
        result = run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path / name, config)
        report = result.results[0].report
        assert report is not None
        notes = {e["name"]: "; ".join(e["intervals"]) for e in report["estimators"]}
        expected = "intervals: own, parameters" if name == "plain" else "calibrated on truthsim saloon"
        assert expected in notes["phy-ukf"]
        assert "calibrated" not in notes["zero"]
        assert "other physics" not in notes["phy-ukf"]
        metrics = pl.read_parquet(tmp_path / name / "metrics.parquet").filter(pl.col("estimator") == "phy-ukf")
        figures[name] = {
            metric: metrics.filter(pl.col("metric") == metric)["value"].to_list() for metric in ("rmse", "nis", "nees")
        }
    # NEES is that of the calibrated covariance; the filter's own innovations know nothing of it.
    assert {m: figures["whole"][m] == figures["plain"][m] for m in figures["plain"]} == {
        "rmse": True,
        "nis": True,
        "nees": False,
    }
    assert all(figures["plain"].values())
    same = [c for c in tables["whole"].columns if c not in ("vy_std_m_s", "yaw_rate_std_rad_s", "sideslip_std_rad")]
    assert tables["whole"].select(same).equals(tables["plain"].select(same))
    assert not tables["whole"]["sideslip_std_rad"].equals(tables["plain"]["sideslip_std_rad"])
    (entry,) = load_intervals(calibration).entries
    assert entry.inflation.sideslip.floor > 0.0
    assert Car.load(calibration.parent).intervals == load_intervals(calibration)


def test_too_few_drives_with_truth(sample_logs_dir: Path, tmp_path: Path) -> None:
    with pytest.raises(EstimatorError, match="5 drives"):
        learn([str(sample_logs_dir / "step.mcap")], tmp_path / "c", _settings(sample_logs_dir))
    assert not (tmp_path / "c").exists()


def test_held_out_drives_are_refused(sample_logs_dir: Path, tmp_path: Path) -> None:
    entries = []
    for name, split in (("dlc", "validation"), ("step", "test")):
        shutil.copy(sample_logs_dir / f"{name}.mcap", tmp_path)
        entries.append({"file": f"{name}.mcap", "split": split})
    (tmp_path / "manifest.json").write_text(json.dumps({"drives": entries}))
    settings = _settings(sample_logs_dir)
    inputs = find_logs([str(tmp_path)])
    with pytest.raises(UsageError, match=r"step \(test\)"):
        choose_drives(inputs, settings)
    chosen, splits = choose_drives(inputs, replace(settings, split="validation"))
    assert [i.stem for i in chosen] == ["dlc"]
    assert splits == {"dlc": "validation"}
    assert len(choose_drives(inputs, replace(settings, any_split=True))[0]) == 2
    with pytest.raises(UsageError, match="train"):
        choose_drives(inputs, replace(settings, split="train"))


def test_wrong_options(sample_logs_dir: Path, tmp_path: Path) -> None:
    settings = _settings(sample_logs_dir)
    log = [str(sample_logs_dir / "step.mcap")]
    with pytest.raises(UsageError, match="--output"):
        learn(log, tmp_path / "nowhere.toml", settings)
    with pytest.raises(UsageError, match="--vary"):
        replace(settings, spread=0.5)
    (tmp_path / "notes.txt").write_text("no car")
    with pytest.raises(UsageError, match="--output"):
        learn(log, tmp_path, settings)
    with pytest.raises(UsageError, match="--car"):
        learn(log, tmp_path, replace(settings, config=replace(settings.config, car=None)))
