"""Questions about the tables of runs, in the SQL of Polars."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

import polars as pl

from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.opened_run import TABLES, open_run


def query(runs: Path | str | Sequence[Path | str], sql: str) -> pl.DataFrame:
    """Return the rows of a statement.

    Parameters
    ----------
    runs : outputs of runs, folders or URLs. The tables of several have a column ``run`` with the argument.
    sql : one statement on the tables of docs/formats.md#tables.

    Raises
    ------
    OutputError : There is no finished run, or a table is damaged.
    UsageError : The statement cannot be executed.
    """
    names = [runs] if isinstance(runs, Path | str) else runs
    opened = {str(name): open_run(name) for name in names}
    frames = {}
    for table in [name for name in TABLES if name in sql.lower()] or TABLES:  # only these are verified
        of_runs = {name: run.table(table) for name, run in opened.items()}
        if len(opened) > 1:
            of_runs = {name: rows.with_columns(run=pl.lit(name)) for name, rows in of_runs.items()}
        frames[table] = pl.concat(of_runs.values())
    try:
        with pl.SQLContext(frames) as context:
            return context.execute(sql, eager=True)
    except (pl.exceptions.PolarsError, OSError) as error:
        got = str(error).partition("\n")[0].partition("; valid columns")[0]
        right = [*TABLES, *(column for rows in frames.values() for column in rows.collect_schema())]
        near = [m for name in re.findall(r"""["']([^"']+)["']""", got) for m in get_close_matches(name, right, n=1)]
        raise UsageError(
            expected=f"a statement on the tables {', '.join(TABLES)}",
            got=f"an error: {got}",
            where="SQL",
            remedy=f"did you mean {near[0]}?" if near else "docs/formats.md lists their columns",
        ) from error
