"""A metric is one file and one line: the example of the package's docstring, added that way, is in every output."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from mcap.reader import make_reader

from pdhef_logtool import RunConfig, open_run
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.evaluation import metrics
from pdhef_logtool.evaluation.metrics import metric as registry
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.reports.comparison import comparison_page
from pdhef_logtool.results import comparing
from pdhef_logtool.results.comparing import compare_runs, figure
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import printed, rendered

NAME, LABEL = "interval_width", "interval width"


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """Add the example as a file beside the package's and as a line of its list; return its name."""
    folder = tmp_path_factory.mktemp("metrics")
    example = re.sub(r"^    ", "", str(metrics.__doc__).partition("::\n\n")[2], flags=re.MULTILINE)
    (folder / f"{NAME}.py").write_text(example, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "__path__", [*metrics.__path__, str(folder)])
        patch.setattr(registry, "MODULES", (*registry.MODULES, NAME))
        registered.cache_clear()
        yield NAME
    registered.cache_clear()
    sys.modules.pop(f"{metrics.__name__}.{NAME}", None)


@pytest.fixture(scope="module")
def result(toy, sample_logs_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    limits = f'metric = "{toy}"\nstatistic = "worst drive"\nestimator = "physics"\nlimit_deg = 0.001\n'
    text = f'[[requirement]]\nid = "toy"\nsignal = "sideslip_rad"\n{limits}'
    (out / "plan.toml").write_text(text, encoding="utf-8")
    config = RunConfig(
        car=sample_logs_dir / "vehicle.toml", estimators=("physics", "zero"), annotate="sidecar", plan=out / "plan.toml"
    )
    return run_logs([str(sample_logs_dir / "dlc.mcap")], out / "out", config)


def test_figures_are_in_parquet_json_and_mcap(toy, result):
    assert result.place is not None
    folder = Path(result.place) / "logs" / "dlc"
    rows = pl.read_parquet(folder / "metrics.parquet").filter(metric=toy, estimator="physics")
    assert dict(zip(rows["signal"], rows["unit"], strict=True)) == {
        "vx_m_s": "m/s",
        "vy_m_s": "m/s",
        "yaw_rate_rad_s": "rad/s",
        "sideslip_rad": "rad",
    }
    (row,) = rows.filter(signal="sideslip_rad", segment="all").iter_rows(named=True)
    assert 0.0 < row["value"] < 1.0
    report = json.loads((folder / "report.json").read_text())
    assert row["value"] in [m["value"] for m in report["metrics"] if m["metric"] == toy]
    with (folder / "annotated.mcap").open("rb") as file:
        (record,) = (m.metadata for m in make_reader(file).iter_metadata() if m.name == "pdhef.metrics")
    assert record[f"physics/sideslip_rad/all/{toy}"] == f"{row['value']:.9g} rad n={row['n']}"


def test_it_has_a_column_in_the_terminal_and_on_the_page_with_its_definition(toy, result):
    assert re.search(r"interval\s*\n?.*width °", rendered(render_run, result, 200))
    page = (Path(str(result.place)) / "logs" / "dlc" / "report.html").read_text(encoding="utf-8")
    assert f'<th class="n">{LABEL}</th>' in page
    assert registered()[toy].definition in page


def test_plans_and_compare_accept_it(toy, result):
    (verdict,) = result.requirements.verdicts
    assert (verdict.outcome, result.exit_code) == ("FAIL", 4)
    assert verdict.requirement.label == f"sideslip {LABEL} ≤ 0.001° (worst drive, physics)"
    gate = (figure(metric=toy, limit=0.05),)
    run = open_run(str(result.place))
    found = compare_runs(run, run, gate)
    (compared,) = found.figures
    assert (compared.verdict, compared.unit, compared.requirement.name) == ("equal", "rad", f"sideslip {LABEL}")
    changed = replace(found, changed=1, figures=(replace(compared, verdict="worse"),))
    assert f"sideslip {LABEL}" in printed("comparison", changed, 120, comparing=comparing)
    assert LABEL.encode() in comparison_page(changed)


def test_units_of_all_figures_are_those_that_the_metrics_name(result):
    rows = result.results[0].rows
    assert {(r.metric, r.signal, r.unit) for r in rows} == {
        (r.metric, r.signal, registered()[r.metric].unit_of(r.signal)) for r in rows
    }


def test_a_name_is_registered_once(toy, monkeypatch):
    monkeypatch.setattr(registry, "MODULES", (*registry.MODULES, toy))
    registered.cache_clear()
    with pytest.raises(ValueError, match="registered twice"):
        registered()
