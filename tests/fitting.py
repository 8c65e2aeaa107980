"""Policies and episodes that fit a run, for tests that play the roles of other processes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    CheckpointMetadata,
    CodeRanges,
    checkpoint_bytes,
)
from learner.network.subnets import parameter_shapes
from proto.agreement import digest_of, settings_of
from proto.body import ACTION_VALUES
from proto.config import Config, NetworkConfig, TaskConfig, load_config
from proto.messages import PolicyVersion
from proto.metrics import Stage

POLICY_DIGEST = "digest"
"""Digest of the learner's configuration in the policies of `make_policy`."""


def settings_digest(*overrides: str) -> str:
    """Return the digest of what must agree, of a configuration with some `key=value` overrides."""
    return digest_of(settings_of(load_config(None, overrides)))


def policy_metadata(version: int, **given: Any) -> CheckpointMetadata:
    """Return metadata of a policy of the run `test`; fields can be given by name."""
    fields = {
        "run": "test",
        "version": version,
        "stage": Stage.COUPLED,
        "epoch": 10 * version,
        "loss": 0.5,
        "config_digest": POLICY_DIGEST,
        "task": "experiment1",
        "backend": "sapien",
        "network": Config().network,
        "code": CodeRanges(
            minima=tuple(value.minimum for value in ACTION_VALUES),
            maxima=tuple(value.maximum for value in ACTION_VALUES),
        ),
    }
    return CheckpointMetadata.model_validate(fields | given)


@cache
def _weights(network: NetworkConfig) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    return {
        f"{NETWORK_PREFIX}{name}": random.uniform(-0.1, 0.1, shape).astype(np.float32)
        for name, shape in parameter_shapes(network).items()
    }


def make_policy(version: int, run_id: str = "training", **metadata: Any) -> PolicyVersion:
    """Return a policy with random weights; fields of its metadata can be given by name."""
    held = policy_metadata(version, **metadata)
    blob = checkpoint_bytes(Checkpoint(held, _weights(held.network)))
    return PolicyVersion(run_id, version, held.epoch, 0.5, held.config_digest, blob)


@cache
def task_called(name: str) -> Task:
    """Return a task without options."""
    return make_task(TaskConfig(name=name))


def fitting_fields(task: str = "experiment1", *overrides: str) -> dict[str, Any]:
    """Return fields of an episode that a run of this task accepts, without seed and situation."""
    played = task_called(task)
    plan = np.asarray(played.plan(played.tutored()[0]), np.float32)
    return {
        "task": task,
        "phase_names": played.phase_names,
        "phases": played.phases,
        "actions": plan,
        "targets": plan,
        "config_digest": settings_digest(*overrides),
    }
