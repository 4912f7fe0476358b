"""How the pages' pictures are set up and written: small PNGs, the same bytes for the same figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdhef_logtool.storage.files import PendingFile

#: Of the pages with their own look; the condition table has matplotlib's.
STYLE = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "legend.fontsize": 8}


def subplots(
    rows: int, columns: int, width: float, height: float, style: Mapping[str, Any], **options: Any
) -> tuple[Any, Any]:
    """Return a figure of a size in inches and its axes, [rows, columns]; ``style`` applies to all following figures."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(style)
    fig, axes = plt.subplots(rows, columns, figsize=(width, height), squeeze=False, layout="constrained", **options)
    return fig, axes


def save(fig: Any, path: Path) -> None:
    """Write a PNG without a time or a version in it, and let go of the figure."""
    import matplotlib.pyplot as plt

    with PendingFile(path) as pending:
        fig.savefig(pending.path, format="png", dpi=100, metadata={"Software": None})
    plt.close(fig)
