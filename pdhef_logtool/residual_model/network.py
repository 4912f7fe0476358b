"""ST-ResNet: LSTM with a fully connected head that predicts the nominal model's residual (Eq 11-17, Table 1)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from pdhef_logtool.residual_model.torch_extra import check_torch

check_torch()

import torch  # noqa: E402
from torch import nn  # noqa: E402

#: (h, c) of all layers, each [layers, batch, hidden].
State = tuple[torch.Tensor, torch.Tensor]

#: Residual rates in the order of the network's output.
OUTPUTS = ("vy_dot_m_s2", "yaw_acceleration_rad_s2")


@dataclass(frozen=True, slots=True)
class Architecture:
    """Shape of the network; the paper's is 6 features, 2 x 128, 64-32, dropout 0.2."""

    features: int = 8
    hidden: int = 128
    layers: int = 2
    head: tuple[int, ...] = (64, 32)
    dropout: float = 0.2
    outputs: int = len(OUTPUTS)


class ResidualNetwork(nn.Module):
    """Network from a sequence of normalised features to normalised residuals; the caller keeps the state."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        a = architecture
        self.architecture = a
        self.lstm = nn.LSTM(
            a.features, a.hidden, a.layers, batch_first=True, dropout=a.dropout if a.layers > 1 else 0.0
        )
        widths = (a.hidden, *a.head)
        blocks: list[nn.Module] = []
        for i, o in pairwise(widths):
            blocks += [nn.Linear(i, o), nn.ReLU(), nn.Dropout(a.dropout)]
        self.head = nn.Sequential(*blocks, nn.Linear(widths[-1], a.outputs))

    def forward(self, features: torch.Tensor, state: State | None = None) -> tuple[torch.Tensor, State]:
        """Run [batch, time, features] from ``state`` (None = zeros); [batch, time, outputs] and the state after."""
        hidden, after = self.lstm(features, state)
        return self.head(hidden), after
