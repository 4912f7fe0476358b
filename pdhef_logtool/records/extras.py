"""Optional packages, which an extra of the installation contains."""

from importlib import import_module
from typing import Any

from pdhef_logtool.records.errors import UsageError


def required(module: str, extra: str, use: str, where: object) -> Any:
    """Return a module of an extra; raises UsageError with the command that installs it.

    Parameters
    ----------
    use : purpose of the package, for example ``reads MDF files``.
    where : log, command or option that needs the package.
    """
    try:
        return import_module(module)
    except ImportError:
        raise UsageError(
            expected=f"the package {module.partition('.')[0]}, which {use}",
            got="an installation without it",
            where=where,
            remedy=f"pip install 'pdhef-logtool[{extra}]'",
        ) from None
