"""Predictions of the network over a log, with one pass per window and its state (docs/method.md#network)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.residual_model.bundle import LATERAL_VELOCITY, OUTPUT_COUNT, RESIDUAL, ModelBundle
from pdhef_logtool.residual_model.forward_pass import SIDES, ForwardPass, NetworkState
from pdhef_logtool.residual_model.interface import LIMITS, Residual

_LIMITS_OF = {RESIDUAL: LIMITS, LATERAL_VELOCITY: (30.0,)}  # m/s


#: State between windows; None at the start of a sequence.
NetworkCarry: TypeAlias = NetworkState | None


@dataclass(frozen=True)
class NetworkService:
    """Predictions of one bundle, step by step."""

    bundle: ModelBundle

    @property
    def sha256(self) -> str:
        """Digest of the bundle."""
        return self.bundle.sha256

    @cached_property
    def _network(self) -> ForwardPass:
        return ForwardPass.of(self.bundle.weights, self.bundle.layers, self.bundle.head)

    def run(self, features: FloatArray, starts: BoolArray, carry: NetworkCarry) -> tuple[FloatArray, NetworkCarry]:
        """Return residual rates [N, 2] in m/s² and rad/s² after each step, or v_y [N, 1] in m/s; and the state.

        Parameters
        ----------
        features : [N, 15] as from :func:`~.features.make_features`; rows with NaN give 0 and end the sequence.
        starts : [N], True at the start of a sequence.
        """
        out = np.zeros((features.shape[0], OUTPUT_COUNT[self.bundle.target]))
        usable = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        breaks = np.logical_or(starts, ~usable).astype(np.bool_)
        breaks[1:] |= ~usable[:-1]
        edges = [0, *(np.flatnonzero(breaks[1:]) + 1).tolist(), features.shape[0]]
        for a, b in pairwise(edges):
            if a == b:
                continue
            if breaks[a]:
                carry = None
            if usable[a]:
                out[a:b], carry = self._sequence(self.bundle.normalise(features[a:b]), carry)
        target_std = np.array(self.bundle.normalisation.target_std)
        limits = np.array(_LIMITS_OF[self.bundle.target])
        return np.clip(out * target_std, -limits, limits), carry

    def residual(self, features: FloatArray, dt_s: FloatArray, state: NetworkCarry) -> tuple[Residual, NetworkCarry]:
        """Return the residual of consecutive steps (see :class:`~.interface.ResidualModel`)."""
        rate, after = self.run(features, np.isnan(dt_s), state)
        return Residual(rate, np.ones(len(rate))), after

    def lateral_velocity(
        self, features: FloatArray, dt_s: FloatArray, state: NetworkCarry
    ) -> tuple[FloatArray, NetworkCarry]:
        """Return v_y [N] of such a network and the state after; ``dt_s`` [N] is NaN where a sequence starts."""
        output, after = self.run(features, np.isnan(dt_s), state)
        return output[:, 0], after

    def _sequence(self, scaled: FloatArray, carry: NetworkCarry) -> tuple[FloatArray, NetworkState]:
        both = np.zeros((len(scaled), SIDES, scaled.shape[1]), dtype=np.float32)
        both[:, 0] = scaled
        if self.bundle.odd:  # features that change their sign have a mean of 0, so that normalised values change it too
            both[:, 1] = scaled * self.bundle.signs
        said, after = self._network.run(both, self._network.initial_state() if carry is None else carry)
        straight, mirrored = said[:, 0].astype(np.float64), said[:, 1]
        return 0.5 * (straight - mirrored) if self.bundle.odd else straight, after
