"""Interface of residual models: from the features of the parallel filter to residual rates (Eq 8–10, 18).

A filter adds gain · rate to v̇_y and ṙ of its sigma points (Eq 19). The features are those of :mod:`~.features`, in
training and in service. Another package adds a model by an entry point of the group :data:`ENTRY_POINTS` that names an
object with this interface; ``--network NAME`` selects it (docs/estimators.md#residual-models). This example has a GRU;
load your weights in ``__init__``. It processes one step at a time, so that its result does not depend on how a drive is
divided into calls::

    # tyre_gru.py, of a package whose pyproject.toml has
    # [project.entry-points."pdhef.residual_models"]
    # tyre-gru = "tyre_gru:MODEL"
    import numpy as np
    import torch

    from pdhef_logtool.residual_model.features import FEATURES
    from pdhef_logtool.residual_model.interface import Residual

    INPUTS = [FEATURES.index(name) for name in ("ay_m_s2", "steer_rad", "yaw_rate_rad_s")]
    INPUT_SCALE, OUTPUT_SCALE = np.array([3.0, 0.05, 0.3]), 0.1


    class Gru:
        sha256 = "tyre-gru 1"

        def __init__(self):
            torch.manual_seed(0)
            self.gru, self.head = torch.nn.GRU(len(INPUTS), 16), torch.nn.Linear(16, 2)

        def residual(self, features, dt_s, state):
            rate = np.zeros((len(features), 2))
            for k, row in enumerate(features[:, INPUTS] / INPUT_SCALE):
                if np.isnan(dt_s[k]) or not np.isfinite(row).all():
                    state = None
                if np.isfinite(row).all():
                    with torch.no_grad():
                        hidden, state = self.gru(torch.tensor(row, dtype=torch.float32)[None], state)
                        rate[k] = OUTPUT_SCALE * self.head(hidden[0]).numpy()
            return Residual(rate, np.ones(len(rate))), state


    MODEL = Gru()
"""

from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any, NamedTuple, Protocol

import numpy as np

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray

ENTRY_POINTS = "pdhef.residual_models"
#: Limits of the rates of v_y and r, m/s² and rad/s².
LIMITS = (4.0, 6.0)


class Residual(NamedTuple):
    """Residual of the model from each step on: rates of v_y and r [K, 2], m/s² and rad/s².

    ``gain`` : [K], 1 inside the region of validity of the model, 0 outside.
    """

    rate: FloatArray
    gain: FloatArray

    @classmethod
    def zero(cls, count: int) -> "Residual":
        """Return no residual for ``count`` steps."""
        return cls(np.zeros((count, 2)), np.zeros(count))


class ResidualModel(Protocol):
    """A model of the residual; ``sha256`` identifies everything that decides its outputs."""

    @property
    def sha256(self) -> str:
        """Digest of the model."""

    def residual(self, features: FloatArray, dt_s: FloatArray, state: Any) -> tuple[Residual, Any]:
        """Return the residual of consecutive steps and the state for the next ones.

        The result must not depend on how the steps are divided into calls, and may not depend on later steps.

        Parameters
        ----------
        features : [K, 15] over :data:`~.features.FEATURES`; a row with NaN has no residual.
        dt_s : [K], duration before each step; NaN where a sequence starts.
        state : of the step before the first; None at the start of a drive.
        """


@dataclass(frozen=True, slots=True, eq=False)
class PlugInModel:
    """A residual model of another package in place of a network."""

    name: str
    plug_in: ResidualModel
    model: str = "physics"
    physics_sha256: str = ""
    pure_lstm: None = None
    linear_regression: None = None
    paper_network: None = None

    @property
    def sha256(self) -> str:
        """Digest of the model."""
        return self.plug_in.sha256


@cache
def plug_in_names() -> tuple[str, ...]:
    """Return the names of the models that installed packages add."""
    return tuple(sorted(entry.name for entry in entry_points(group=ENTRY_POINTS)))


def load_plug_in(name: str) -> PlugInModel:
    """Return the model of an entry point.

    Raises
    ------
    ModelError
        It cannot be loaded, or lacks the interface.
    """
    (entry, *_) = (e for e in entry_points(group=ENTRY_POINTS) if e.name == name)
    where = f"entry point {entry.name} = {entry.value} ({ENTRY_POINTS})"
    expected = "a residual model with sha256 and residual(features, dt_s, state)"
    try:
        loaded = entry.load()
        if not (isinstance(loaded.sha256, str) and callable(loaded.residual)):
            raise TypeError(type(loaded).__name__)
    except (Exception, SystemExit) as error:
        raise ModelError(expected=expected, got=f"{type(error).__name__}: {error}", where=where) from error
    return PlugInModel(name, loaded)


def checked_residual(residual: Any, count: int) -> Residual:
    """Return a model's output within :data:`LIMITS`.

    Raises
    ------
    ValueError
        Its shapes or values are wrong.
    """
    rate, gain = (np.asarray(column, dtype=np.float64) for column in residual)
    if rate.shape != (count, 2) or gain.shape != (count,):
        raise ValueError(f"expected rate [{count}, 2] and gain [{count}], got {rate.shape}, {gain.shape}")
    if not (np.isfinite(rate).all() and np.all((gain >= 0.0) & (gain <= 1.0))):
        raise ValueError("expected finite rates and a gain of 0 to 1, got other values")
    return Residual(np.clip(rate, np.negative(LIMITS), LIMITS), gain)
