"""Makes policies by name: the tutor, the task's baselines, trained networks, user's classes."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Final

from actors.policies.blinded import BlindedPolicy
from actors.policies.contract import Policy
from actors.policies.planned import PlannedPolicy, make_tutor
from actors.tasks.contract import Task
from learner.checkpoint import Checkpoint, load_checkpoint
from learner.network_policy import NetworkPolicy
from learner.pretrained import checkpoint_path, pretrained_names
from proto.errors import UserError
from proto.extensions import check_attributes, load_class

_METHODS: Final = ("begin", "step")
_ATTRIBUTES: Final = ("name", "version", "looks", "target", "outputs")


def make_policy(name: str, task: Task) -> Policy:
    """Make the policy called `name`, to play a task.

    Args:
        name: `tutor`, a baseline of the task, the path of a checkpoint, the folder of a run (its
            newest policy), `pretrained:NAME`, or a user's class as `package.module:Class`, which is
            called without arguments. Before it may stand the name of one of `task.blinded`, as in
            `blank-screen:pretrained:NAME`.
        task: the task that is played.

    Raises:
        UserError: there is no such policy or file, or it was trained for another task.
    """
    if name == "tutor":
        return make_tutor(task)
    if name in task.baselines:
        return PlannedPolicy(name, task, task.baselines[name])
    first, _, rest = name.partition(":")
    if rest and first in task.blinded:
        return BlindedPolicy(first, make_policy(rest, task), task.blinded[first])
    path = checkpoint_path(name)
    if path.is_file():
        return _load_network(path, task)
    names = ["tutor", *task.baselines, *pretrained_names()]
    similar = get_close_matches(name, names, n=1, cutoff=0.8)
    if rest and not similar and all(part.isidentifier() for part in first.split(".")):
        return _make_own(name)
    guess = f" Did you mean {similar[0]}?" if similar else ""
    listed = ", ".join([*names, *(f"{each}:POLICY" for each in task.blinded)])
    raise UserError(
        f"policy {name!r}: no such policy or checkpoint file.{guess} There are: {listed}, the path"
        " of a .safetensors checkpoint, the folder of a run, or a policy of your own as"
        " package.module:Class."
    )


def check_task(checkpoint: Checkpoint, task: str, origin: str) -> None:
    """Refuse a network that was trained for another task.

    Raises:
        UserError: the network was trained for another task; the message names both tasks.
    """
    trained_for = checkpoint.metadata.task
    if trained_for is not None and trained_for != task:
        raise UserError(
            f"{origin} was trained for the task {trained_for!r} and cannot play {task!r}: choose"
            f" task.name={trained_for}, or another policy"
        )


def _make_own(name: str) -> Policy:
    """Make a policy of a user's class; check its attributes on the object, which may set them."""
    policy: Policy = load_class("--policy", name, {}, _METHODS)()
    check_attributes("--policy", name, policy, _ATTRIBUTES)
    return policy


def _load_network(path: Path, task: Task) -> Policy:
    """Load a checkpoint of VMDNN or of a network that it is compared with."""
    checkpoint, origin = load_checkpoint(path), f"checkpoint {path}"
    check_task(checkpoint, task.name, origin)
    if checkpoint.metadata.rival is None:
        return NetworkPolicy(checkpoint, origin)
    from learner.rivals.rival_policy import RivalPolicy  # noqa: PLC0415 - only this needs torch

    return RivalPolicy(checkpoint, origin)
