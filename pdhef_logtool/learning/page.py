"""``learn.md`` and its plot: outcome of each stage, the test part that was scored once, what more driving is worth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pdhef_logtool.learning.plots import new_figure, png_bytes
from pdhef_logtool.records.printable import printable

_COLOURS = {"kept": "#009E73", "undone": "#D55E00", "not done": "0.6"}
#: Use of each part of the drives.
_USES = {
    "training": "parameters and noise",
    "network training": "the network; without this part the training part",
    "validation": "decision after each stage; residual gain; intervals",
    "test": "scored once, at the end",
}


def page_markdown(document: Mapping[str, Any]) -> str:
    """Return the record of ``pdhef learn`` as Markdown; angles in degrees."""
    lines = [f"# Training of {_text(document['car_name'])}", "", "![stages and test part](learn.png)", ""]
    rows = [
        [name, f"{part['usable_s']:.0f}", _USES[name], ", ".join(part["slices"]) or "–"]
        for name, part in document["split"].items()
    ]
    lines += ["## Split", "", *_table(("part", "usable seconds", "for", "slices"), rows)]
    lines += ["## Stages", ""]
    lines += [
        "Before and after: sideslip RMSE in degrees on the validation part. A stage that raises it is undone.",
        "",
    ]
    lines += _table(
        ("stage", "outcome", "before", "after", "evidence"),
        ([s["name"], s["status"], _figure(s["before"]), _figure(s["after"]), s["text"]] for s in document["stages"]),
    )
    lines += ["## Test part, scored once at the end", ""]
    if document["evaluations"] > 1:
        lines += [
            f"Number of evaluations on the test part, in calls with this output: {document['evaluations']}. "
            "The figures are too good if a choice was made by them.",
            "",
        ]
    lines += _scores(document["test"]) if document["test"] else ["Nothing was held out.", ""]
    lines += ["## Validation part, which decided on the stages", "", *_scores(document["validation"])]
    lines += ["## What more driving would be worth", ""]
    lines += [f"- {_text(text)}" for text in document["more"]] or ["- nothing is missing"]
    lines += ["", "Versions: " + ", ".join(f"{k} {v}" for k, v in sorted(document["versions"].items()))]
    return "\n".join(lines) + "\n"


def _scores(lines: Iterable[Mapping[str, Any]]) -> list[str]:
    rows = []
    for line in lines:
        name = line["name"] if line.get("causal", True) else f"{line['name']} (not causal)"
        if "skipped" in line:
            rows.append([name, f"– ({line['skipped']})", "", "", ""])
            continue
        covered = "–" if line["covered"] is None else f"{100 * line['covered']:.0f} %"
        against = "–" if line["against_hybrid_deg"] is None else _interval(line["against_hybrid_deg"], "+")
        rows.append([name, _interval(line["rmse_deg"]), f"{100 * line['share']:.0f} %", covered, against])
    heads = (
        "estimator",
        "sideslip RMSE °",
        "of the stamps",
        "coverage (nominal 95 %)",
        "minus that of pd-hef, trained °",
    )
    return [*_table(heads, rows), "In brackets: 95 % interval of a bootstrap of 10 s blocks.", ""]


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(_text(cell) for cell in row) + " |" for row in rows]
    return ["| " + " | ".join(heads) + " |", "| " + " | ".join("---" for _ in heads) + " |", *body, ""]


def _text(value: str) -> str:
    """Return a text from outside as a cell of a table can contain it."""
    return printable(value).replace("|", "\\|")


def _figure(entry: Sequence[Any] | None) -> str:
    return "–" if entry is None else f"{entry[0]}: {entry[1]:.3f}"


def _interval(entry: Sequence[float | None], sign: str = "") -> str:
    value, low, high = entry
    if value is None:
        return "–"
    return f"{value:{sign}.3f}" if low is None else f"{value:{sign}.3f} [{low:.3f}, {high:.3f}]"


def draw_page(document: Mapping[str, Any]) -> bytes:
    """Return the plot as PNG: validation error after each stage, and the test part (else validation) by estimator."""
    figure = new_figure(11.0, 4.5)
    left, right = figure.subplots(1, 2, width_ratios=[2, 3])
    stages = [s for s in document["stages"] if s["after"] is not None]
    for row, stage in enumerate(stages):
        left.plot([stage["before"][1], stage["after"][1]], [row, row], color="0.8", lw=4, zorder=1)
        left.plot(stage["before"][1], row, "o", mfc="white", color="0.4")
        left.plot(stage["after"][1], row, "o", color=_COLOURS[stage["status"]])
    left.set_yticks(range(len(stages)), [f"{s['name']} ({s['status']})" for s in stages])
    left.invert_yaxis()
    left.set(xlabel="sideslip RMSE (°), before (open) and after", title="validation part")
    left.grid(alpha=0.3, axis="x")
    part = "test" if document["test"] else "validation"
    lines = [x for x in document[part] if "skipped" not in x and x["rmse_deg"][0] is not None]
    for row, line in enumerate(lines):
        value, low, high = line["rmse_deg"]
        right.barh(row, value, color="#0072B2" if "trained" in line["name"] else "0.7")
        if low is not None:
            right.plot([low, high], [row, row], color="0.2", lw=1.5)
        right.text(value, row, f" {value:.3f}", va="bottom", fontsize=8)
    right.set_yticks(range(len(lines)), [x["name"] for x in lines])
    right.invert_yaxis()
    right.set(xlabel="sideslip RMSE (°), 95 % interval", title=f"{part} part")
    right.grid(alpha=0.3, axis="x")
    return png_bytes(figure)
