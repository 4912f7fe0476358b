"""Check for PyTorch, an optional package that only training needs."""

from __future__ import annotations

from importlib.util import find_spec

from pdhef_logtool.records.errors import UsageError


def check_torch(or_else: str = "") -> None:
    """Raise UsageError if PyTorch is not installed; ``or_else`` completes the remedy."""
    if find_spec("torch") is None:
        raise UsageError(
            expected="PyTorch, which trains networks",
            got="an installation without it",
            where="torch",
            remedy=f"pip install 'pdhef-logtool[train]'{or_else}",
        )
