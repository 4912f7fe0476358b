"""Scores, rows and pages of the studies; pages equal those of the stored results."""

import json
import math
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool import Car, inspect_log
from pdhef_logtool.records.tracks import make_track
from studies import conditions, reference
from studies.calibration import coverages
from studies.drawn_cars import fit_vehicle
from studies.gates import __main__ as gates
from studies.gates.rows import GateRow
from studies.pages import DOCS, RESULTS, ROOT, fill
from studies.peers import __main__ as study
from studies.peers.drives import FULL_SIZE, PEER_DRIVES
from studies.peers.page import estimator_table
from studies.peers.scoring import errors, scores
from studies.teaching import CARS, STORED, Pair, blocks, is_worse, ratio
from truthsim.vehicle_choice import choose_vehicle


def track(sideslip: np.ndarray, speed: float = 10.0):
    """Return ground truth with a sideslip [N] in rad."""
    stamps = np.arange(len(sideslip), dtype=np.int64) * 10_000_000
    speeds = np.full(len(sideslip), speed)
    return make_track("truth", stamps, vx_m_s=speeds * np.cos(sideslip), vy_m_s=speeds * np.sin(sideslip),
                      yaw_rate_rad_s=np.zeros(len(sideslip)), sideslip_rad=sideslip)  # fmt: skip


def test_a_missing_estimate_counts_as_0():
    truth = track(np.radians(np.full(10, 3.0)))
    half = np.where(np.arange(10) < 5, np.nan, truth.sideslip_rad)
    found = errors(replace(truth, sideslip_rad=half), truth, 3.0)
    assert (found["rmse_deg"], found["available"]) == (pytest.approx(3.0 / np.sqrt(2.0)), 0.5)


def test_slow_stamps_are_not_scored_and_an_offset_is_removed_where_it_is_declared():
    slow = track(np.zeros(5), speed=2.9)
    assert errors(slow, slow, 3.0)["scored_s"] == 0.0
    truth = track(np.radians(np.array([2.0, 2.0, 2.0, 5.0])))
    found = errors(track(np.zeros(4)), truth, 3.0, has_offset=True)
    assert (found["offset_deg"], found["rmse_deg"]) == (pytest.approx(2.0), pytest.approx(1.5))


def test_the_page_shows_the_stored_scores_of_every_drive(tmp_path):
    stored = pl.read_parquet(RESULTS / "peers" / "scores.parquet")
    assert stored["log"].unique(maintain_order=True).to_list() == [drive.log for drive in PEER_DRIVES]
    assert study.main(["--stored", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "peers.md").read_text(encoding="utf-8") == (DOCS / "peers.md").read_text(encoding="utf-8")
    assert sum(drive.group == FULL_SIZE for drive in PEER_DRIVES) == 9


def made_table(file: Path) -> Path:
    """Write two runs in the layout of the tables of arXiv:2408.15610: times without a name, a column of runs."""
    t = np.arange(1200) * 0.01
    delta = 0.15 * np.sin(2.0 * t)
    columns = {
        "": np.concatenate([28.13 + t, 3.0 + t]),
        "delta": np.tile(delta, 2),
        "run_id": np.repeat([4, 7], len(t)),
    }
    columns |= {
        "v_x": np.full(2 * len(t), 2.0),
        "v_y": np.tile(0.1 * delta, 2),
        "omega_wheels": np.full(2 * len(t), 2.05),
    }
    columns |= {name: np.tile(2.0 * delta / 0.33, 2) for name in ("r", "r_imu")}
    columns |= {"ax_imu": np.zeros(2 * len(t)), "ay_imu": 2.0 * columns["r"], "Iq": np.zeros(2 * len(t))}
    pl.DataFrame(columns | {"friction": np.full(2 * len(t), 0.6)}).write_csv(file)
    return file


def test_a_published_table_is_a_log_for_each_run(tmp_path):
    entries = list(study.published(made_table(tmp_path / "hoons_all_test.csv"), tmp_path))
    assert [e.log.name for e in entries] == ["hoons_all_test_4.csv", "hoons_all_test_7.csv"]
    rows = {row["estimator"]: row for row in scores(entries[1])[0]}
    assert {"zero", "kinematic", "linear-kf"} <= rows.keys()
    sideslip = np.arctan2(0.015 * np.sin(2.0 * np.arange(1200) * 0.01), 2.0)
    assert rows["zero"]["rmse_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(sideslip**2))), rel=0.01)
    assert rows["zero"]["scored_s"] == pytest.approx(11.99, abs=0.05)


def test_the_benchmark_weighs_drives_by_time_and_compares_with_zero_on_the_same_drives():
    def row(log: str, estimator: str, rmse: float, seconds: float):
        figures = {"available": 1.0, "coverage95": np.nan, "winkler_deg": np.nan, "seconds_per_hour": 2.0}
        names = {"group": "g", "log": log, "drive": log, "car": "c", "estimator": estimator}
        return names | {"scored_s": seconds, "rmse_deg": rmse} | figures

    rows = [row("a", "zero", 4.0, 30.0), row("b", "zero", 2.0, 10.0), row("b", "half", 1.0, 10.0)]
    head, _, half, zero = estimator_table(pl.DataFrame(rows)).splitlines()
    assert head.startswith("| estimator | drives | RMSE |")
    assert half == "| `half` | 1 | 1.00 | – to – | 0.50 | 1.00 | 1.00 | 100% | – | – | 2.0 |"
    assert [cell.strip() for cell in zero.split("|")[2:4]] == ["2", f"{np.sqrt((30 * 16 + 10 * 4) / 40):.2f}"]


def pair(untaught: float, hybrid: float) -> Pair:
    ways = {"untaught": untaught, "prior": untaught, "hybrid": hybrid}
    scores = {n: {"rmse_deg": x, "without_constant_deg": x, "active": 0.6, "covered": 0.95} for n, x in ways.items()}
    about = {"car": "car", "taught": "a", "scored": "b", "rung": "linear", "reference": None}
    return {**about, **scores, "kinematic_deg": 1.0, "paper_deg": 1.0}


def test_a_pair_is_worse_beyond_the_larger_of_both_limits():
    assert not is_worse(pair(0.2, 0.229)) and is_worse(pair(0.2, 0.231))
    assert not is_worse(pair(2.0, 2.09)) and is_worse(pair(2.0, 2.11))
    text = blocks([pair(1.0, 0.5), pair(1.0, 0.8)])["pairs_summary"]
    assert "0.63 (2 pairs)" in text and "worse" in blocks([pair(0.2, 0.3)])["pairs"]


def test_the_stored_results_have_every_pair_and_none_is_worse_than_untaught():
    stored = json.loads((RESULTS / "teaching" / STORED).read_text(encoding="utf-8"))
    counts = {car.name: len(car.parts) for car in CARS}
    for car in CARS:
        wanted = len(car.parts) - car.taught_on if car.taught_on > 1 else counts[car.name] * (counts[car.name] - 1)
        assert sum(r["car"] == car.name for r in stored) == wanted
    assert not any(is_worse(r) for r in stored)
    assert math.prod(map(ratio, stored)) <= 0.97 ** len(stored)
    page = (DOCS / "peers.md").read_text(encoding="utf-8")
    assert all(blocks(stored)[name] in page for name in ("pairs", "pairs_summary"))


def test_a_fitted_file_has_the_mass_and_the_stiffness_of_the_car(sample_logs_dir):
    vehicle = Car.load(sample_logs_dir / "vehicle.toml").vehicle
    fitted = fit_vehicle(choose_vehicle("sedan,mass=1.2,stiffness=0.85"), 0.3, vehicle)
    assert fitted.mass_kg == pytest.approx(1.2 * 1440.0)
    soft = fitted.cornering_stiffness_n_per_rad(True, 0.3)
    stiff = fit_vehicle(choose_vehicle("sedan,mass=1.2"), 0.3, vehicle).cornering_stiffness_n_per_rad(True, 0.3)
    assert soft / stiff == pytest.approx(0.85, rel=0.08)


def test_the_stored_page_is_that_of_the_stored_results(tmp_path):
    results = RESULTS / "conditions"
    for name in ("facts.json", "metrics.parquet"):
        (tmp_path / name).write_bytes((results / name).read_bytes())
    assert conditions.main(["--stored", "--results", str(tmp_path), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "conditions.md").read_bytes() == (DOCS / "conditions.md").read_bytes()


def test_a_calibrated_figure_is_accepted_and_others_are_not():
    errors = np.random.default_rng(0).normal(size=2000)
    scores = [
        {"figure": name, "drive": "road", "score": float(e) / sd}
        for name, sd in {"right": 1.0, "narrow": 0.5, "wide": 3.0}.items()
        for e in errors
    ]
    found = {row[0]: row[-1] for row in coverages(pl.DataFrame(scores))}
    assert found == {"right": "yes", "narrow": "no", "wide": "too wide"}


def test_names_of_cases_are_unique_and_all_are_stored_and_on_the_page():
    names = [case.name for case in reference.cases()]
    assert len(set(names)) == len(names)
    stored = json.loads((RESULTS / "reference" / reference.STORED).read_text(encoding="utf-8"))
    assert set(names) <= set(stored)
    page = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert page == fill(page, reference.blocks(stored), "reference.md")


def test_added_gnss_is_read_as_a_topic_of_the_log(sample_logs_dir, tmp_path):
    log = sample_logs_dir / "step.mcap"
    start = inspect_log(log).to_dict()["start_ns"]
    stamps = start + np.arange(20, dtype=np.int64) * 100_000_000
    copy = reference.add_gnss(log, tmp_path / "copy.mcap", stamps, np.full((20, 2), 3.0))
    before, after = ({t["name"]: t["messages"] for t in inspect_log(p).to_dict()["topics"]} for p in (log, copy))
    assert after == before | {reference.GNSS_TOPIC: 20}


def test_a_row_without_its_files_is_skipped_with_the_reason(tmp_path, monkeypatch, capsys):
    absent = tmp_path / "drive.mcap"
    row = GateRow("recorded drives", "drive.mcap", lambda _: pytest.fail("measured"), needs=(absent,))
    monkeypatch.setattr(gates, "all_rows", lambda: [row])
    assert gates.main(["--work", str(tmp_path / "work")]) == 0
    out, err = capsys.readouterr()
    assert f"recorded drives/drive.mcap: skipped, because {absent} is absent" in err
    assert out == "no figure moved\n"


DOCUMENTS = [*DOCS.glob("*.md"), *ROOT.glob("*.md"), ROOT / "Makefile", *ROOT.glob("sample_logs/*.toml")]
TEXTS = {p.name: p.read_text(encoding="utf-8") for p in DOCUMENTS}


def test_every_command_and_file_that_a_document_names_is_there():
    named = {(p, m) for p, t in TEXTS.items() for m in re.findall(r"-m ((?:benchmarks|studies)(?:\.\w+)*)", t)}
    assert {"studies.paper", "studies.peers", "benchmarks.performance"} <= {m for _, m in named}
    assert not {(p, m) for p, m in named if find_spec(m) is None}
    files = {(p, f) for p, t in TEXTS.items() for f in re.findall(r"(?:benchmarks|studies)/[\w/]+\.py", t)}
    assert files
    assert not {(p, f) for p, f in files if not (ROOT / f).is_file()}
