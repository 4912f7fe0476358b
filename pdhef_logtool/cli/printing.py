"""Terminal output from the templates of ``templates/``, in the markup of Rich."""

from __future__ import annotations

import math
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from pdhef_logtool.cli.console import BREAK, cell, named_lines, print_indented, table
from pdhef_logtool.evaluation.requirement_verdicts import joint_notes, next_steps
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.logs.recording_span import shown_time
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.printable import listed
from pdhef_logtool.records.signals import is_dated
from pdhef_logtool.results.run_report import lines_of
from pdhef_logtool.results.selected_estimate import assumptions_of, degrees, figures_of, is_worse, result_of
from pdhef_logtool.runs.inspection.report import number_text
from pdhef_logtool.storage.templates import environment

#: Styles of the outcomes of requirements.
_STYLES = {"PASS": "green", "FAIL": "bold red", "INCONCLUSIVE": "dim"}
#: Functions and constants of all templates.
_OF_RESULTS = assumptions_of, degrees, figures_of, is_worse, lines_of, joint_notes, next_steps, result_of
_FUNCTIONS = *_OF_RESULTS, cell, gathered, is_dated, listed, math.expm1, math.isfinite, read_unit, shown, shown_time
_NAMED = {"BREAK": BREAK, "DEGREES": DEGREES, "STYLES": _STYLES, "number": number_text}


@cache
def _environment() -> Environment:
    made = environment(Path(__file__).parent / "templates")
    made.finalize = lambda value: escape(str(value))
    made.globals |= {function.__name__: function for function in _FUNCTIONS} | _NAMED
    return made


def print_template(name: str, console: Console, **fields: Any) -> None:
    """Print ``templates/NAME.txt`` with its fields, whose brackets are no markup.

    Lines with tabs in succession are a table: its heads (:func:`~.console.table`), then its rows. A line that begins
    with ``==`` is the title of the table below it. Lines that begin with a colon are a name and, after a tab, its text.
    Of other lines, two spaces at the beginning also indent the continuation lines, and a bar prevents a line break.
    """
    text, title = _environment().get_template(f"{name}.txt").render(fields), ""
    for kind, block in groupby(text.split("\n")[:-1], lambda line: ":" if line.startswith(":") else "\t" in line):
        lines = [line.split("\t") for line in block]
        if kind == ":":
            console.print(named_lines([(_text(name[1:]), _text(words)) for name, words in lines]))
        elif kind:
            console.print(table(*lines[0], rows=(map(_text, row) for row in lines[1:]), title=title))
        else:
            for (line,) in lines:
                title = _print_line(line, console)


def _print_line(line: str, console: Console) -> str:
    """Print a line that is not part of a table, or return the title that it is."""
    if line.startswith("=="):
        return line.removeprefix("==").strip()
    if line.startswith("  "):
        print_indented(_text(line[2:]), console)
    else:
        console.print(_text(line.removeprefix("|")), soft_wrap=line.startswith("|"))
    return ""


def _text(markup: str) -> Text:
    return Text.from_markup(markup.replace(BREAK, "\n"), emoji=False)
