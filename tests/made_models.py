"""Small residual models for tests."""

from dataclasses import replace

import numpy as np
import torch

from pdhef_logtool.residual_model import bundle
from pdhef_logtool.residual_model.features import EVEN_COUNT, FEATURES, ODD_COUNT, PAPER_FEATURES
from pdhef_logtool.residual_model.ladder import LadderModel
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.network import ResidualNetwork


def random_network(
    seed: int = 0,
    names: tuple[str, ...] = FEATURES,
    *,
    hidden: int = 8,
    layers: int = 1,
    head: tuple[int, ...] = (4,),
    outputs: int = 2,
    scales: tuple[float, float] = (10.0, 1.0),
    constant: tuple[float, float] | None = None,
    **settings: str,
) -> bundle.ModelBundle:
    """Return a network with random weights, scaled by an input and an output; or with a constant output."""
    torch.manual_seed(seed)
    size = len(names)
    network = ResidualNetwork(size, hidden, layers, head, outputs=outputs)
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    if constant is not None:
        last = max(k for k in weights if k.startswith("head") and k.endswith("bias"))
        weights[last.replace("bias", "weight")][:] = 0.0
        weights[last][:] = constant
    normalisation = bundle.Normalisation((0.0,) * size, (scales[0],) * size, (scales[1],) * outputs)
    return bundle.ModelBundle(names, hidden, layers, head, 0.01, normalisation, weights=weights, **settings)


def full_network(seed: int = 1) -> bundle.ModelBundle:
    """Return a network with all baselines beside it: β = 0.9 v_y,phy / 22 m/s − 0.001 a_y, at 22 m/s."""
    papers = random_network(seed, PAPER_FEATURES, scales=(5.0, 1.0), model=bundle.NOMINAL_MODEL)
    lstm = random_network(
        seed, outputs=1, scales=(5.0, 1.0), target=bundle.LATERAL_VELOCITY, model=bundle.NOMINAL_MODEL
    )
    regression = LinearModel(("ay_m_s2", "physics_vy_m_s"), (-0.001 * seed, 0.9 / 22.0), 0.0, 2.0)
    physics = random_network(seed, scales=(5.0, 1.0), target=bundle.RESIDUAL, model=bundle.PHYSICS_MODEL)
    return replace(physics, pure_lstm=lstm, linear_regression=regression, paper_network=papers)


def linear_residual(weight: float = 0.3, fastest_m_s: float = 40.0) -> LadderModel:
    """Return a residual rate, m/s², of the low-passed yaw rate over 0.3, valid up to a speed."""
    weights = [0.0] * ODD_COUNT
    weights[5] = weight
    scales = {"scale": (0.3,) * ODD_COUNT, "even_mean": (20.0,) * EVEN_COUNT, "even_scale": (5.0,) * EVEN_COUNT}
    whitening = tuple(tuple(map(float, 1e-4 * row)) for row in np.eye(ODD_COUNT))
    limits = {"speed_m_s": (5.0, fastest_m_s), "largest_m_s2": 3.0}
    return LadderModel(rung="linear", weights=tuple(weights), whitening=whitening, **scales, **limits)
