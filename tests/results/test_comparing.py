"""Two runs held against each other."""

import json
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.evaluation.validation_plan import Requirement
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.comparing import Comparison, compare, compare_runs, figure, notes_of, sentence
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.storage.documents import jsonable
from tests.results.made_run import digest, entry, row, write_run

ASKED = (figure(),)
GATE = (figure(limit=0.05),)
TEN = {f"d{i}": 0.01 * (1 + i) for i in range(10)}


def _compare(a: Path, b: Path, gate: tuple[Requirement, ...] = ASKED, **options: Any) -> Comparison:
    return compare_runs(open_run(a), open_run(b), gate, **options)


def _scaled(factor: float, **changed: float) -> dict[str, float]:
    return {label: changed.get(label, value * factor * (1 + 0.001 * i)) for i, (label, value) in enumerate(TEN.items())}


def test_the_same_run_is_equal_and_nothing_else_is_looked_at(tmp_path):
    run = write_run(tmp_path / "a", TEN)
    for gate in (ASKED, GATE):
        found = _compare(run, run, gate, strict=True)
        assert (found.verdict, found.exit_code, found.changed) == ("equal", 0, 0)
        assert found.pairs == {"signals": 10}
        assert found.others == found.differences == ()


def test_drives_pair_by_signals_then_content_then_name(tmp_path):
    a = [entry("slim"), entry("moved"), entry("same"), entry("gone"), entry("twin1"), entry("twin2")]
    b = [entry("full", signals_sha256=digest("signals slim")), entry("same", signals_sha256=None, sha256=None)]
    b.append(entry("renamed", signals_sha256=None, sha256=digest("file moved")))
    b += [entry("new"), entry("twin1"), entry("twin2")]
    for twins in (a, b):
        for twin in twins[4:]:
            twin.update(signals_sha256=digest("twin"))
    rmse = {"slim": 0.1, "moved": 0.1, "same": 0.1, "twin1": 0.1, "twin2": 0.2}
    other = {"full": 0.1, "renamed": 0.1, "same": 0.1, "twin1": 0.1, "twin2": 0.2}
    found = _compare(write_run(tmp_path / "a", rmse, entries=a), write_run(tmp_path / "b", other, entries=b))
    assert found.pairs == {"signals": 1, "content": 3, "name": 1}
    assert (found.only_a, found.only_b, found.changed) == (("gone",), ("new",), 0)
    assert (found.verdict, found.exit_code) == ("equal", 3)
    assert any(line.startswith("drives: only their names") for line in found.differences)


@pytest.mark.slow
def test_the_gate_closes_on_a_regression_and_not_on_an_improvement(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    worse = _compare(a, write_run(tmp_path / "b", _scaled(1.2)), GATE)
    assert (worse.verdict, worse.exit_code) == ("worse", 4)
    assert worse.figures[0].drives[0]["drive"] == "d9"
    assert worse.figures[0].drives[0]["change"] == pytest.approx(0.2 * 1.009 + 0.009)
    assert _compare(a, tmp_path / "b").exit_code == 0  # no gate
    assert _compare(a, write_run(tmp_path / "c", _scaled(1.02)), GATE).verdict == "not worse"
    assert _compare(a, write_run(tmp_path / "d", _scaled(0.9)), GATE).verdict == "better"
    json.dumps(jsonable(worse.to_dict()), allow_nan=False)


def test_cannot_tell_is_an_answer_and_strict_refuses_it(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    b = write_run(tmp_path / "b", {k: v * (1.5 if i % 2 else 0.7) for i, (k, v) in enumerate(TEN.items())})
    for gate in (ASKED, GATE):
        found = _compare(a, b, gate)
        assert (found.verdict, found.exit_code) == ("inconclusive", 0)
        assert found.figures[0].detectable > 0.3
        assert replace(found, strict=True).exit_code == 4


def test_drives_of_six_days_that_change_together_are_no_evidence_unless_the_user_says_so(tmp_path):
    rmse = {f"d{i}": 0.01 for i in range(60)}
    changed = {label: 0.01 * (1.1 if i // 10 < 4 else 0.95) * (1 + 1e-4 * i) for i, label in enumerate(rmse)}
    of_days = [entry(label, day=f"2026-01-0{1 + i // 10}") for i, label in enumerate(rmse)]
    reports = {label: {"metadata": {"x.road": "north"}} for label in rmse}
    a = write_run(tmp_path / "a", rmse, entries=of_days, reports=reports)
    b = write_run(tmp_path / "b", changed)
    found = _compare(a, b, GATE)
    (days,) = found.figures
    assert (found.verdict, days.change.dependence.by) == ("inconclusive", ("day",))
    assert days.change.dependence.levels == (("day", 6),)
    assert days.change.dependence.design_effect == pytest.approx(10.0)
    assert "60 drives of 6 days have the evidence of 6 independent drives" in "".join(notes_of(found))
    assert found.to_dict()["figures"][0]["dependence"] == ("day",)
    alone = _compare(a, b, GATE, cluster="none")
    assert (alone.verdict, alone.figures[0].change.dependence.design_effect) == ("worse", 1.0)
    assert "--cluster none" in "".join(notes_of(alone))


def test_the_others_are_corrected_for_being_several(tmp_path):
    def rows(factor: float) -> list[Any]:
        signals = ("vx_m_s", "ay_m_s2", "yaw_rate_rad_s")
        return [row(k, factor, signal=s) for k in TEN for s in signals] + [row(k, 1, signal="vy_m_s") for k in TEN]

    a, b = write_run(tmp_path / "a", TEN, rows=rows(1.0)), write_run(tmp_path / "b", _scaled(1.1), rows=rows(1.1))
    by_signal = {f.requirement.signal: f for f in _compare(a, b).others}
    assert by_signal["vx_m_s"].change.sign_p == pytest.approx(2 * 0.5**10)
    assert by_signal["vx_m_s"].corrected_p == pytest.approx(4 * 2 * 0.5**10)
    assert (by_signal["vy_m_s"].corrected_p, by_signal["vy_m_s"].verdict) == (1.0, "equal")


def test_what_else_differs_is_said(tmp_path):
    changed = {
        "d0": {"car": {"name": "golf", "sha256": digest("tuned"), "network_sha256": digest("net")}},
        "d1": {"truth_sha256": digest("rtk")},
        "d3": {"main": "physics"},
        "d4": {"outcome": "lost: a chunk"},
        "d2": {"mapping_sha256": digest("scaled"), "signals_sha256": digest("scaled signals")},
        "d5": {"signals_sha256": digest("other signals"), "sha256": digest("another file")},
    }
    b = [entry(label, **changed.get(label, {})) for label in TEN]
    other = write_run(tmp_path / "b", TEN, entries=b, config={"friction": 0.3}, versions={"numpy": "2.1"})
    found = _compare(write_run(tmp_path / "a", TEN), other)
    text = "\n".join(found.differences)
    assert f"car: golf {digest('golf')[:8]} → golf {digest('tuned')[:8]}, 1 of 10 drives" in text
    assert f"network: none → {digest('net')[:8]}, 1 of 10 drives" in text
    assert "truth: another one (what it held), 1 of 10 drives: d1" in text
    assert "mapping: another one" in text
    assert (
        "signals: they held something else, 2 of 10 drives: d2, d5; 1 of them are one drive by their name alone" in text
    )
    assert "selected estimate: pd-hef → physics, 1 of 10 drives" in text
    assert "configuration: friction auto → 0.3" in text
    assert "versions: numpy 2.0 → 2.1" in text
    assert "outcome of d4: ok → lost: a chunk" in text


def test_no_pair_and_unknown_names_are_errors(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    b = write_run(tmp_path / "b", {"other": 0.1})
    with pytest.raises(OutputError, match="none of 10 and 1 by signals, content or name") as error:
        _compare(a, b)
    assert error.value.exit_code == 1
    c = write_run(tmp_path / "c", _scaled(1.1))
    with pytest.raises(UsageError, match="an estimator of these runs: pd-hef, got pd-hof"):
        _compare(a, c, (figure(estimator="pd-hof", limit=0.1),))
    scored = write_run(tmp_path / "scored", _scaled(1.1), entries=[entry(label, main=None) for label in TEN])
    with pytest.raises(UsageError, match="an estimator of these runs: pd-hef, got none named"):
        _compare(scored, a)
    assert _compare(scored, a, (figure(estimator="pd-hef"),)).figures[0].change.drives == 10


def test_a_history_has_a_row_per_run_and_reads_only_tables(tmp_path):
    versions = [{"versions": {"pdhef-logtool": version}} for version in ("1", "2", "3", "4")]
    rmse = [TEN, TEN, _scaled(1.2), {**_scaled(1.0), "new": 0.1}]
    runs = [
        write_run(tmp_path / of["versions"]["pdhef-logtool"], x, **of) for x, of in zip(rmse, versions, strict=True)
    ]
    assert not list(tmp_path.rglob("report.json"))
    found = compare(*runs, max_regression="5%", allow_unpaired=True)
    assert (found.a, found.b, found.verdict, found.exit_code) == (str(runs[2]), str(runs[3]), "better", 0)
    rows = jsonable(found.to_dict())["history"]
    assert [(r["version"], r["drives"], r["verdict"]) for r in rows] == [
        ("1", 10, ""), ("2", 10, "equal"), ("3", 10, "worse"), ("4", 11, "better"),
    ]  # fmt: skip
    assert rows[0]["value"] == pytest.approx(math.sqrt(sum(x**2 for x in TEN.values()) / 10))
    assert rows[0]["low"] < rows[0]["value"] < rows[0]["high"] and rows[0]["change"] == [None] * 3
    assert rows[1]["change"][0] == 0.0 and rows[2]["change"][0] == pytest.approx(0.2, abs=0.01)
    assert compare(*runs[:3], max_regression="5%").exit_code == 4
    assert compare(*runs[:2]).history == ()


@settings(max_examples=8, deadline=None)
@given(changed=st.sets(st.sampled_from(["asked", "other signal", "other estimator", "stamps"])), gated=st.booleans())
def test_verdict_and_number_of_changed_drives_never_contradict(changed, gated):
    def rows(of: set[str]) -> list[Any]:
        more = [row(k, 1.0 + ("other signal" in of), signal="vx_m_s") for k in TEN]
        more += [row(k, 1.0 + ("other estimator" in of), estimator="zero") for k in TEN]
        return [*more, *(row(k, v * (1.3 if "asked" in of else 1.0), n=99 + ("stamps" in of)) for k, v in TEN.items())]

    with TemporaryDirectory() as folder:
        runs = [
            write_run(Path(folder) / str(len(of)), dict.fromkeys(TEN, math.nan), rows=rows(of))
            for of in (set(), changed)
        ]
        found = _compare(runs[0], runs[-1], GATE if gated else ASKED)
    assert found.equal == (not changed) == (found.changed == 0)
    assert (found.verdict == "equal") == (not changed & {"asked", "stamps"})
    text = sentence("changes", found)
    assert ("No figure of the drives" in text) == found.equal
    assert ("none of the compared ones" in text) == (found.verdict == "equal" and not found.equal)
    assert sentence("verdict", found).startswith("equal: all figures") == found.equal
    assert "all figures" in sentence("verdict", found) or "10 of 10 drives" in text
