"""Linear residual models of increasing order for the rate of v_y, from slow or random features.

Orders: ``none``; ``linear`` in the odd features; ``random`` with additional random Fourier features √2 sin(w·z)
cos(v·e + p) of the odd features z and the even features e (Rahimi and Recht 2007). All are exactly odd: they have no
constant, and a mirrored drive has the mirrored residual. They are fitted by ridge regression (:mod:`~.ladder_fit`).

Region of validity: a gain per step, 1 within the region of the training drives and 0 outside. It depends on the speed
and on the whitened distance d² = zᵀ (Σ + ρ I)⁻¹ z, divided by its 98 % quantile over the training drives.
"""

from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.features import EVEN_COUNT, ODD_COUNT, SPEED_COLUMN, SlowFeatures, slow_features
from pdhef_logtool.residual_model.interface import Residual
from pdhef_logtool.storage.documents import digest

if TYPE_CHECKING:
    from pdhef_logtool.residual_model.ladder_kernels import Basis

NONE, LINEAR, RANDOM = ("none", "linear", "random")
#: Squared distance over its 98 % quantile up to which the gain is 1, and from which it is 0.
FULL_WITHIN, NONE_BEYOND = 1.0, 3.0
#: The same for the speed: factors on its range.
SPEED_FULL, SPEED_NONE = 1.1, 1.5
#: Ridge ρ of the distance, for features of variance 1.
REGION_RIDGE = 0.5
#: A residual is limited to this multiple of the largest one on the training drives.
LARGEST = 1.5

Row = Annotated[tuple[float, ...], Field(strict=False)]
Rows = Annotated[tuple[Row, ...], Field(strict=False)]


class LadderModel(BaseModel):
    """A fitted residual model, as in ``model.toml``.

    Attributes
    ----------
    scale : of the odd features [16]. even_mean, even_scale : of the even features [8].
    odd_directions, even_directions, phases : of the random features, empty for ``linear``.
    weights : by feature, m/s². whitening : d² is the squared norm of its product with z.
    speed_m_s : range of the training drives. largest_m_s2 : largest residual on the training drives.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True, allow_inf_nan=False)

    rung: Literal["linear", "random"]
    scale: Row
    even_mean: Row
    even_scale: Row
    odd_directions: Rows = ()
    even_directions: Rows = ()
    phases: Row = ()
    weights: Row
    whitening: Rows
    speed_m_s: Annotated[tuple[float, float], Field(strict=False)]
    largest_m_s2: Annotated[float, Field(ge=0)]

    @model_validator(mode="after")
    def _one_size(self) -> "LadderModel":
        random, count = len(self.phases), ODD_COUNT + len(self.phases)
        shapes = (
            (self.scale, ODD_COUNT), (self.even_mean, EVEN_COUNT), (self.even_scale, EVEN_COUNT),
            (self.odd_directions, random), (self.even_directions, random), (self.weights, count),
            (self.whitening, ODD_COUNT),
            *((row, ODD_COUNT) for row in (*self.odd_directions, *self.whitening)),
            *((row, EVEN_COUNT) for row in self.even_directions),
        )  # fmt: skip
        if any(len(values) != size for values, size in shapes):
            raise ValueError("the arrays of a residual model do not have the sizes of its features")
        if min(*self.scale, *self.even_scale, self.speed_m_s[0]) <= 0.0:
            raise ValueError("scales and speeds are positive")
        return self

    @property
    def sha256(self) -> str:
        """Digest of all entries."""
        return digest(self.model_dump(mode="json"))

    @cached_property
    def _arrays(self) -> "tuple[Basis, FloatArray, FloatArray]":
        """Basis of the features, weights and whitening."""
        from pdhef_logtool.residual_model.ladder_kernels import Basis

        random = len(self.phases)
        shapes = {"odd_directions": (random, ODD_COUNT), "even_directions": (random, EVEN_COUNT)}
        arrays = {n: np.array(getattr(self, n), dtype=np.float64).reshape(shapes.get(n, -1)) for n in Basis._fields}
        return Basis(**arrays), np.array(self.weights), np.array(self.whitening)

    def residual(self, features: FloatArray, dt_s: FloatArray, state: FloatArray | None) -> tuple[Residual, FloatArray]:
        """Return the residual of consecutive steps (see :class:`~.interface.ResidualModel`)."""
        slow, memory = slow_features(features, dt_s, state)
        return self.evaluate(slow), memory

    def evaluate(self, features: SlowFeatures) -> Residual:
        """Return the residual at each step; rate and gain are 0 where a feature is NaN."""
        from pdhef_logtool.residual_model.ladder_kernels import evaluate

        count = len(features.odd)
        of_vy, distance2 = np.empty(count), np.empty(count)
        evaluate(features.odd, features.even, *self._arrays, of_vy, distance2)
        limit = LARGEST * self.largest_m_s2
        rate = np.stack([np.clip(of_vy, -limit, limit), np.zeros(count)], axis=1)
        return Residual(rate, self._gain(distance2, features.even[:, SPEED_COLUMN]))

    def _gain(self, distance2: FloatArray, speed: FloatArray) -> FloatArray:
        """Return the gain of the region of validity [K]."""
        low, high = self.speed_m_s
        with np.errstate(invalid="ignore", divide="ignore"):
            outside = np.maximum(np.maximum(low / speed, speed / high), 0.0)
            of_speed = (SPEED_NONE - outside) / (SPEED_NONE - SPEED_FULL)
            of_distance = (NONE_BEYOND - distance2) / (NONE_BEYOND - FULL_WITHIN)
        gain = np.clip(np.minimum(of_speed, of_distance), 0.0, 1.0)
        return np.where(np.isfinite(distance2) & (speed > 0.0), gain, 0.0)


def plain(values: Any) -> Any:
    """Convert arrays to nested tuples of floats with twelve digits, for :class:`LadderModel`."""
    if isinstance(values, np.ndarray) and values.ndim:
        return tuple(plain(row) for row in values)
    return float(f"{float(values):.12g}")
