"""What can be told of a situation from what the vision makes of it.

Two ways of asking: the classifier of pre-training, which had to learn just this, and a linear
regression from V_S, which tells how far its features also tell what lies between the classes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from learner.checkpoint import CLASSIFIER_PREFIX, NETWORK_PREFIX, Checkpoint
from learner.network.mtrnn import run_levels
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from proto.episode import Episode
from proto.errors import UserError

Array = NDArray[np.float64]

PENALTIES: Final = np.logspace(-7, 1, 17)
"""Of the regression, as parts of the features' mean square."""


@dataclass(frozen=True)
class Answer:
    """How well the classifier answered for a value, at the end of each sequence.

    Attributes:
        value: name of the situation's value.
        classes: how many there are.
        right: share of sequences for which the nearest class got the highest answer.
        error: mean distance of the truth from the mean of the classes under the answer.
    """

    value: str
    classes: int
    right: float
    error: float


@dataclass(frozen=True)
class Probe:
    """How well a regression from V_S at the end of a phase tells a value of other sequences.

    Attributes:
        phase: number of the phase.
        value: name of the situation's value.
        error: mean distance from the truth.
        blind_error: the same for whoever sees nothing and says the mean.
    """

    phase: int
    value: str
    error: float
    blind_error: float


class Vision:
    """V_F and V_S of a checkpoint and, if it is from pre-training, its classifier.

    Attributes:
        classes: centres of the classifier's classes by value; empty without a classifier.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        training = checkpoint.metadata.training
        self.classes = {} if training is None else training.classes
        self._network = VMDNN(checkpoint.metadata.network)
        self._network.load_state_dict(_tensors(checkpoint, NETWORK_PREFIX))
        self._classifier = _tensors(checkpoint, CLASSIFIER_PREFIX)

    @torch.no_grad()
    def see(self, episode: Episode) -> NDArray[np.float32]:
        """V_S (T, units) in an episode.

        Raises:
            UserError: its pictures are of another size than the network's.
        """
        width, height = self._network.config.image
        if episode.images.shape[1:] != (height, width):
            raise UserError(
                f"{episode.id} has pictures {episode.images.shape[1:]}, but the network looks at"
                f" {height, width} (height, width)"
            )
        images = torch.from_numpy(vision_input(episode.images))
        return np.asarray(self._network.see(images[None])[0])

    @torch.no_grad()
    def answer(self, seen: NDArray[np.float32]) -> dict[str, Array]:
        """What the classifier says at the end of V_S (T, units): shares of each value's classes."""
        pfc = run_levels([self._network.pfc], torch.from_numpy(seen)[None], "bottom_up")[0, -1]
        sums = self._classifier["weight"] @ pfc + self._classifier["bias"]
        parts = torch.split(sums, [len(centres) for centres in self.classes.values()])
        return {
            value: np.asarray(torch.softmax(part.double(), dim=0))
            for value, part in zip(self.classes, parts, strict=True)
        }


def ask_classifier(vision: Vision, episodes: Sequence[Episode]) -> list[Answer]:
    """How well the classifier answers, value by value; nothing if there is none."""
    said = [vision.answer(vision.see(episode)) for episode in episodes] if vision.classes else []
    answers = []
    for value, centres in vision.classes.items():
        truth = _values(episodes, value)[:, None]
        shares = np.stack([answer[value] for answer in said])
        nearest = np.abs(truth - centres).argmin(1)
        answers.append(
            Answer(
                value=value,
                classes=len(centres),
                right=float((shares.argmax(1) == nearest).mean()),
                error=float(np.abs(shares @ np.array(centres) - truth[:, 0]).mean()),
            )
        )
    return answers


def probe(vision: Vision, learned: Sequence[Episode], tested: Sequence[Episode]) -> list[Probe]:
    """What V_S tells at the end of each phase: regression on `learned`, errors on `tested`.

    Values that are the same in all of `learned`, or missing in some, are left out.

    Raises:
        UserError: there is no such value, or no phase that all episodes have.
    """
    values = _common_values([*learned, *tested])
    values = [value for value in values if np.ptp(_values(learned, value)) > 0]
    seen, seen_tested = (_at_ends(vision, episodes) for episodes in (learned, tested))
    phases = sorted(set.intersection(*(set(ends) for ends in (*seen, *seen_tested))))
    if not values or not phases:
        raise UserError("the sequences have no phase, or no varying value, in common")
    probes = []
    for phase in phases:
        features, features_tested = (
            np.stack([ends[phase] for ends in each]).astype(np.float64)
            for each in (seen, seen_tested)
        )
        for value in values:
            known, truth = _values(learned, value), _values(tested, value)
            told = ridge_regression(features, known, features_tested)
            error, blind = (np.abs(said - truth).mean() for said in (told, known.mean()))
            probes.append(Probe(phase, value, float(error), float(blind)))
    return probes


def ridge_regression(features: Array, values: Array, others: Array) -> Array:
    """Predict the values (m,) of others (m, F) from features (n, F) and their values (n,).

    Of the penalties the one is taken with which everything with one value is told best from all
    that has other values: it should tell what lies between the values that it knows.
    """
    mean_features, mean = features.mean(0), values.mean()
    centred = features - mean_features
    strengths, directions = np.linalg.eigh(centred @ centred.T)

    def error_between(penalty: float) -> float:
        shares = directions * (strengths / (strengths + penalty))
        return _left_out_error(shares @ directions.T + 1 / len(values), values)

    best = min(PENALTIES * strengths.sum() / len(values), key=error_between)
    weights = centred.T @ (directions / (strengths + best)) @ (directions.T @ (values - mean))
    return np.asarray(mean + (others - mean_features) @ weights)


def _left_out_error(smoother: Array, values: Array) -> float:
    """Squared error of what is told of all with one value by those that have other values.

    For a linear smoother (n, n) it follows from the residues with nothing left out.
    """
    residues = values - smoother @ values
    groups = [np.flatnonzero(values == value) for value in np.unique(values)]
    left_out = [
        np.linalg.solve(np.eye(len(group)) - smoother[np.ix_(group, group)], residues[group])
        for group in groups
    ]
    return float(np.square(np.concatenate(left_out)).sum())


def _at_ends(vision: Vision, episodes: Sequence[Episode]) -> list[dict[int, NDArray[np.float32]]]:
    """V_S (units,) at the last step of each phase, for each episode."""
    found = []
    for episode in episodes:
        seen = vision.see(episode)
        ends = np.flatnonzero(np.diff(episode.phases.astype(int), append=-1))
        found.append({int(episode.phases[end]): seen[end] for end in ends})
    return found


def _common_values(episodes: Sequence[Episode]) -> list[str]:
    common = set.intersection(*(set(episode.situation) for episode in episodes))
    return [value for value in episodes[0].situation if value in common]


def _values(episodes: Sequence[Episode], value: str) -> Array:
    return np.array([episode.situation[value] for episode in episodes])


def _tensors(checkpoint: Checkpoint, prefix: str) -> Mapping[str, torch.Tensor]:
    return {name: torch.tensor(array) for name, array in checkpoint.part(prefix).items()}
