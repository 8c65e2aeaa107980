"""Policies on the bus: the message that the learner publishes, and what a receiver checks."""

from __future__ import annotations

import math
from typing import Final

from learner.checkpoint import (
    Checkpoint,
    CheckpointMetadata,
    check_same_network,
    checkpoint_from_bytes,
)
from learner.network.subnets import parameter_shapes
from proto.config import Config, NetworkConfig
from proto.errors import UserError
from proto.messages import LARGEST_LOSS, PolicyVersion
from proto.plain_text import plain

_ORIGIN: Final = "the policy"
_REST: Final = 256 * 1024
"""Room for all in a message but the weights; the metadata take a few KiB."""


def policy_limit(network: NetworkConfig) -> int:
    """Largest size of a message with a policy of a network (bytes).

    Raises:
        UserError: there can be no such network.
    """
    weights = sum(math.prod(shape) for shape in parameter_shapes(network).values())
    return 4 * weights + _REST


def policy_message(run_id: str, metadata: CheckpointMetadata, weights: bytes) -> PolicyVersion:
    """Return the message that publishes a policy.

    Args:
        run_id: id of the training.
        metadata: what the policy file says of itself.
        weights: content of the policy file.
    """
    return PolicyVersion(
        run_id=run_id,
        version=metadata.version,
        epoch=metadata.epoch,
        loss=_loss(metadata),
        config_digest=metadata.config_digest,
        weights=weights,
    )


def policy_of(message: PolicyVersion, config: Config) -> Checkpoint:
    """Read and check the policy in a message.

    Args:
        message: the message.
        config: configuration of the run.

    Raises:
        UserError: the policy is damaged, contradicts its message, or is none of this run: of
            another task or network, or one that cannot act.
    """
    checkpoint = checkpoint_from_bytes(message.weights, _ORIGIN)
    metadata = checkpoint.metadata
    told = (message.version, message.epoch, message.loss, message.config_digest)
    held = (metadata.version, metadata.epoch, _loss(metadata), metadata.config_digest)
    if told != held:
        raise UserError(
            f"{_ORIGIN} contradicts its message: version, epoch, loss and digest are"
            f" {plain(held, 300)}, but the message says {plain(told, 300)}"
        )
    if metadata.task != config.task.name:
        raise UserError(f"{_ORIGIN} was trained for the task {plain(metadata.task, 100)}")
    if metadata.training is not None or metadata.rival is not None or metadata.code is None:
        raise UserError(f"{_ORIGIN} is not a policy of VMDNN that can act")
    check_same_network(config.network, checkpoint, _ORIGIN)
    return checkpoint


def _loss(metadata: CheckpointMetadata) -> float:
    return min(metadata.loss or 0.0, LARGEST_LOSS)
