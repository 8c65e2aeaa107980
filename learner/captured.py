"""Updates on a GPU without the host: each is recorded once, as a CUDA graph, and then replayed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

WARM_UPS: Final = 3
"""Updates that are done as they are written before one is recorded: what is made at first use, such
as the optimizer's state and compiled kernels, must not be part of a recording."""


@dataclass(frozen=True)
class _Recording:
    graph: torch.cuda.CUDAGraph
    chosen: Tensor
    loss: Tensor


class CapturedUpdates:
    """Calls an update, and replays it from the fourth call on.

    Args:
        update: does loss, gradients and optimizer step for the sequences with the given indices and
            returns the loss; never waits for the GPU, and works in place on what it changes.
    """

    def __init__(self, update: Callable[[Tensor], Tensor]) -> None:
        self._update = update
        self._warm_ups: dict[int, int] = {}
        self._recordings: dict[int, _Recording] = {}

    def __call__(self, chosen: Tensor) -> Tensor:
        """The loss, on the GPU; one recording for each number of sequences."""
        size = len(chosen)
        if size not in self._recordings:
            if self._warm_ups.setdefault(size, 0) < WARM_UPS:
                self._warm_ups[size] += 1
                return self._aside(chosen)
            self._recordings[size] = self._record(chosen)
        recording = self._recordings[size]
        recording.chosen.copy_(chosen)
        recording.graph.replay()
        return recording.loss.clone()

    def _aside(self, chosen: Tensor) -> Tensor:
        """On a stream of its own, as recordings want it."""
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            loss = self._update(chosen).detach()
        torch.cuda.current_stream().wait_stream(stream)
        return loss

    def _record(self, chosen: Tensor) -> _Recording:
        chosen = chosen.clone()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            loss = self._update(chosen).detach()
        return _Recording(graph, chosen, loss)
