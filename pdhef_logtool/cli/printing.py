"""Terminal output from the templates of ``templates/``, in the markup of Rich."""

from collections.abc import Callable
from functools import cache
from itertools import groupby
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from jinja2 import Environment
from rich.console import Console
from rich.padding import Padding

from pdhef_logtool.cli.console import BREAK, cell, marked_up, named_lines, protected, table
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.storage.templates import environment

#: Styles of the outcomes of requirements.
_STYLES = {"PASS": "green", "FAIL": "bold red", "INCONCLUSIVE": "dim"}
#: Functions of templates in other modules, which are imported at the first call: most commands need few of them.
_HOMES = {
    "math": "expm1 isfinite",
    "pdhef_logtool.evaluation.requirement_verdicts": "joint_notes next_steps",
    "pdhef_logtool.evaluation.statistics": "gathered",
    "pdhef_logtool.evaluation.units": "read_unit",
    "pdhef_logtool.evaluation.validation_plan": "shown",
    "pdhef_logtool.logs.recording_span": "shown_time",
    "pdhef_logtool.records.printable": "listed",
    "pdhef_logtool.records.signals": "is_dated",
    "pdhef_logtool.results.run_report": "lines_of",
    "pdhef_logtool.results.selected_estimate": "assumptions_of degrees figures_of is_worse result_of",
    "pdhef_logtool.runs.inspection.report": "number_text",
}


def _later(home: str) -> Callable[..., Any]:
    """Return a function that is ``module:name``, imported when it is called."""
    return lambda *arguments, **named: resolve_name(home)(*arguments, **named)


@cache
def _environment() -> Environment:
    made = environment(Path(__file__).parent / "templates")
    made.finalize = protected
    made.globals |= {name: _later(f"{module}:{name}") for module, names in _HOMES.items() for name in names.split()}
    made.globals |= {"BREAK": BREAK, "DEGREES": DEGREES, "STYLES": _STYLES, "cell": cell}
    return made


def print_template(name: str, console: Console, **fields: Any) -> None:
    """Print ``templates/NAME.txt`` with its fields, in which no sign has a meaning.

    Lines with tabs in succession are a table: its heads (:func:`~.console.table`), then its rows. A line that begins
    with ``==`` is the title of the table below it. Lines that begin with a colon are a name and, after a tab, its text.
    Of other lines, two spaces at the beginning also indent the continuation lines, and a bar prevents a line break.
    """
    text, title = _environment().get_template(f"{name}.txt").render(fields), ""
    for kind, block in groupby(text.split("\n")[:-1], lambda line: ":" if line.startswith(":") else "\t" in line):
        lines = [line.split("\t") for line in block]
        if kind == ":":
            console.print(named_lines([(marked_up(name[1:]), marked_up(words)) for name, words in lines]))
        elif kind:
            console.print(table(*lines[0], rows=(map(marked_up, row) for row in lines[1:]), title=title))
        else:
            for (line,) in lines:
                title = _print_line(line, console)


def _print_line(line: str, console: Console) -> str:
    """Print a line that is not part of a table, or return the title that it is."""
    if line.startswith("=="):
        return line.removeprefix("==").strip()
    if line.startswith("  "):
        console.print(Padding(marked_up(line[2:]), (0, 0, 0, 2), expand=False))  # also its continuation lines
    else:
        console.print(marked_up(line.removeprefix("|")), soft_wrap=line.startswith("|"))
    return ""
