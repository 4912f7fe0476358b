"""Packages of others with an entry point."""

from pathlib import Path


def install(folder: Path, code: str, name: str, group: str = "pdhef.estimators", of: str = "SPEC") -> Path:
    """Write a distribution with one module and an entry point to its ``of``; return the folder for ``sys.path``."""
    (folder / f"{name}.py").write_text(code, encoding="utf-8")
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {name}:{of}\n", encoding="utf-8")
    return folder
