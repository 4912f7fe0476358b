"""Jinja templates of texts and files; callers fill their fields."""

import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment, Template


@cache
def environment(folder: Path) -> "Environment":
    """Return the one environment of the templates in a folder; fields of XML and HTML are escaped."""
    from jinja2 import Environment, FileSystemBytecodeCache, FileSystemLoader, StrictUndefined, select_autoescape

    class Kept(FileSystemBytecodeCache):
        """Code of templates, which takes long to compile: beside them, as Python keeps that of modules."""

        def dump_bytecode(self, bucket: Any) -> None:
            with suppress(OSError):  # a full disk, or an installation that cannot be written
                if not sys.dont_write_bytecode:
                    Path(self.directory).mkdir(exist_ok=True)
                    super().dump_bytecode(bucket)

    return Environment(
        loader=FileSystemLoader(folder),
        bytecode_cache=Kept(str(folder / "__pycache__")),
        autoescape=select_autoescape(("xml", "html")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def template(path: Path, **context: Any) -> "Template":
    """Return a template; ``context``: functions and constants that it uses."""
    return environment(path.parent).get_template(path.name, globals=context)


def one_line(text: object) -> str:
    """Return a rendered sentence, which may have several lines in its template, in one line."""
    return " ".join(str(text).split())


def clauses(text: object) -> list[str]:
    """Return the clauses of a rendered text, which have a bar between them, each in one line."""
    return [clause for part in str(text).split("|") if (clause := one_line(part))]


def lines(text: object) -> list[str]:
    """Return the lines of a rendered text that are not empty, without space around them."""
    return [stripped for line in str(text).split("\n") if (stripped := line.strip())]
