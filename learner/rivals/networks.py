"""A small CNN with an LSTM, and one that acts from the current image alone.

Both get the images that VMDNN gets and have its outputs and, by default, about its number of
weights. Both have the same vision, the eye: two convolutions, and for each map the position in the
image at which it is most active (spatial softmax, Levine et al. 2016).
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from proto.body import ACTION_SIZE
from proto.config import ComparisonConfig, NetworkConfig, RivalConfig, RivalKind

State = tuple[Tensor, Tensor] | None
"""Hidden activity and cell state of an LSTM, (1, B, units) each; None before the first step."""

_MAPS: Final = 16
FEATURES: Final = 2 * _MAPS


class Rival(nn.Module):
    """Eye > LSTM or hidden layer > outputs as those of M_O."""

    def __init__(self, kind: RivalKind, units: int, config: NetworkConfig) -> None:
        super().__init__()
        self._values = (ACTION_SIZE, config.softmax_units)
        self.eye = nn.Sequential(
            nn.Conv2d(1, 8, 8, stride=4, padding=4),
            nn.ReLU(),
            nn.Conv2d(8, _MAPS, 5, stride=2, padding=2),
        )
        self.memory = nn.LSTM(FEATURES, units, batch_first=True) if kind == "cnn-lstm" else None
        self.hidden = nn.Linear(FEATURES, units) if kind == "feed-forward" else None
        self.outputs = nn.Linear(units, ACTION_SIZE * config.softmax_units)

    def see(self, images: Tensor) -> Tensor:
        """Features (B, T, 32) for images (B, T, height, width), brightness -1..1."""
        maps = self.eye(images.flatten(0, 1).unsqueeze(1))
        return _positions(maps).view(*images.shape[:2], FEATURES)

    def act(self, seen: Tensor, state: State = None) -> tuple[Tensor, State]:
        """Logarithms of the outputs (B, T, 11, softmax units) for features, and the state after."""
        if self.memory is not None:
            active, state = self.memory(seen, state)
        elif self.hidden is not None:
            active = torch.tanh(self.hidden(seen))
        potentials = self.outputs(active).unflatten(-1, self._values)
        return functional.log_softmax(potentials, dim=-1), state

    def coupled_parameters(self) -> list[nn.Parameter]:
        """All parameters but those of the eye."""
        return [
            parameter for name, parameter in self.named_parameters() if not name.startswith("eye.")
        ]


def make_rival(kind: RivalKind, units: int, config: NetworkConfig, seed: int = 0) -> Rival:
    """A network with random weights, which the seed determines."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        return Rival(kind, units, config)


def rival_config(config: ComparisonConfig, kind: RivalKind) -> RivalConfig:
    """The settings of one kind of network."""
    return config.cnn_lstm if kind == "cnn-lstm" else config.feed_forward


def weights_of(network: nn.Module) -> int:
    """Number of a network's weights and biases."""
    return sum(parameter.numel() for parameter in network.parameters())


def _positions(maps: Tensor) -> Tensor:
    """Mean rows, then columns (N, 2 x maps), -1..1, by a softmax over each map (N, maps, H, W)."""
    height, width = maps.shape[-2:]
    weights = functional.softmax(maps.flatten(2), dim=-1).view_as(maps)
    rows = weights.sum(-1) @ torch.linspace(-1, 1, height)
    columns = weights.sum(-2) @ torch.linspace(-1, 1, width)
    return torch.cat([rows, columns], dim=-1)
