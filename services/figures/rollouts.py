"""Recorded rollouts with the activity of the network, and what distinguishes them in figures."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.policies.contract import StatefulPolicy
from proto.episode import Episode, Floats, States
from proto.errors import UserError
from proto.variables import Situation, Value
from services.figures.style import words_and_unit

SYMBOLS: Final[Mapping[str, str]] = {
    "mstnn_fast": "$V_F$",
    "mstnn_slow": "$V_S$",
    "pfc": "PFC",
    "mtrnn_slow": "$M_S$",
    "mtrnn_fast": "$M_F$",
}
"""The paper's symbol of each subnet with recorded states, as a label."""
_SAME_OUTPUTS: Final = 1e-3
"""Largest difference by rounding between the outputs of a network that sees the same pictures."""


@dataclass(frozen=True)
class Activity:
    """An episode of T steps with the activity of the network.

    Attributes:
        episode: the episode.
        states: activity (T, units) of each subnet by name.
    """

    episode: Episode
    states: States

    @property
    def phase_starts(self) -> NDArray[np.int64]:
        """First step of each phase that occurs, followed by T."""
        phases = self.episode.phases
        starts = np.flatnonzero(np.diff(phases)) + 1
        return np.concatenate([[0], starts, [len(phases)]])

    @property
    def phase_names(self) -> list[str]:
        """Names of the phases that occur, in the order of `phase_starts`."""
        return [
            self.episode.phase_names[self.episode.phases[start]] for start in self.phase_starts[:-1]
        ]


def activity_of(
    episode: Episode, policy: StatefulPolicy | None, subnets: Collection[str]
) -> Activity:
    """Return an episode with its states.

    Args:
        episode: the episode.
        policy: the policy that played it. It sees the pictures again to compute the states. If
            None, the recorded states are used.
        subnets: names of the subnets whose states are needed.

    Raises:
        UserError: there is neither a policy nor a recorded state, a subnet has no states, or
            another policy played the episode.
    """
    if episode.states is not None and policy is None:
        states = episode.states
    elif policy is not None:
        _check_same_policy(episode, policy)
        states = policy.states(episode.images)
    else:
        raise UserError(
            f"rollout {episode.id} of policy {episode.policy!r} has no states; record it with"
            " `vmdnn evaluate --states`, or name the checkpoint that played it with --policy"
        )
    if missing := set(subnets) - states.keys():
        raise UserError(f"rollout {episode.id} has no states of {', '.join(sorted(missing))}")
    return Activity(episode, states)


def common_phase_starts(activities: Sequence[Activity]) -> NDArray[np.int64]:
    """Return the first step of each phase, followed by T, of episodes with the same phases.

    Raises:
        UserError: the phases of the episodes differ.
    """
    starts = activities[0].phase_starts
    if not all(np.array_equal(starts, each.phase_starts) for each in activities):
        raise UserError("the rollouts have different phases; choose rollouts of the same task")
    return starts


def differing_variables(situations: Sequence[Situation]) -> list[str]:
    """Return the names of the variables whose values differ between situations, in their order."""
    return [
        name for name in situations[0] if len({situation.get(name) for situation in situations}) > 1
    ]


def distinctions(episodes: Sequence[Episode]) -> list[list[str]]:
    """Return for each episode what distinguishes it from the others.

    These are the values of the variables that differ, and policy and version if they differ. If
    nothing differs, or for a single episode, these are the values of all variables.
    """
    names = differing_variables([episode.situation for episode in episodes])
    policies_differ = len({(each.policy, each.policy_version) for each in episodes}) > 1
    if not names and not policies_differ:
        names = list(episodes[0].situation)
    found = []
    for episode in episodes:
        words = [_value_text(name, episode.situation[name]) for name in names]
        if policies_differ:
            words.append(f"{episode.policy} version {episode.policy_version}")
        found.append(words)
    return found


def wrapped(words: Sequence[str], width: int) -> str:
    """Join texts with commas into lines of at most `width` characters, without breaking a text."""
    lines = [words[0]]
    for word in words[1:]:
        if len(lines[-1]) + len(word) + 3 <= width:
            lines[-1] += f", {word}"
        else:
            lines[-1] += ","
            lines.append(word)
    return "\n".join(lines)


def numbered_phases(activity: Activity) -> list[str]:
    """Return number and name of each phase, such as `(1) observe gesture`."""
    return [f"({number}) {name}" for number, name in enumerate(activity.phase_names, 1)]


def _value_text(name: str, value: Value) -> str:
    words, unit = words_and_unit(name)
    shown = value if isinstance(value, str) else f"{value:.4g}"
    return f"{words} {shown}°" if unit == "degrees" else f"{words} {shown} {unit}".rstrip()


def _check_same_policy(episode: Episode, policy: StatefulPolicy) -> None:
    if episode.outputs is None:
        raise UserError(f"rollout {episode.id} was not played by a network, so it has no states")
    policy.begin(episode.situation, episode.seed)
    again = np.stack([_outputs(policy, image) for image in episode.images])
    difference = (
        np.abs(again - episode.outputs).max() if again.shape == episode.outputs.shape else np.inf
    )
    if difference > _SAME_OUTPUTS:
        raise UserError(
            f"rollout {episode.id} was played by {episode.policy!r} version"
            f" {episode.policy_version}, not by this policy, whose outputs differ"
        )


def _outputs(policy: StatefulPolicy, image: NDArray[np.uint8]) -> Floats:
    policy.step(image)
    if policy.outputs is None:
        raise UserError(f"policy {policy.name!r} has no outputs to compare")
    return policy.outputs.copy()
