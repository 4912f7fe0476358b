"""``pdhef compare`` and ``events``: whether a run is worse than another, and where in a run something holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.results.gate import Gate

commands = typer.Typer()


@options.command(
    commands,
    "pdhef compare before after",
    "pdhef compare before after --max-regression 5%",
    "pdhef compare before after --gate gate.toml --junit gate.xml --strict",
    "pdhef compare before after --cluster day --html change.html",
    notes="Exit codes: 0 no regression, or nobody can tell; 1 no drive is in both; 3 drives without partner, and no "
    "gate; 4 the gate is closed, or cannot tell with --strict. Without a gate a change alone closes nothing.",
)
def compare(
    a: Annotated[Path, Argument(metavar="A", help="Outputs of the run that is the yardstick.")],
    b: Annotated[Path, Argument(metavar="B", help="Outputs of the run that is held against it.")],
    gate: Annotated[Path | None, Option(metavar="FILE", help="gate.toml: figures with their limits.")] = None,
    max_regression: Annotated[
        str | None, Option(metavar="SHARE", help="Gate of one figure: how much worse it may be, 5% or 0.05.")
    ] = None,
    estimator: Annotated[
        str | None, Option(help="Which estimator on both sides. Default: the main one of A, drive by drive.")
    ] = None,
    metric: Annotated[str | None, Option(help="Which figure of sideslip over the whole drive. Default: rmse.")] = None,
    cluster: Annotated[
        str | None, Option(metavar="KEY", help="car, day or a metadata key: its drives are drawn together.")
    ] = None,
    allow_unpaired: Annotated[
        bool, Option("--allow-unpaired", help="What is on one side only does not close the gate.")
    ] = False,
    strict: Annotated[bool, Option("--strict", help="That nobody can tell closes the gate.")] = False,
    html: Annotated[Path | None, Option(help="Write the comparison as a page.")] = None,
    junit: Annotated[Path | None, Option(help="Write the gate's verdicts as JUnit XML, for CI.")] = None,
    as_json: options.JsonFlag = False,
) -> None:
    """Say whether run B is better or worse than run A. Drives are paired; nobody can tell is an answer."""
    from pdhef_logtool.cli.compare_tables import render_comparison, write_comparison_junit
    from pdhef_logtool.results.comparing import compare_runs
    from pdhef_logtool.results.opened_run import open_run

    asked = _gate(gate, max_regression, estimator, metric, allow_unpaired=allow_unpaired)
    found = compare_runs(open_run(a), open_run(b), asked, cluster=cluster, strict=strict)
    if junit is not None:
        write_comparison_junit(junit, found)
    del html
    console.finish(found, render_comparison, as_json)


def _gate(
    file: Path | None, max_regression: str | None, estimator: str | None, metric: str | None, *, allow_unpaired: bool
) -> Gate:
    """Return the figures that the options ask for; raises UsageError."""
    from pdhef_logtool.results.gate import MAIN, Figure, Gate, figure_problems, load_gate, share_of

    single = {"--max-regression": max_regression, "--estimator": estimator, "--metric": metric}
    given = [name for name, value in single.items() if value is not None]
    if file is not None:
        if given:
            raise UsageError(
                expected="a gate file or figures of the command line", got=f"--gate and {given[0]}", where="--gate"
            )
        gate = load_gate(file)
        return Gate(gate.figures, gate.allow_unpaired or allow_unpaired)
    limit = None if max_regression is None else share_of(max_regression)
    if max_regression is not None and limit is None:
        raise UsageError(expected="a share such as 5% or 0.05", got=max_regression, where="--max-regression")
    figure = Figure(metric=metric or "rmse", estimator=estimator or MAIN, limit=limit)
    if problems := figure_problems(figure.signal, figure.metric, figure.segment):
        raise UsageError(expected="a figure of which less is better", got="; ".join(problems), where="--metric")
    return Gate((figure,), allow_unpaired)
