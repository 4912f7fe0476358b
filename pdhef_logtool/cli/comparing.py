"""``pdhef compare``, ``events`` and ``query``: differences between runs, events within one, SQL on their tables."""

import re
from pathlib import Path

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.printable import printable

#: Time around events: repeated crossings of a threshold are one event; a clip shows the time before and after.
_PAD_S, _CLIP_PAD_S = 0.25, 5.0


@options.command()
def compare(
    runs: list[str],
    *,
    plan: Path | None = None,
    max_regression: str | None = None,
    estimator: str | None = None,
    metric: str | None = None,
    cluster: str | None = None,
    allow_unpaired: bool = False,
    strict: bool = False,
    html: Path | None = None,
    junit: Path | None = None,
) -> None:
    """Compare two runs drive by drive: better, worse, or no significant difference; more runs as a history."""
    from pdhef_logtool.results import comparing
    from pdhef_logtool.storage.files import write_bytes
    from pdhef_logtool.storage.object_store import is_url
    from pdhef_logtool.storage.outputs import check_no_input

    if len(runs) < 2:
        raise UsageError(expected="two runs or more", got="one", where="pdhef compare", remedy="pdhef compare A B")
    folders = [Path(run) for run in runs if not is_url(run)]
    check_no_input([*folders, plan], [file for file in (html, junit) if file is not None])
    comparison = comparing.compare(
        *runs,
        plan=plan, max_regression=max_regression, estimator=estimator, metric=metric, cluster=cluster,
        allow_unpaired=allow_unpaired, strict=strict,
    )  # fmt: skip
    if junit is not None:
        write_bytes(junit, comparing.comparison_junit(comparison))
    if html is not None:
        from pdhef_logtool.reports.comparison import comparison_page

        write_bytes(html, comparison_page(comparison))
    console.finish(comparison, "comparison", comparing=comparing)


@options.command()
def events(
    output: str,
    *,
    where: str,
    least: str = "0s",
    pad: str | None = None,
    estimator: str | None = None,
    clip: bool = False,
    source: Path | None = None,
) -> None:
    """Find the times at which a condition is true, and cut clips there."""
    from pdhef_logtool.results.events import event_condition, find_events
    from pdhef_logtool.results.opened_run import open_run
    from pdhef_logtool.storage.object_store import is_url

    condition = event_condition(where)
    least_s = _seconds(least, "--for")
    pad_s = (_CLIP_PAD_S if clip else _PAD_S) if pad is None else _seconds(pad, "--pad")
    if source is not None and not clip:
        raise UsageError(expected="--clip", got="--source alone", where="--source")
    if is_url(output) and clip:
        options.local_folder(output)
    run = open_run(output)
    events_found = find_events(run, condition, estimator=estimator, least_s=least_s, pad_s=pad_s, tell=console.warn)
    if clip:
        from pdhef_logtool.results.clips import write_clips

        named = {r.track for r in condition.references.values() if r.track is not None}
        named |= set() if estimator is None else {estimator}
        events_found = write_clips(run, events_found, pad_s=pad_s, named=named, source=source, tell=console.warn)
    console.finish(events_found, "events")


def _seconds(text: str, option: str) -> float:
    """Return the seconds of ``5s``, ``500ms`` or ``5``; raises UsageError."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(ms|s)?\s*", text, re.ASCII)
    if match is None or float(match[1]) > 1e6:
        raise UsageError(expected="a time such as 5s", got=text, where=option)
    return float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)


@options.command()
def query(runs: list[str], sql: str, *, csv: bool = False) -> None:
    """Ask about the drives of one or more runs, in SQL."""
    from pdhef_logtool.results import querying

    rows = querying.query(runs, sql)
    if csv or console.as_json:
        print(rows.write_csv() if csv else rows.write_json())  # noqa: T201
        return

    def text(value: object) -> str:
        return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else printable(str(value))

    heads = [f"<{'>' * kind.is_numeric()}{console.protected(name)}" for name, kind in rows.schema.items()]
    texts, out = (map(text, row) for row in rows.iter_rows()), console.stdout()
    if sum(len(name) + 2 for name in rows.columns) <= out.width:
        out.print(console.table(*heads, rows=texts))
        return
    for row in texts:  # too many columns: a line each
        out.print(console.named_lines(zip(rows.columns, row, strict=True)), "")
