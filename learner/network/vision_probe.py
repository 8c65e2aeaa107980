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

from learner.checkpoint import CLASSIFIER_PREFIX, NETWORK_PREFIX, Checkpoint, Classes
from learner.network.mtrnn import run_levels
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import Value, number_of

Array = NDArray[np.float64]

PENALTIES: Final = np.logspace(-7, 1, 17)
"""Of the regression, as parts of the features' mean square."""


@dataclass(frozen=True)
class Answer:
    """How well the classifier answered for a variable, at the end of the window of its question.

    Attributes:
        value: name of the variable.
        classes: how many there are.
        right: share of sequences for which the right class, or the nearest one, got the highest
            answer.
        error: mean distance of the truth from the mean of the classes under the answer; None for a
            discrete variable.
    """

    value: str
    classes: int
    right: float
    error: float | None


@dataclass(frozen=True)
class Probe:
    """How well a regression from V_S at the end of a phase tells a value of other sequences.

    Attributes:
        phase: name of the phase.
        value: name of the situation's value.
        error: mean distance from the truth.
        blind_error: the same for whoever sees nothing and says the mean.
    """

    phase: str
    value: str
    error: float
    blind_error: float


class Vision:
    """V_F and V_S of a checkpoint and, if it is from pre-training, its classifier.

    Attributes:
        classes: the classifier's classes by name of the variable; empty without a classifier.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        training = checkpoint.metadata.training
        self.classes = {} if training is None else training.classes
        self._windows = {} if training is None else training.windows
        self._network = VMDNN(checkpoint.metadata.network)
        self._network.load_state_dict(_tensors(checkpoint, NETWORK_PREFIX))
        self._classifier = _tensors(checkpoint, CLASSIFIER_PREFIX)

    @torch.no_grad()
    def see(self, episode: Episode) -> NDArray[np.float32]:
        """V_S (T, units) in an episode."""
        images = torch.from_numpy(vision_input(episode.images))
        return np.asarray(self._network.see(images[None])[0])

    @torch.no_grad()
    def answer(self, seen: NDArray[np.float32]) -> dict[str, Array]:
        """What the classifier says about V_S (T, units): shares (classes,) by name of the variable.

        Each answer is that at the end of the window in which the variable is asked for.
        """
        pfc = run_levels([self._network.pfc], torch.from_numpy(seen)[None], "bottom_up")[0]
        sizes = [len(classes) for classes in self.classes.values()]
        starts = np.cumsum([0, *sizes])
        answers = {}
        for name, start, size in zip(self.classes, starts, sizes, strict=False):
            _, window_end = self._windows.get(name, (0.0, 1.0))
            step = max(int(len(seen) * window_end) - 1, 0)
            rows = slice(start, start + size)
            sums = self._classifier["weight"][rows] @ pfc[step] + self._classifier["bias"][rows]
            answers[name] = np.asarray(torch.softmax(sums.double(), dim=0))
        return answers


def ask_classifier(vision: Vision, episodes: Sequence[Episode]) -> list[Answer]:
    """How well the classifier answers, value by value; nothing if there is none."""
    said = [vision.answer(vision.see(episode)) for episode in episodes] if vision.classes else []
    answers = []
    for name, classes in vision.classes.items():
        shares = np.stack([answer[name] for answer in said])
        truth = [episode.situation[name] for episode in episodes]
        answers.append(_answer(name, classes, shares, truth))
    return answers


def _answer(name: str, classes: Classes, shares: Array, truth: Sequence[Value]) -> Answer:
    """How well answers (N, classes) fit the true values of a variable."""
    said = shares.argmax(1)
    if isinstance(classes[0], str):
        right = np.array(
            [classes[index] == value for index, value in zip(said, truth, strict=True)]
        )
        return Answer(name, len(classes), float(right.mean()), None)
    centres, values = np.asarray(classes, float), np.asarray(truth, float)
    right = said == np.abs(values[:, None] - centres).argmin(1)
    error = float(np.abs(shares @ centres - values).mean())
    return Answer(name, len(classes), float(right.mean()), error)


def probe(vision: Vision, learned: Sequence[Episode], tested: Sequence[Episode]) -> list[Probe]:
    """What V_S tells at the end of each phase: regression on `learned`, errors on `tested`.

    Discrete variables are left out, and those that never change in `learned` or that some lack.

    Raises:
        UserError: there is no such value, or no phase that all episodes have.
    """
    values = _common_values([*learned, *tested])
    values = [value for value in values if np.ptp(_values(learned, value)) > 0]
    seen, seen_tested = (_at_ends(vision, episodes) for episodes in (learned, tested))
    shared = set.intersection(*(set(ends) for ends in (*seen, *seen_tested)))
    phases = [phase for phase in seen[0] if phase in shared]
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


def _at_ends(vision: Vision, episodes: Sequence[Episode]) -> list[dict[str, NDArray[np.float32]]]:
    """V_S (units,) at the last step of each phase, for each episode."""
    found = []
    for episode in episodes:
        seen = vision.see(episode)
        ends = np.flatnonzero(np.diff(episode.phases.astype(int), append=-1))
        found.append({episode.phase_names[episode.phases[end]]: seen[end] for end in ends})
    return found


def _common_values(episodes: Sequence[Episode]) -> list[str]:
    common = set.intersection(*(set(episode.situation) for episode in episodes))
    situation = episodes[0].situation
    return [name for name in situation if name in common and not isinstance(situation[name], str)]


def _values(episodes: Sequence[Episode], value: str) -> Array:
    return np.array([number_of(episode.situation, value) for episode in episodes])


def _tensors(checkpoint: Checkpoint, prefix: str) -> Mapping[str, torch.Tensor]:
    return {name: torch.tensor(array) for name, array in checkpoint.part(prefix).items()}
