"""The estimator of ARCHITECTURE.md as a separate installed package with an entry point."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def example_code() -> str:
    """Return the estimator as ARCHITECTURE.md shows it."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return code


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
