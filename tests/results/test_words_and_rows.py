"""Exact texts and values of the outputs, for literal documents and rows."""

from __future__ import annotations

import importlib.metadata
import json
from typing import Any

from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.run_report import diverged_line, json_bytes, report_markdown, tool_versions
from pdhef_logtool.results.sink import Event
from tests.run_report import ran, report

SECOND = 10**9


def test_colours_are_red_green_blue_and_a_names_own() -> None:
    assert colour_rgb("phy-ukf", {"phy-ukf": 0x12_34_56}) == (0x12, 0x34, 0x56)
    assert colour_rgb("truth", {}) == (0x8A, 0x8A, 0x8A)
    palette = "d55e00 0072b2 e69f00 009e73 cc79a7 56b4e9"
    found = [colour_rgb(f"recorded {i}", {"phy-ukf": 0}) for i in range(40)]
    assert set(found) == {tuple(bytes.fromhex(colour)) for colour in palette.split()}
    assert colour_rgb("recorded 7", {}) == found[7]


def _report(**changes: Any) -> dict[str, Any]:
    estimators = [ran("ukf", notes=["a", "b"]), ran("smooth", causal=False)]
    content = {"estimators": estimators, "warnings": ["careful"], "losses": [Loss("gap", "a gap", "/imu")], **changes}
    return report(None, **content)


def test_the_report_for_people_is_this() -> None:
    spans = [
        Event("ukf diverged", 5 * SECOND, 6 * SECOND, ""),
        Event("ukf diverged", 2 * SECOND, 2 * SECOND + 250_000_000, ""),
    ]
    assert report_markdown(_report(segments=spans)).splitlines() == [
        "# drive", "", "drive.mcap (mcap), 10.0 s", "",
        "## Warnings", "", "- careful", "",
        "## Losses", "", "- a gap (/imu)", "",
        "## Estimators", "",
        "- **ukf** (causal): a; b; diverged for 1.25 s in 2 intervals, first at 2.00 s",
        "- **smooth** (not causal)",
    ]  # fmt: skip
    assert diverged_line(_report(segments=spans[:1]), "ukf") == "diverged for 1.00 s, first at 5.00 s"
    assert diverged_line(_report(segments=spans), "smooth") == ""
    assert "Warnings" not in report_markdown(_report(warnings=[], losses=[]))
    verdict = {"id": "S", "label": "sideslip RMSE ≤ 1°", "reason": "1.2° (95 % CI 1.1° to 1.3°)", "next": ""}
    verdict["outcome"] = "FAIL"
    text = report_markdown(_report(plan={"file": "p.toml", "requirements": [verdict]}))
    assert "- **FAIL** sideslip RMSE ≤ 1°: 1.2° (95 % CI 1.1° to 1.3°)" in text


def test_versions_are_those_that_are_installed_and_json_is_the_same_everywhere() -> None:
    found = tool_versions()
    assert found["numpy"] == importlib.metadata.version("numpy") and "python" in found
    assert json_bytes({"b": "µ", "a": [float("nan")]}) == '{\n "a": [\n  null\n ],\n "b": "µ"\n}\n'.encode()
    assert json.loads(json_bytes({"a": 1})) == {"a": 1}
