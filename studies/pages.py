"""Shared by the pages: paths of the repository, numbers, templates and filled blocks, options of the commands.

The sentences and tables of a page are in the Markdown template beside its module: a whole page, or the blocks of a page
of the documentation (:func:`blocks`).
"""

import argparse
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import Fit, LearntOn
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.storage import templates
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.toml_text import toml_text

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
RESULTS = ROOT / "studies" / "results"
SAMPLE_VEHICLE = ROOT / "sample_logs" / "vehicle.toml"
#: Recorded drives and runs of another simulator, which may not be redistributed: beside the repository, or nowhere.
DRIVES = ROOT.parent / "shared" / "data" / "drives"
INDEPENDENT = ROOT.parent / "shared" / "data" / "independent_sim"


def number(value: float, digits: int = 3) -> str:
    """Format a figure; a non-finite value is a dash."""
    return "–" if not math.isfinite(value) else f"{value:.{digits}f}"


def fill(page: str, blocks: Mapping[str, str], where: str) -> str:
    """Put blocks between their comments ``<!-- begin NAME -->`` and ``<!-- end NAME -->``; no place is an error."""
    for name, text in blocks.items():
        before, *places = re.split(rf"(?s)(?<=<!-- begin {name} -->\n).*?(?=<!-- end {name} -->)", page)
        if len(places) != 1:
            raise SystemExit(f"{where}: expected one place for {name}")
        page = f"{before}{text}\n{places[0]}"
    return page


def template(module: str | Path, **context: object) -> str:
    """Render the Markdown template beside a module (its ``__file__``)."""
    return templates.template(Path(module).with_suffix(".md"), number=number).render(context)


def blocks(module: str, **context: object) -> dict[str, str]:
    """Render the Markdown template beside a module; return the blocks between comments as of :func:`fill`."""
    found = re.findall(r"<!-- begin (\w+) -->\n(.*?)<!-- end \1 -->", template(module, **context), re.DOTALL)
    return {name: text.strip("\n") for name, text in found}


def update(folder: Path, name: str, blocks: Mapping[str, str]) -> None:
    """Put new blocks into a page of the documentation, or README.md, whose other text is written by hand.

    ``folder`` : where the page is written if it is not ``docs`` itself.
    """
    page = (ROOT if name == "README.md" else DOCS) / name
    target = page if folder == DOCS else folder / name
    write(target, fill(page.read_text(encoding="utf-8"), blocks, name))


def write(path: Path, text: str) -> None:
    """Write a file atomically and print its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())
    print(path)


def read_json(path: Path) -> Any:
    """Return the document of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def paragraphs(path: Path) -> Iterator[list[str]]:
    """Yield the lines of each paragraph of a text file; lines that begin with # are comments."""
    text = re.sub(r"(?m)^#.*\n", "", path.read_text(encoding="utf-8"))
    yield from map(str.splitlines, re.split(r"\n\n+", text.strip()))


def write_json(path: Path, document: object) -> None:
    """Write a document as JSON."""
    write(path, json.dumps(document, indent=1) + "\n")


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file as a document."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def write_toml(path: Path, document: Mapping[str, Any]) -> Path:
    """Write a document as TOML and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(toml_text(document), encoding="utf-8")
    return path


def write_validated_car(folder: Path, vehicle: Mapping[str, Any]) -> Path:
    """Write a car that counts as validated, so that runs use its vehicle file unchanged; return the folder."""
    digest = Car.load(write_toml(folder / "vehicle.toml", vehicle)).physics_sha256
    fit = Fit(physics_sha256=digest, drives=(LearntOn(name="of the study"),))
    write(folder / "fit.toml", part_toml(fit, "No parameter is fitted."))
    return folder


def options(name: str, text: str | None, usual: str = "", **numbers: float) -> argparse.ArgumentParser:
    """Return the parser of ``python -m studies.NAME``; ``text``, which describes its options, is its module's.

    Parameters
    ----------
    usual : names of usual options. numbers : further options with their defaults.
    """
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog=f"python -m studies.{name}", description=text, formatter_class=shape)
    known: dict[str, dict[str, Any]] = {
        "work": {"type": Path, "default": ROOT / "out" / name, "help": "folder of logs and runs"},
        "out": {"type": Path, "default": DOCS, "help": "folder of the page"},
        "results": {"type": Path, "default": RESULTS / name, "help": "folder of the results"},
        "stored": {"action": "store_true", "help": "write the page of the stored results"},
    }
    known |= {option: {"type": type(default), "default": default} for option, default in numbers.items()}
    for option in (*usual.split(), *numbers):
        parser.add_argument(f"--{option.replace('_', '-')}", **known[option])
    return parser


#: Usual options of a study with stored results and a page.
OF_PAGES = "work out results stored"
