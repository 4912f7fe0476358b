"""Output to the user: results on stdout, messages on stderr."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TypeVar

import typer

from pdhef_logtool.cli import stopping
from pdhef_logtool.records import processes
from pdhef_logtool.records.errors import EXIT_OK
from pdhef_logtool.records.printable import all_printable, printable
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.storage.documents import jsonable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text


class _Result(Protocol):
    def to_dict(self) -> dict[str, Any]: ...


_Shown = TypeVar("_Shown", bound=_Result | Mapping[str, Any])
_verbose = False
#: Whether results are printed as JSON.
as_json = False
#: Interval between lines of progress without a terminal, s.
PROGRESS_S = 30.0
#: Line break within a cell of a table; printable texts contain no such character.
BREAK = "\v"
#: Signs with a meaning in templates, as which fields contain private characters until they are printed.
_PROTECTED = str.maketrans({sign: chr(0xE000 + ord(sign)) for sign in "[\\:|="})
_SHOWN = {ord(private): chr(sign) for sign, private in _PROTECTED.items()}
#: A line on stderr is an error or a warning of several parts.
_MOST_SIGNS = 5000


def stdout() -> "Console":
    """Return a console of stdout without markup."""
    from rich.console import Console

    class Piped(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # as print does

    # A pipe has no width: tables have their full width unless COLUMNS limits it.
    return Piped(
        highlight=False,
        markup=False,
        emoji=False,
        width=None if sys.stdout.isatty() or os.environ.get("COLUMNS") else 160,
    )


def protected(value: object) -> str:
    """Return a text with none of the signs that have a meaning in templates; :func:`marked_up` restores them."""
    return str(value).translate(_PROTECTED)


def marked_up(markup: str) -> "Text":
    """Return a text in the markup of Rich."""
    from rich.text import Text

    text = Text.from_markup(markup.replace(BREAK, "\n"), emoji=False)
    text.plain = text.plain.translate(_SHOWN)
    return text


def table(*heads: str, rows: Iterable[Iterable[Any]] = (), title: str = "") -> "Table":
    """Return a table of rows, with rules below its title if it has one.

    Signs before a head, which is in the markup of Rich: ``>`` for a column of numbers, ``<`` to wrap texts instead of
    truncating them, ``!`` to do neither.
    """
    from rich import box
    from rich.table import Table

    made = Table(box=None, header_style="bold")
    if title:
        style: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
        made = Table(title=marked_up(title), title_justify="left", title_style="bold", **style)
    for head in heads:
        text = head.lstrip("<>!")
        signs = head.removesuffix(text)
        made.add_column(
            marked_up(text),
            justify="right" if ">" in signs else "left",
            overflow="fold" if "<" in signs else "ellipsis",
            no_wrap="!" in signs,
        )
    for row in rows:
        made.add_row(*row)
    return made


def named_lines(texts: "Iterable[tuple[str | Text, str | Text]]") -> "Table":
    """Return a line per text, after its name."""
    from rich.table import Table

    lines = Table.grid(padding=(0, 2, 0, 0))
    lines.add_column(no_wrap=True)
    lines.add_column(overflow="fold")
    for name, text in texts:
        lines.add_row(name, text)
    return lines


def cell(value: float | None, factor: float = 1.0, digits: int = 2) -> str:
    """Return a number for a table, or a dash for None."""
    return "-" if value is None else f"{round(value * factor, digits) + 0.0:.{digits}f}"  # no -0


def set_output(*, quiet: bool = False, verbose: bool = False, json: bool = False) -> None:
    """Set the output on stderr, also of workers: errors only (quiet), or also progress as lines (verbose); and JSON."""
    global _verbose, as_json
    processes.quiet, _verbose, as_json = quiet, verbose, json


def error(text: str) -> None:
    """Print a line on stderr, also with ``--quiet``."""
    print(printable(text, _MOST_SIGNS), file=sys.stderr)  # noqa: T201


def say(text: str) -> None:
    """Print a note on stderr, except with ``--quiet``."""
    if not processes.quiet:
        error(text)


def warn(text: str) -> None:
    """Print a warning on stderr, except with ``--quiet``."""
    say(f"warning: {text}")


def has_display() -> bool:
    """Return whether a window can be opened, which may be impossible on Linux only."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def print_json(document: Any) -> None:
    """Print one JSON document with control characters escaped."""
    text = json.dumps(jsonable(document), indent=2, sort_keys=False, ensure_ascii=False, allow_nan=False)
    signs = (c if c.isprintable() or c == "\n" else json.dumps(c)[1:-1] for c in text)
    print(text if text.replace("\n", "").isprintable() else "".join(signs))  # noqa: T201


def show(result: _Shown, output: "Callable[[_Shown, Console], None] | str", **fields: Any) -> None:
    """Print a result as a JSON document, or by a function or a template; it is the template's field ``r``."""
    if as_json:
        print_json(result if isinstance(result, Mapping) else result.to_dict())
    elif isinstance(output, str):
        from pdhef_logtool.cli.printing import print_template

        print_template(output, stdout(), r=all_printable(result), **fields)
    else:
        output(all_printable(result), stdout())


def finish(result: _Shown, output: "Callable[[_Shown, Console], None] | str", **fields: Any) -> NoReturn:
    """Print a result as :func:`show` does, and exit with its exit code or 0."""
    show(result, output, **fields)
    raise typer.Exit(getattr(result, "exit_code", EXIT_OK))


def _progress_lines() -> Callable[[str, float], None]:
    """Return progress as lines: each change with ``--verbose``, otherwise one per :data:`PROGRESS_S`."""
    last, due = "", time.monotonic() + PROGRESS_S

    def update(text: str, share: float) -> None:
        nonlocal last, due
        stopping.check()
        now = time.monotonic()
        if text != last if _verbose else now >= due:
            say(f"{share:4.0%}  {text}")
            last, due = text, now + PROGRESS_S

    return update


@contextmanager
def reporter() -> Iterator[Reporter]:
    """Yield a reporter on stderr, with progress as a bar on a terminal and as lines elsewhere.

    Its progress raises :class:`~.stopping.Stopped` after a request to end.
    """
    if processes.quiet or _verbose or not sys.stderr.isatty():
        yield Reporter(_progress_lines(), warn, say)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def update(text: str, share: float) -> None:
            stopping.check()
            bar.update(task, description=printable(text), completed=share)

        yield Reporter(update, warn, say)
