"""What the outputs say and hold to the letter, on documents and rows that are written out here."""

from __future__ import annotations

import importlib.metadata
import json
from typing import Any

from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.run_report import diverged_line, json_bytes, report_markdown, tool_versions

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND


def test_colours_are_red_green_blue_and_a_names_own() -> None:
    assert colour_rgb("phy-ukf", {"phy-ukf": 0x12_34_56}) == (0x12, 0x34, 0x56)
    assert colour_rgb("truth", {}) == (0x8A, 0x8A, 0x8A)
    palette = {
        (0xD5, 0x5E, 0),
        (0, 0x72, 0xB2),
        (0xE6, 0x9F, 0),
        (0, 0x9E, 0x73),
        (0xCC, 0x79, 0xA7),
        (0x56, 0xB4, 0xE9),
    }
    found = [colour_rgb(f"recorded {i}", {"phy-ukf": 0}) for i in range(40)]
    assert set(found) == palette
    assert colour_rgb("recorded 7", {}) == found[7]


def _report(**changes: Any) -> dict[str, Any]:
    rows = [
        {"estimator": e, "signal": s, "segment": "all", "metric": m, "value": v, "unit": u, "n": 9}
        for e in ("smooth", "ukf")
        for s, m, v, u in (
            ("vx_m_s", "rmse", 0.25, "m/s"), ("sideslip_rad", "rmse", 0.01, "rad"),
            ("sideslip_rad", "coverage", 0.9, "1"), ("yaw_rate_rad_s", "rmse", 0.02, "rad/s"),
        )
    ]  # fmt: skip
    base = {
        "log": {
            "name": "drive",
            "file": "d.mcap",
            "kind": "mcap",
            "duration_s": 6.04,
            "sha256": "ab" * 32,
            "start_ns": START_NS,
        },
        "vehicle": {"name": "sedan"},
        "warnings": ["careful"],
        "losses": [{"what": "a gap", "where": "/imu"}],
        "truth": {
            "available": True,
            "quantities": [{"name": "vy_m_s", "source": "/ins.v", "samples": 7, "derivation": "moved"}],
            "latency_s": 0.0125,
            "not_independent": ["vx_m_s"],
            "notes": ["smoothed"],
        },
        "friction": {"source": "vehicle file, 0.85", "summary": "observable"},
        "metrics": rows,
        "segments": [],
        "estimators": [
            {"name": "ukf", "causal": True, "reason": None, "notes": ["a", "b"], "reasons": None},
            {"name": "smooth", "causal": False, "reason": None, "notes": [], "reasons": []},
        ],
        "mapping": {
            "signals": [{"name": "ay_m_s2", "source": "/imu.y", "samples": 600, "derivation": ""}],
            "missing": ["friction"],
        },
        "versions": {"python": "3", "numpy": "2"},
    }
    return {**base, **changes}


def test_the_report_for_people_is_this() -> None:
    spans = [
        {"name": "ukf diverged", "start_ns": START_NS + 5 * SECOND, "end_ns": START_NS + 6 * SECOND, "text": ""},
        {
            "name": "ukf diverged",
            "start_ns": START_NS + 2 * SECOND,
            "end_ns": START_NS + 2 * SECOND + 250_000_000,
            "text": "",
        },
    ]
    report = _report(segments=spans)
    assert report_markdown(report).splitlines() == [
        "# drive", "", "d.mcap (mcap), 6.0 s", "",
        "## Warnings", "", "- careful", "",
        "## Losses", "", "- a gap (/imu)", "",
        "## Estimators", "",
        "- **ukf** (causal): a; b; diverged for 1.25 s in 2 intervals, first at 2.00 s",
        "- **smooth** (not causal)",
    ]  # fmt: skip
    assert diverged_line({**report, "segments": spans[:1]}, "ukf") == "diverged for 1.00 s, first at 5.00 s"
    assert diverged_line(report, "smooth") == ""
    assert "Warnings" not in report_markdown(_report(warnings=[], losses=[]))
    verdict = {"outcome": "FAIL", "label": "sideslip RMSE ≤ 1°", "reason": "1.2° (95 % CI 1.1° to 1.3°)"}
    text = report_markdown(_report(plan={"requirements": [verdict]}))
    assert "- **FAIL** sideslip RMSE ≤ 1°: 1.2° (95 % CI 1.1° to 1.3°)" in text


def test_versions_are_those_that_are_installed_and_json_is_the_same_everywhere() -> None:
    found = tool_versions()
    assert found["numpy"] == importlib.metadata.version("numpy") and "python" in found
    assert json_bytes({"b": "µ", "a": [float("nan")]}) == '{\n  "a": [\n    null\n  ],\n  "b": "µ"\n}\n'.encode()
    assert json.loads(json_bytes({"a": 1})) == {"a": 1}
