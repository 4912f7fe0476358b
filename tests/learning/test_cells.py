"""Cells of a dataset by speed, lateral acceleration and friction, and the selection of training data from them."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_network_parts import arrays

from pdhef_logtool.learning.network.cells import (
    COUNT,
    cell_of,
    cells,
    condition_of,
    draw_limits,
    draw_of,
    is_chosen,
    pick,
)
from pdhef_logtool.learning.network.dataset import MANIFEST, read_dataset
from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.learning.network.train_command import LEAD_STEPS, gap_free_runs, weights_of
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.storage.documents import seal


def test_every_row_lies_in_the_cell_of_its_speed_acceleration_and_friction() -> None:
    features = np.zeros((5, len(FEATURES)))
    columns = [FEATURES.index(n) for n in ("vx_m_s", "ay_m_s2", "friction")]
    features[:, columns] = [(5, 0, 0.2), (10, -2.0, 0.35), (29.9, 5.9, 1.0), (70, -9, 0.9), (np.nan, 0, 1)]
    found = cell_of(features)
    assert found[4] == -1
    for (speed, ay, friction), number in zip(features[:4, columns], found[:4], strict=True):
        cell = cells()[number]
        for value, low, high in zip((speed, abs(ay), friction), cell.low, cell.high, strict=True):
            assert low <= value < high
    assert [c.low for c in cells() if not c.in_reach] == [(v, a, 0.0) for a in (4.0, 6.0) for v in (0.0, 10, 20, 30)]
    assert len(cells()) == COUNT == 48 and cells()[-1].high == (math.inf,) * 3


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=1, max_size=8), st.floats(0.5, 30.0), st.randoms(use_true_random=False))
def test_a_choice_holds_at_most_so_much_depends_on_no_order_and_shrinks_as_the_set_grows(
    lengths: list[int], most_s: float, shuffle: object
) -> None:
    drives = []
    for number, seconds in enumerate(lengths):
        stamps = np.arange(seconds * 10) * 100_000_000
        cell = np.where(np.arange(len(stamps)) // 50 % 2, 3, 7).astype(np.int16)
        drives.append((cell, draw_of(stamps, f"0:{number}"), 0.1))
    limits = draw_limits(drives, most_s)
    assert draw_limits(sorted(drives, key=lambda _: shuffle.random()), most_s) == limits  # type: ignore[attr-defined]
    fewer = draw_limits(drives[:-1], most_s)
    for number in (3, 7):
        held = sum(float((c == number).sum()) * 0.1 for c, _, _ in drives)
        chosen = sum(float((is_chosen(c, d, limits) & (c == number)).sum()) * 0.1 for c, d, _ in drives)
        assert chosen <= most_s + 1e-6
        if abs(held - most_s) > 1e-6:  # else rounding decides
            assert (held <= most_s) == (limits[number] == 1.0)
        assert chosen > min(held, most_s) - 1.0 - 1e-6, "a second more would fit"
        assert limits[number] <= fewer[number]
    assert [x for i, x in enumerate(limits) if i not in (3, 7)] == [1.0] * (COUNT - 2)


def test_conditions_are_on_the_columns_of_a_row() -> None:
    made, none = arrays(50), np.full(50, np.nan)
    columns = [made.stamps_ns, made.features, made.targets, made.step_s, made.weight, made.segment, made.truth_velocity]
    rows = ResidualRows(*columns, none, none)
    vx, ay = (rows.features[:, FEATURES.index(n)] for n in ("vx_m_s", "ay_m_s2"))
    holds = pick(rows, condition_of("abs(ay_m_s2) > 0.5 and not vx_km_h < 1.8 or truth_vx_m_s < 0")).chosen
    np.testing.assert_array_equal(holds, (np.abs(ay) > 0.5) & ~(vx * 3.6 < 1.8))
    assert pick(rows).chosen.all() and not pick(rows, condition_of("not 1 < 2")).chosen.any()
    for wrong in ("sideslip_rad > 1", "truth.vx_m_s > 1", "vx_m_s > 1 and (select 1)", "vx_m_s", "friction > 1 and"):
        with pytest.raises(UsageError, match="--where"):
            condition_of(wrong)


def test_what_is_not_chosen_teaches_nothing_and_only_what_leads_to_the_chosen_is_run() -> None:
    chosen = np.zeros(2000, dtype=np.bool_)
    chosen[[700, 740]] = True
    chosen[1500] = True
    weight = np.ones(2000, dtype=np.float32)
    weight[1500] = 0.0  # chosen, but of no use
    rows = arrays(2000, chosen=chosen, weight=weight)
    (run,) = gap_free_runs(rows)
    assert run == slice(700 - LEAD_STEPS, 741)
    assert weights_of(rows, run).sum() == 2.0
    cut = replace(rows, segment=np.where(np.arange(2000) < 720, 0, 1))
    assert list(gap_free_runs(cut)) == [slice(700 - LEAD_STEPS, 720)], "what is left behind the cut is too short"


@pytest.mark.slow
def test_extract_chooses_leaves_copies_out_and_older_sets_still_open(sample_logs_dir: Path, tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "out"
    for name in ("a", "b"):
        shutil.copy(sample_logs_dir / "dlc.mcap", tmp_path / f"{name}.mcap")
    told: list[str] = []
    asked = ExtractSettings(RunConfig(), split="train", where="vx_m_s > 10", per_cell_s=2.0)
    result = extract([str(log), str(tmp_path / "b.mcap")], out, asked, reporter=Reporter(warn=told.append))
    assert "b is left out: it contains the same signals as a" in told and result.exit_code == 0
    assert result.manifest["duplicates"] == [{"log": "b", "file": "b.mcap", "of": "a"}]
    assert [p.name for p in out.rglob("*.parquet")] == ["part-a.parquet"]
    (drive,) = read_dataset(out).drives
    rows = drive.load()
    assert rows.chosen is not None
    cell = cell_of(rows.features.astype(np.float64))
    use = rows.chosen & (rows.weight > 0.0)
    seconds = np.bincount(cell[use], minlength=COUNT) * drive.entry["period_s"]
    held = np.array(result.manifest["cells"]["usable_s"]["train"])
    assert held.max() > 4.0 and seconds.max() < 2.05, "a row or two may lie on an edge in float32"
    assert (seconds[held > 0] > 0).all()
    # The same signals under another name, in another call, replace the existing ones.
    extract([str(tmp_path / "b.mcap")], out, replace(asked, split="validation", per_cell_s=None))
    (other,) = read_dataset(out).drives
    assert (other.entry["name"], other.entry["split"], other.limits) == ("b", "validation", None)
    for wrong in ({"where": "vx > 1"}, {"per_cell_s": 0.0}):
        with pytest.raises(UsageError):
            extract([str(log)], tmp_path / "new", replace(asked, **wrong))  # type: ignore[arg-type]
    document = json.loads((out / MANIFEST).read_text())
    del document["digest"]
    (out / MANIFEST).write_text(json.dumps(seal({**document, "version": 2})))
    with pytest.raises(OutputError, match="creates it again"):
        read_dataset(out)
