"""Equations of the documentation as MathML, which browsers render without a script or a font: a hook of MkDocs.

In a page, ``$…$`` is LaTeX within a line and ``$$…$$`` an equation in a separate paragraph. Code stays as it is.
"""

import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

#: Fenced code blocks and code spans, which stay, and equations. An inline dollar touches its formula, as in Pandoc.
_PATTERN = re.compile(
    r"^(?P<fence> *(?:```+|~~~+)).*?^(?P=fence)[ \t]*$"
    r"|(?P<tick>`+)(?!`).*?(?<!`)(?P=tick)(?!`)"
    r"|\$\$(?P<block>[^$]+)\$\$"
    r"|(?<![\\\w$])\$(?=[^\s$])(?P<inline>[^$\n]*[^\s$\\])\$(?!\w)",
    re.MULTILINE | re.DOTALL,
)
#: Placeholder of an equation in a page until the page is HTML: Markdown must not read the equation.
_PLACEHOLDER = "\ue000{}\ue001"
_equations: list[str] = []
#: Name of a function before an argument without brackets: MathML needs a space here.
_FUNCTION = re.compile(r"(<mi>(?:sin|cos|tan|arctan|ln)</mi>)(?=<m(?!o|row><mo))")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page with a placeholder in place of each equation; raises PluginError for one that is not understood."""
    _equations.clear()
    return _PATTERN.sub(_replacement, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Return the page's HTML with the equations in place of the placeholders."""
    return re.sub(_PLACEHOLDER.format(r"(\d+)"), lambda match: _equations[int(match[1])], html)


def mathml(latex: str, *, block: bool = False) -> str:
    """Return an equation as MathML.

    Raises
    ------
    PluginError
        A command is not supported by the converter, or the braces do not match.
    """
    try:
        markup = convert(latex, display="block" if block else "inline")
    except Exception as error:  # of many types, none of which is documented
        raise PluginError(f"equation not understood: {latex} ({error!r})") from error
    bare = re.sub(r"\\[{}]", "", latex)
    sides = [len(re.findall(rf"\\{side}(?![a-z])", latex)) for side in ("left", "right")]
    is_balanced = bare.count("{") == bare.count("}") and sides[0] == sides[1]
    # Leftovers of the converter: unknown commands, and alignments, for which it has no markup.
    if "\\" in markup or "&<" in markup or not is_balanced:
        raise PluginError(f"equation not understood: {latex}")
    markup = _FUNCTION.sub(r"\1<mspace width='0.167em'/>", markup)
    return markup.replace("<mo>&#x0007C;</mo>", "<mo lspace='0' rspace='0'>&#x0007C;</mo>")


def _replacement(match: re.Match[str]) -> str:
    latex = match["block"] or match["inline"]
    if latex is None:
        return match[0]
    _equations.append(mathml(latex.strip(), block=match["block"] is not None))
    return _PLACEHOLDER.format(len(_equations) - 1)
