"""Check the texts for users and developers for retired terms: ``make lint`` runs it.

    python tests/language_check.py [--list AREA] [--lower]

Areas: documentation (pages written by hand), help (texts of the command line), messages (other literals with a space,
HTML templates), comments (with docstrings), names (of variables and parameters). An area fails with more hits than
``language_limits.json`` allows; ``--lower`` lowers the limits to the present counts. Code spans, code blocks,
names with an underscore, which are contracts of files and commands, and names of parameters in docstrings do not count.
"""

import argparse
import ast
import io
import json
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIMITS = Path(__file__).with_name("language_limits.json")
AREAS = ("documentation", "help", "messages", "comments", "names")
#: Retired phrase (a regular expression, whole words, any case), and what to write instead.
PHRASES = {
    r"(?<!ground )(?<!ground-)(?<!')truth(?! channel|\.\w|\])": "ground truth",
    r"the answer|main (estimator|estimate|one)": "selected estimate",
    r"bands?": "confidence interval",
    r"(?<!order )holds?": "contains, coverage, limits ...",
    r"guard(s|ed)?|distrust(s|ed)?|stands? in|stand-ins?|stand-in": "estimator selection, fallback estimator",
    r"d2": "lateral kinematic consistency",
    r"nis over dof|nis dof|nis / dof": "normalized innovation squared, expected value 1",
    r"(the|a|its|their|of) carry|belief": "filter state, inputs at step k",
    r"filter shell|the shell|one shell": "filter base",
    r"watch(es|ed)?": "monitor",
    r"trust(s|ed)?|trust cap": "residual gain, gain limit",
    r"proven|learnt|catalogue": "validated, trained, datasheet parameters",
    r"reckoned speed|believ(e|es|ed|able|ing)": "wheel-slip-gated speed, accepted",
    r"slim logs?|far logs?|strangers?": "reduced, remote, third-party log",
    r"torture": "fuzz and fault-injection tests",
    r"occupied|strays?": "recording span, outlier stamps",
    r"budgets?(?!=)": "resource limits, error decomposition",
    r"looks": "number of evaluations",
    r"(fit|check|last) part": "training, validation, test split",
    r"roles?": "split assignment",
    r"nameless": "unlabelled",
    r"tells?|told": "given, reported, stated",
    r"anew": "again, regenerated",
    r"nearer|farther( off)?": "lower, higher error",
    r"stands?|says?|said|rests? on|knows?": "is, states, depends on",
    r"whoever|that which|of which": "a full sentence",
    r"whatever": "any",
}
RETIRED = {
    re.compile(rf"(?<![\w/.-])(?:{phrase})(?![\w/-])", re.IGNORECASE): better for phrase, better in PHRASES.items()
}
NAMES = frozenset({"found", "known", "told", "own", "one", "at"})
#: Pages that a command writes: they follow when its texts change.
GENERATED = re.compile(r"^Written by|<!-- generated|^Command: `", re.MULTILINE)


class Hit(NamedTuple):
    """A retired term, its place, and its replacement."""

    area: str
    place: str
    text: str
    better: str


def in_text(area: str, place: str, text: str) -> Iterator[Hit]:
    """Yield the retired phrases of a text."""
    text = re.sub(r"\s+", " ", text)
    code = r"`+[^`]*`+|https?://\S+|\b(docs|pdhef_logtool|studies)/\S+|\bpdhef [a-z]+|<\w[^>]*>|\b\w+(, \w+)* : "
    text = re.sub(code, " ", text)
    for pattern, better in RETIRED.items():
        for match in pattern.finditer(text):
            around = text[max(match.start() - 40, 0) : match.end() + 40].replace("\n", " ")
            yield Hit(area, place, around, better)


def pages(root: Path) -> Iterator[Hit]:
    """Yield the retired terms of hand-written pages."""
    for path in (root / "README.md", root / "ARCHITECTURE.md", *sorted((root / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        if GENERATED.search(text[:600]):
            continue
        prose = re.sub(r"^( *)(```+).*?^\1\2|\]\([^)]*\)|\$\$?[^$]+\$\$?", "", text, flags=re.MULTILINE | re.DOTALL)
        yield from in_text("documentation", path.relative_to(root).as_posix(), prose)


def templates(root: Path) -> Iterator[Hit]:
    """Yield the retired terms of page templates outside tags."""
    for path in sorted((root / "pdhef_logtool/reports/templates").glob("*.html")):
        text = re.sub(r"{[%{#].*?[%}#]}|<[^>]*>", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        yield from in_text("messages", path.relative_to(root).as_posix(), text)


def code(path: Path, place: str) -> Iterator[Hit]:
    """Yield the retired terms in literals, comments and names of a module."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    area = "help" if "/cli/" in place else "messages"
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings: dict[int, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr):
            value = node.body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                is_command = area == "help" and isinstance(node, ast.FunctionDef) and bool(node.decorator_list)
                docstrings[id(value)] = "help" if is_command else "comments"
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            yield from in_text(docstrings.get(id(node), area), f"{place}:{node.lineno}", node.value)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in NAMES:
            yield Hit("names", f"{place}:{node.lineno}", node.id, "a name that says the thing")
        elif isinstance(node, ast.arg) and node.arg in NAMES:
            yield Hit("names", f"{place}:{node.lineno}", node.arg, "a name that says the thing")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield from in_text("comments", f"{place}:{token.start[0]}", token.string)


def hits(root: Path) -> Iterator[Hit]:
    """Yield all retired terms of the repository."""
    yield from pages(root)
    yield from templates(root)
    for path in sorted((root / "pdhef_logtool").rglob("*.py")):
        yield from code(path, path.relative_to(root).as_posix())


def main() -> int:
    """Return 0 where no area has more hits than its limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", choices=AREAS, help="print the hits of an area")
    parser.add_argument("--lower", action="store_true", help="write the present counts where they are smaller")
    given = parser.parse_args()
    found_hits = list(hits(ROOT))
    for hit in found_hits:
        if hit.area == given.list:
            sys.stdout.write(f"{hit.place}: …{hit.text}… ({hit.better})\n")
    counts = Counter(hit.area for hit in found_hits)
    limits = json.loads(LIMITS.read_text(encoding="utf-8"))
    if given.lower:
        limits = {area: min(limits[area], counts[area]) for area in AREAS}
        LIMITS.write_text(json.dumps(limits, indent=2) + "\n", encoding="utf-8")
    for area in AREAS:
        verdict = f"; more than the limit, see --list {area}" if counts[area] > limits[area] else ""
        sys.stdout.write(f"language, {area}: {counts[area]} retired terms, limit {limits[area]}{verdict}\n")
    return int(any(counts[area] > limits[area] for area in AREAS))


if __name__ == "__main__":
    sys.exit(main())
