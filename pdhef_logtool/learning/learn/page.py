"""``learn.md`` and its plot: what each step found and was worth, the part that was scored once, what more would pay."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pdhef_logtool.learning.plots import new_figure, png_bytes
from pdhef_logtool.records.shown import shown

_COLOURS = {"kept": "#009E73", "undone": "#D55E00", "not done": "0.6"}


def page_markdown(document: Mapping[str, Any]) -> str:
    """Return the record of ``pdhef learn`` as Markdown; angles in degrees."""
    lines = [f"# What was learnt of {_text(document['car_name'])}", "", "![steps and last part](learn.png)", ""]
    lines += _parts(document)
    lines += ["## Steps", ""]
    lines += [
        "Before and after are sideslip RMSE in degrees on the part *check*. A step that makes it worse is undone.",
        "",
    ]
    lines += _table(
        ("step", "came to", "before", "after", "evidence"),
        ([s["name"], s["status"], _figure(s["before"]), _figure(s["after"]), s["text"]] for s in document["steps"]),
    )
    physics = [s for s in document["steps"] if "physics_parameters" in s["figures"]]
    lines += [line for step in physics for line in _physics(step["figures"])]
    lines += ["## The last part, scored once at the end", ""]
    if document["looks"] > 1:
        lines += [f"Some of it was scored {document['looks']} times by now, in calls with this output: be wary.", ""]
    lines += _scores(document["last"]) if document["last"] else ["Nothing was held out.", ""]
    lines += ["## The same on the part *check*, which decided on the steps", "", *_scores(document["check"])]
    lines += ["## What more driving would pay", ""]
    lines += [f"- {_text(text)}" for text in document["more"]] or ["- nothing is known to be missing"]
    lines += ["", "Versions: " + ", ".join(f"{k} {v}" for k, v in sorted(document["versions"].items()))]
    return "\n".join(lines) + "\n"


def _parts(document: Mapping[str, Any]) -> list[str]:
    told = {
        "fit": "sensors, parameters and noise; parts of the model, by folds of its own",
        "network": "trains the network; without it the part fit does",
        "check": "says whether a step stays; trust; intervals",
        "last": "scored once, at the end",
    }
    rows = []
    for name, part in document["parts"].items():
        rows.append([name, f"{part['usable_s']:.0f}", told[name], ", ".join(part["slices"]) or "–"])
    return ["## Parts", "", *_table(("part", "usable seconds", "for", "slices"), rows)]


def _physics(figures: Mapping[str, Any]) -> list[str]:
    """Return the tables of the parameters that were fitted and of the parts that were tried."""
    rows = []
    for p in figures["physics_parameters"]:
        known = "" if p["excited"] else "hardly more than the prior"
        interval = f"{p['low95']:.4g} to {p['high95']:.4g}"
        rows.append([p["name"], f"{p['value']:.5g}", interval, f"{p['prior']:.4g}", p["unit"], known])
    lines = ["## Physics", "", *_table(("parameter", "value", "95 %", "prior", "unit", "the drives say"), rows)]
    tried = figures["physics"].get("tried", ())
    if tried:
        lines += [
            "Parts of the model, each tried on two halves of the fit part, where one is fitted and the other scored:"
        ]
        cells = (
            [", ".join(t["parts"]) or "none", *(f"{x:.3f}" for x in t["held_out_deg"]), "taken" if t["taken"] else ""]
            for t in tried
        )
        lines += ["", *_table(("parts", "first half °", "second half °", ""), cells)]
    return lines


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
    heads = ("estimator", "sideslip RMSE °", "of the stamps", "inside 95 %", "minus that of pd-hef, learnt °")
    return [*_table(heads, rows), "In brackets: 95 % interval of a bootstrap of 10 s blocks.", ""]


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(_text(cell) for cell in row) + " |" for row in rows]
    return ["| " + " | ".join(heads) + " |", "| " + " | ".join("---" for _ in heads) + " |", *body, ""]


def _text(value: str) -> str:
    """Return a text from outside as a cell of a table can hold it."""
    return shown(value).replace("|", "\\|")


def _figure(found: Sequence[Any] | None) -> str:
    return "–" if found is None else f"{found[0]}: {found[1]:.3f}"


def _interval(found: Sequence[float | None], sign: str = "") -> str:
    value, low, high = found
    if value is None:
        return "–"
    return f"{value:{sign}.3f}" if low is None else f"{value:{sign}.3f} [{low:.3f}, {high:.3f}]"


def draw_page(document: Mapping[str, Any]) -> bytes:
    """Return the plot as PNG: held-out error after each step, and the last part (else *check*) by estimator."""
    figure = new_figure(11.0, 4.5)
    left, right = figure.subplots(1, 2, width_ratios=[2, 3])
    steps = [s for s in document["steps"] if s["after"] is not None]
    for row, step in enumerate(steps):
        left.plot([step["before"][1], step["after"][1]], [row, row], color="0.8", lw=4, zorder=1)
        left.plot(step["before"][1], row, "o", mfc="white", color="0.4")
        left.plot(step["after"][1], row, "o", color=_COLOURS[step["status"]])
    left.set_yticks(range(len(steps)), [f"{s['name']} ({s['status']})" for s in steps])
    left.invert_yaxis()
    left.set(xlabel="sideslip RMSE (°), before (open) and after", title="held out: check")
    left.grid(alpha=0.3, axis="x")
    part = "last" if document["last"] else "check"
    lines = [x for x in document[part] if "skipped" not in x and x["rmse_deg"][0] is not None]
    for row, line in enumerate(lines):
        value, low, high = line["rmse_deg"]
        right.barh(row, value, color="#0072B2" if "learnt" in line["name"] else "0.7")
        if low is not None:
            right.plot([low, high], [row, row], color="0.2", lw=1.5)
        right.text(value, row, f" {value:.3f}", va="bottom", fontsize=8)
    right.set_yticks(range(len(lines)), [x["name"] for x in lines])
    right.invert_yaxis()
    right.set(xlabel="sideslip RMSE (°), 95 % interval", title="scored once: last" if part == "last" else "check")
    right.grid(alpha=0.3, axis="x")
    return png_bytes(figure)
