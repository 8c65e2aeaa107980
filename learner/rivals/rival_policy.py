"""A trained rival as a policy."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from learner.checkpoint import NETWORK_PREFIX, Checkpoint
from learner.network.vision_input import vision_input
from learner.rivals.networks import State, make_rival
from learner.tensors import to_tensors
from proto.episode import Image
from proto.errors import UserError
from proto.variables import Situation


class RivalPolicy:
    """Acts with a trained rival; see `learner.network_policy.NetworkPolicy`.

    Attributes:
        name: the run that trained it.
        version: its version in that run.
        looks: always true; it acts on images.
        target: always None; its actions are what it intends.
        outputs: (11 x softmax units,) float32, the outputs of the last step.
    """

    looks = True
    target: NDArray[np.float64] | None = None

    def __init__(self, checkpoint: Checkpoint, origin: str) -> None:
        """Make a policy of a checkpoint.

        Args:
            checkpoint: a checkpoint of a rival.
            origin: where it comes from, for messages.

        Raises:
            UserError: the checkpoint holds no rival, or another one than its metadata describes.
        """
        metadata = checkpoint.metadata
        code = metadata.softmax_code()
        if metadata.rival is None or code is None:
            raise UserError(f"{origin} holds no network that VMDNN is compared with")
        self.name, self.version = metadata.run, metadata.version
        self.outputs: NDArray[np.float32] | None = None
        self._code = code
        self._network = make_rival(metadata.rival.kind, metadata.rival.units, metadata.network)
        weights = checkpoint.part(NETWORK_PREFIX)
        try:
            self._network.load_state_dict(to_tensors(weights))
        except RuntimeError as error:
            raise UserError(
                f"{origin} does not hold what its metadata describes: {error}"
            ) from error
        self._state: State = None

    def begin(self, situation: Situation, seed: int) -> None:  # noqa: ARG002
        """Return to the neutral state; situation and seed are not used."""
        self._state = None

    def step(self, image: Image) -> NDArray[np.float64]:
        """Next action (11,), within what the robot accepts, for the image (48, 64) uint8."""
        with torch.no_grad():
            seen = self._network.see(torch.from_numpy(vision_input(image))[None, None])
            log_outputs, self._state = self._network.act(seen, self._state)
        outputs = log_outputs[0, 0].exp().numpy()
        self.outputs = outputs.ravel()
        return self._code.decode(outputs)
