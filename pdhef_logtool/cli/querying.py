"""``pdhef query``: SQL on the tables of runs."""

from __future__ import annotations

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.printable import printable


@options.command()
def query(runs: list[str], sql: str, *, csv: bool = False) -> None:
    """Ask about the drives of one or more runs, in SQL."""
    from pdhef_logtool.results import querying

    rows = querying.query(runs, sql)
    if csv or console.as_json:
        print(rows.write_csv() if csv else rows.write_json())  # noqa: T201
        return
    made = console.table(
        *(f"{'>' * kind.is_numeric()}{name}" for name, kind in rows.schema.items()), fold=len(rows.columns)
    )
    for row in rows.iter_rows():
        made.add_row(*("-" if x is None else f"{x:.4g}" if isinstance(x, float) else printable(str(x)) for x in row))
    console.stdout().print(made)
