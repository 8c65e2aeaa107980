"""A trained network as a policy: vision in, next joint targets out (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Self, cast

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    checkpoint_from_bytes,
    load_checkpoint,
)
from learner.network.acting import ActingNetwork, make_acting_network
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import Parameters
from learner.network.vision_input import vision_input
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import NetworkConfig
from proto.episode import Floats, Image
from proto.errors import UserError
from proto.variables import Situation


class NetworkPolicy:
    """Acts with a trained network; knows nothing of the situation but what it sees.

    Attributes:
        name: the run that trained it.
        version: its version in that run.
        looks: always true; it acts on what it sees.
        target: always None; it means what it does.
        outputs: (11 x softmax units,) float32, the outputs of the last step.
    """

    looks = True
    target: NDArray[np.float64] | None = None

    def __init__(
        self,
        checkpoint: Checkpoint,
        origin: str,
        make_network: Callable[[NetworkConfig, Parameters], ActingNetwork] = make_acting_network,
    ) -> None:
        """Make a policy of a checkpoint; `origin` is where it came from, for messages.

        Raises:
            UserError: the checkpoint is from pre-training and cannot act yet.
        """
        metadata = checkpoint.metadata
        if metadata.rival is not None:
            raise UserError(f"{origin} is no VMDNN, but the {metadata.rival.kind} network")
        code = metadata.softmax_code()
        if code is None:
            raise UserError(
                f"{origin} is from pre-training and cannot act yet; train further, or take a"
                " later checkpoint"
            )
        parameters = cast("Parameters", checkpoint.part(NETWORK_PREFIX))
        self.name = metadata.run
        self.version = metadata.version
        self.outputs: NDArray[np.float32] | None = np.zeros(code.references.size, np.float32)
        self._code = code
        self._network = make_network(metadata.network, parameters)
        self._sizes, self._parameters = metadata.network, parameters

    @classmethod
    def from_file(cls, path: Path) -> Self:
        """Read a policy or a training checkpoint.

        Raises:
            UserError: the file is missing, damaged, foreign, or cannot act.
        """
        return cls(load_checkpoint(path), f"checkpoint {path}")

    @classmethod
    def from_bytes(cls, blob: bytes) -> Self:
        """Read a policy that came in a message.

        Raises:
            UserError: the bytes are damaged, foreign, or cannot act.
        """
        return cls(checkpoint_from_bytes(blob, "the policy"), "the policy")

    def begin(self, situation: Situation, seed: int) -> None:  # noqa: ARG002
        """Return to the neutral state; situation and seed mean nothing to a network."""
        self._network.reset()

    def step(self, image: Image) -> NDArray[np.float64]:
        """Next action (11,), within what the robot accepts, for the picture (48, 64) uint8."""
        if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH):
            raise UserError(
                f"the network looks at {IMAGE_HEIGHT} x {IMAGE_WIDTH} pictures (height x width),"
                f" not {image.shape}"
            )
        outputs = self._network.step(vision_input(image))
        self.outputs = np.asarray(outputs, np.float32).ravel()
        return self._code.decode(outputs)

    def pfc(self) -> Floats:
        """Activity (units,) of the PFC after the last step."""
        return np.asarray(self._network.pfc(), np.float32)

    def states(self, images: Image) -> dict[str, Floats]:
        """Activity (T, units) of each subnet while it sees images (T, 48, 64), from neutral.

        It is computed anew from what was seen, for the network that acts keeps nothing of it.
        """
        network = NumpyNetwork(self._sizes, self._parameters)
        steps = []
        for image in images:
            network.step(vision_input(image))
            steps.append(network.activity)
        return {name: np.stack([step[name] for step in steps]) for name in steps[0]}
