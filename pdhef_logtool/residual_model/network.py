"""ST-ResNet: LSTM with a fully connected head that predicts the nominal model's residual (Eq 11-17, Table 1)."""

from itertools import pairwise

from pdhef_logtool.records.extras import required

required("torch", "train", "trains networks", "torch")

import torch  # noqa: E402
from torch import nn  # noqa: E402

#: (h, c) of all layers, each [layers, batch, hidden].
State = tuple[torch.Tensor, torch.Tensor]


class ResidualNetwork(nn.Module):
    """Network from a sequence of normalised features to normalised residuals; the caller keeps the state."""

    def __init__(
        self, features: int, hidden: int, layers: int, head: tuple[int, ...], dropout: float = 0.2, outputs: int = 2
    ) -> None:
        super().__init__()
        between = dropout if layers > 1 else 0.0
        self.lstm = nn.LSTM(features, hidden, layers, batch_first=True, dropout=between)
        widths = (hidden, *head)
        blocks: list[nn.Module] = []
        for i, o in pairwise(widths):
            blocks += [nn.Linear(i, o), nn.ReLU(), nn.Dropout(dropout)]
        self.head = nn.Sequential(*blocks, nn.Linear(widths[-1], outputs))

    def forward(self, features: torch.Tensor, state: State | None = None) -> tuple[torch.Tensor, State]:
        """Run [batch, time, features] from ``state`` (None = zeros); [batch, time, outputs] and the state after."""
        hidden, after = self.lstm(features, state)
        return self.head(hidden), after
