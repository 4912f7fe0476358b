"""The estimator in the docstring of ``estimators/table.py`` as a separate installed package with an entry point."""

from pathlib import Path
from textwrap import dedent

from pdhef_logtool.estimators import table


def example_code() -> str:
    """Return the estimator as the docstring shows it."""
    return dedent((table.__doc__ or "").partition("Example::\n")[2])


def install(
    folder: Path, code: str, name: str = "half_slip", group: str = "pdhef.estimators", of: str = "SPEC"
) -> Path:
    """Write a distribution with one module and an entry point to its ``of``; return the folder for ``sys.path``."""
    (folder / f"{name}.py").write_text(code, encoding="utf-8")
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {name}:{of}\n", encoding="utf-8")
    return folder
