"""A network for one car from few drives: trained on some, stopped by others, alone or from a network of many cars."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pdhef_logtool.logs.discovery import Logs
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.runs.config import RunConfig

#: How gently a trained network moves; a network from nothing is a small one, for a minute or two of driving.
GENTLY: dict[str, Any] = {"learning_rate": 5e-4, "epochs": 15}
SMALL: dict[str, Any] = {"hidden": 32, "layers": 1}


def train_on_parts(
    parts: Mapping[str, tuple[Logs, RunConfig]],
    folder: Path,
    init: ModelBundle | None,
    *,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> ModelBundle:
    """Extract the logs of the parts ``train`` and ``validation`` into a folder and train; ``init`` is the start.

    The network is left in ``folder/model``.
    """
    from pdhef_logtool.learning.network.dataset import read_dataset
    from pdhef_logtool.learning.network.extract_command import ExtractSettings, extract
    from pdhef_logtool.learning.network.train_command import make_recipe, train_on

    for split, (logs, config) in parts.items():
        extract(logs, folder / split, ExtractSettings(config, split=split))
    sets = [read_dataset(folder / split) for split in parts]
    both = replace(sets[0], drives=tuple(d for s in sets for d in s.drives))
    recipe = replace(make_recipe(paper=False, seed=0, epochs=None, device="cpu"), **(SMALL if init is None else GENTLY))
    return train_on(both, folder / "model", recipe, init=init, progress=progress).bundle
