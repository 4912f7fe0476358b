"""References from sources and documentation to the documentation resolve, and the glossary stays short."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pdhef_logtool", "truthsim", "studies", "tests", "benchmarks", "docs", "schemas")
GLOSSARY_TERMS = 40


def texts(*patterns: str) -> Iterator[tuple[str, str]]:
    """Yield path and text of files of the repository."""
    for pattern in patterns:
        for path in (*ROOT.glob(pattern), *(p for folder in FOLDERS for p in (ROOT / folder).rglob(pattern))):
            yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")


@cache
def anchors(page: str) -> frozenset[str]:
    """Return the anchors of a page of docs/, made of its headings or given as ``{#anchor}``."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    text = re.sub(r"^( *)(```+).*?^\1\2", "", text, flags=re.MULTILINE | re.DOTALL)
    named = set(re.findall(r"\{#([\w-]+)\}", text))
    for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        named.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", words).strip().lower()))
    return frozenset(named)


def broken(references: Iterator[tuple[str, str, str]]) -> list[str]:
    """Return the broken links as (where, page, anchor)."""
    return [
        f"{where}: {page}#{anchor}"
        for where, page, anchor in references
        if not (ROOT / "docs" / page).is_file() or (anchor and anchor not in anchors(page))
    ]


def test_references_in_sources_resolve():
    references = [
        (where, page, anchor)
        for where, text in texts("*.py", "*.md", "*.schema.json")
        for page, anchor in re.findall(r"\bdocs/([\w/]+\.md)#([\w-]+)", text)
    ]
    assert len(references) > 50
    assert not broken(iter(references))


def test_links_between_pages_resolve():
    links = [
        (where, page or Path(where).name, anchor)
        for where, text in texts("*.md")
        if where.startswith("docs/") and where.count("/") == 1
        for page, anchor in re.findall(r"\]\(([\w/]*(?:\.md)?)#([\w-]+)\)", text)
    ]
    assert len(links) > 20
    assert not broken(iter(links))


def test_the_glossary_is_short_sorted_and_has_sources():
    page = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:2] == "| "]
    terms = rows[2:]
    assert 20 < len(terms) <= GLOSSARY_TERMS
    assert [row[0] for row in terms] == sorted((row[0] for row in terms), key=str.lower)
    assert all(len(row) == 3 and row[1].endswith(".") and row[2] for row in terms)


def test_equations_become_mathml_and_code_stays():
    pytest.importorskip("latex2mathml")
    pytest.importorskip("mkdocs")
    from studies import mathml

    code = "```\n$a$ and $$b$$\n```\nA span `$c$` and 5 $ or $HOME.\n"
    page = mathml.on_page_markdown(code + "Inline $v_x$.\n\n$$\\frac{1}{2}$$\n")
    assert page.startswith(code)
    html = mathml.on_page_content(page)
    assert html.count("<math ") == 2
    assert 'display="block"' in html
    assert "$v_x$" not in html


@pytest.mark.parametrize("wrong", [r"\nosuchcommand x", r"\frac{1", r"\begin{aligned}a&=b\end{aligned}"])
def test_an_equation_that_is_not_understood_is_an_error(wrong):
    pytest.importorskip("latex2mathml")
    errors = pytest.importorskip("mkdocs.exceptions")
    from studies.mathml import mathml

    with pytest.raises(errors.PluginError, match="equation not understood"):
        mathml(wrong)


PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
HEADS = re.findall(r"^\*\*(.*)\*\*$", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def sources():
    """All of the package with texts that stand in several literals joined to one."""
    package = ROOT / "pdhef_logtool"
    files = (p for kind in ("*.py", "templates/*.txt") for p in sorted(package.rglob(kind)))
    text = "\n".join(p.read_text(encoding="utf-8") for p in files)
    return re.sub(r"[\"']\s*\n\s*f?[\"']", "", text)


def test_the_page_has_what_people_meet_most():
    assert len(HEADS) > 15


@pytest.mark.parametrize("head", HEADS)
def test_a_quoted_message_is_one_of_ours(head, sources):
    for quoted in re.findall("`([^`]*)`", head):
        for words in quoted.split("…"):
            assert words.strip().removeprefix("expected ").strip(" ,:") in sources
