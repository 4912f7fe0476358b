"""Reports of runs with figures that a test gives."""

import functools
import html
import re
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.results.parquet_sink import load_schema
from pdhef_logtool.results.run_report import build_report, estimator_entry, tool_versions
from pdhef_logtool.results.selected_estimate import MainFacts

SHA = "ab" * 32
MODEL = {"physics_sha256": SHA, "options": {"trust": 0.5}}
MAIN = MainFacts("pd-hef", "", False, "zero", ("pd-hef", "physics", "zero"), named=False)


@functools.cache
def _validator(schema: str) -> Draft202012Validator:
    return Draft202012Validator(load_schema(schema))  # ``tests/car/test_vehicle.py`` checks schemas


def follows(document: Any, schema: str = "report.schema.json") -> None:
    """Raise a ``ValidationError`` if a document does not follow a schema."""
    if error := best_match(_validator(schema).iter_errors(document)):
        raise error


def text_of(page: str | bytes) -> str:
    """Return the text that a page shows."""
    body = (page if isinstance(page, str) else page.decode()).partition("<main>")[2].partition("</main>")[0]
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", body)).split())


def truth(*quantities: tuple[str, str, str], **changes: Any) -> dict[str, Any]:
    """Return the ground truth of a report: name, source and derivation of each quantity."""
    entries = {n: d or s for n, s, d in quantities}
    unknown = {"latency_s": None, "not_independent": [], "notes": []}
    return {"available": bool(entries), "quantities": entries, **unknown, **changes}


VELOCITY = ("vx_m_s", "/ins.vx", ""), ("vy_m_s", "/ins.vy", "")
TRUTH = truth(*VELOCITY, ("sideslip_rad", "derived", "atan2(v_y, v_x)"))
GNSS = truth(("vx_m_s", "derived", "ground speed of /fix.{a,b} taken as v_x, no heading known"))


def figures(*given: tuple[str, str, str, float]) -> list[MetricRow]:
    return [MetricRow("drive", e, s, "all", m, v, "", 9) for e, s, m, v in given]


def errors_deg(**by_name: float) -> list[MetricRow]:
    return figures(*((n.replace("_", "-"), "sideslip_rad", "rmse", np.deg2rad(v)) for n, v in by_name.items()))


def ran(name: str, **changes: Any) -> dict[str, Any]:
    return estimator_entry(name, **{"causal": True, "algorithm": MODEL, **changes})


def report(
    main: MainFacts | None = MAIN, *, name: str = "drive", vehicle: dict[str, Any] | None = None, **changes: Any
) -> dict[str, Any]:
    """Return a report; ``vehicle`` : changed entries of the vehicle."""
    nothing: dict[str, Any] = dict.fromkeys(("metrics", "segments", "losses", "warnings", "remarks", "checks"), ())
    log = {
        "name": name, "file": f"{name}.mcap", "kind": "mcap", "sha256": SHA, "start_ns": 0,
        "end_ns": 10_000_000_000, "duration_s": 10.0,
    }  # fmt: skip
    car = {
        "name": "sedan", "sha256": SHA, "file": "golf", "proven": True, "taught": None, "assumed": {},
        "low_speed_blend_m_s": None,
    }  # fmt: skip
    content = {
        "log": log,
        "mapping": {"missing": []},
        "vehicle": car | (vehicle or {}),
        "estimators": [
            ran("zero", algorithm={"physics_sha256": None, "options": {}}),
            *(ran(name, intervals=["intervals: own, parameters and sensors"]) for name in ("physics", "pd-hef")),
        ],
        "truth": TRUTH,
        "model": None,
        "friction": {"source": "option", "value": 0.9, "topic": None, "given": True},
        "self_calibration": None,
        "reference": None,
        "ledger": {"samples": []},
        "versions": tool_versions(),
    }
    return build_report(content | nothing | changes, main)
