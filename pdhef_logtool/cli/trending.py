"""``pdhef trend``: one figure over several runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument

from pdhef_logtool.cli import console, options, panels
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.results.trend import Trend

commands = typer.Typer()


@options.command(
    commands,
    "pdhef trend week1 week2 week3",
    "pdhef trend runs/* --max-regression 5%",
    "pdhef trend week1 week2 week3 --estimator physics --json",
    panel=panels.READ,
    notes="Runs are compared drive by drive with the run before and with the first run. Marks are corrected for their "
    "number (Holm). A regression does not change the exit code: pdhef compare is the gate.",
)
def trend(
    runs: Annotated[list[str], Argument(metavar="RUN", help="Outputs of runs, the oldest first: folders or URLs.")],
    *,
    max_regression: options.MaxRegression = None,
    estimator: options.ComparedEstimator = None,
    metric: options.ComparedMetric = None,
    cluster: options.Cluster = None,
    as_json: options.JsonFlag = False,
) -> None:
    """Compare the sideslip error of several runs, one row per run, and mark regressions."""
    from pdhef_logtool.cli.comparing import figure_asked
    from pdhef_logtool.results.opened_run import open_run
    from pdhef_logtool.results.trend import trend_of

    if len(runs) < 2:
        raise UsageError(expected="two runs or more", got=str(len(runs)), where="RUN")
    figure = figure_asked(max_regression, estimator, metric)
    console.finish(trend_of([open_run(run) for run in runs], figure, cluster), _render, as_json)


def _render(result: Trend, out: Console) -> None:
    from pdhef_logtool.results.comparison_words import change_text
    from pdhef_logtool.results.trend import mark, shown_median

    count, what = len(result.regressions), f"of {result.figure.short} in {len(result.rows)} runs"
    pairs = [
        (result.rows[number - 1 if "previous" in row.regression else 0].run, row.run)
        for number, row in enumerate(result.rows)
        if row.regression
    ]
    higher = any(c and c.change.median > 0.0 for row in result.rows for c in (row.previous, row.first))
    otherwise = "more common drives would show whether an increase is real" if higher else "nothing is needed"
    accepted = f", increases up to {100.0 * result.figure.limit:g} % are accepted" if result.figure.limit else ""
    out.print(
        console.three_lines(
            f"{count or 'no'} significant regression{'s' * (count > 1)} {what}",
            f"the order is that of time; sign test over common drives, Holm's correction{accepted}",
            "pdhef compare {} {}".format(*pairs[0]) if pairs else otherwise,
        )
    )
    out.print()
    table = console.table(
        "run", ">logs", ">failed", ">scored", ">median", ">change to the previous run", ">to the first run", "", fold=1
    )
    for number, row in enumerate(result.rows):
        changes = ["-", "-"] if number == 0 else [change_text(row.previous), change_text(row.first)]
        table.add_row(
            row.run, str(row.logs), str(row.failed), str(row.scored), shown_median(row), *changes, mark(row),
            style="bold" if row.regression else None,
        )  # fmt: skip
    out.print(table)
    out.print("Median over all scored drives of a run; changes are medians over common drives, with 95 % CI.")
    for row in result.regressions:
        out.print(f"\n{row.run}: {mark(row)}", style="bold")
        for line in row.differences or ("nothing else differs from the run before",):
            console.print_indented(line, out)
