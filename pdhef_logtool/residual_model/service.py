"""The network over a whole log in one pass per window, with carried state (METHOD §5)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.residual_model.bundle import LATERAL_VELOCITY, OUTPUT_COUNT, RESIDUAL, ModelBundle

if TYPE_CHECKING:
    from pdhef_logtool.residual_model.network import ResidualNetwork

#: Steps of one pass. Always the same shape, counted from a sequence's start, so that no window changes a bit.
BLOCK_STEPS = 256
#: A residual beyond these is none: m/s² and rad/s².
LIMITS = (4.0, 6.0)
_LIMITS_OF = {RESIDUAL: LIMITS, LATERAL_VELOCITY: (30.0,)}  # m/s


@dataclass(frozen=True, slots=True, eq=False)
class NetworkCarry:
    """LSTM state at the last block's end (None = zeros), and the normalised features since, [M, k], M < block."""

    state: tuple[Any, Any] | None
    pending: FloatArray


@dataclass(frozen=True)
class NetworkService:
    """What one bundle predicts, step by step; PyTorch is loaded at the first use."""

    bundle: ModelBundle

    @cached_property
    def _network(self) -> ResidualNetwork:
        import torch

        from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork

        b = self.bundle
        network = ResidualNetwork(
            Architecture(len(b.feature_names), b.hidden, b.layers, b.head, outputs=OUTPUT_COUNT[b.target])
        )
        network.load_state_dict({name: torch.from_numpy(np.array(w)) for name, w in b.weights.items()})
        return network.eval()

    def initial_carry(self) -> NetworkCarry:
        """Return the carry of a new log."""
        return NetworkCarry(None, np.empty((0, len(self.bundle.feature_names))))

    def run(
        self, features: FloatArray, starts: BoolArray, carry: NetworkCarry | None
    ) -> tuple[FloatArray, NetworkCarry]:
        """Return residual rates [N, 2] in m/s² and rad/s² from each step on, or v_y [N, 1] in m/s; and the carry.

        Parameters
        ----------
        features : [N, 28] as from :func:`~.features.make_features`; rows with NaN give 0 and end the sequence.
        starts : [N], where a sequence begins anew.
        """
        if carry is None:
            carry = self.initial_carry()
        out = np.zeros((features.shape[0], OUTPUT_COUNT[self.bundle.target]))
        known = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        breaks = np.logical_or(starts, ~known).astype(np.bool_)
        breaks[1:] |= ~known[:-1]
        edges = [0, *(np.flatnonzero(breaks[1:]) + 1).tolist(), features.shape[0]]
        for a, b in pairwise(edges):
            if a == b:
                continue
            if breaks[a]:
                carry = self.initial_carry()
            if known[a]:
                out[a:b], carry = self._sequence(self.bundle.normalise(features[a:b]), carry)
        target_std = np.array(self.bundle.normalisation.target_std)
        limits = np.array(_LIMITS_OF[self.bundle.target])
        return np.clip(out * target_std, -limits, limits), carry

    def _sequence(self, scaled: FloatArray, carry: NetworkCarry) -> tuple[FloatArray, NetworkCarry]:
        import torch

        # Normalised, a mirrored feature has the other sign, for the means of those that change theirs are 0.
        sides = [np.ones(len(self.bundle.feature_names)), self.bundle.signs][: 2 if self.bundle.odd else 1]
        before = carry.pending.shape[0]
        rows = np.concatenate([carry.pending, scaled])
        whole = rows.shape[0] // BLOCK_STEPS * BLOCK_STEPS
        state = carry.state
        outputs = []
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # at batch 1 more threads are slower by far (METHOD §11)
        try:
            with torch.inference_mode():
                for at in range(0, rows.shape[0], BLOCK_STEPS):
                    part = rows[at : at + BLOCK_STEPS]
                    block = np.zeros((len(sides), BLOCK_STEPS, rows.shape[1]), dtype=np.float32)
                    for side, sign in enumerate(sides):
                        block[side, : part.shape[0]] = sign * part
                    result, after = self._network(torch.from_numpy(block), state)
                    said = result[:, : part.shape[0]].numpy().astype(np.float64)
                    outputs.append(0.5 * (said[0] - said[1]) if self.bundle.odd else said[0])
                    if at < whole:
                        state = after
        finally:
            torch.set_num_threads(threads)
        return np.concatenate(outputs)[before:], NetworkCarry(state, rows[whole:])


@dataclass(frozen=True)
class RememberingNetwork(NetworkService):
    """A network that answers the same question once: neither trust nor a filter's noise changes its features."""

    _known: dict[bytes, tuple[FloatArray, NetworkCarry]] = field(default_factory=dict, compare=False)

    def run(
        self, features: FloatArray, starts: BoolArray, carry: NetworkCarry | None
    ) -> tuple[FloatArray, NetworkCarry]:
        """Return what the network says; what is remembered are whole drives, from their start."""
        if carry is not None:
            return super().run(features, starts, carry)
        key = hashlib.sha256(np.ascontiguousarray(features).tobytes() + starts.tobytes()).digest()
        if key not in self._known:
            self._known[key] = super().run(features, starts, None)
        return self._known[key]
