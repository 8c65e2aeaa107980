"""How well a situation can be read from the activity of the vision.

Two measures: the classifier of pre-training, and a linear regression from V_S. The classifier was
trained for this. The regression shows whether V_S also distinguishes situations between the
classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from learner.checkpoint import CLASSIFIER_PREFIX, NETWORK_PREFIX, Checkpoint, Classes
from learner.network.mtrnn import run_levels
from learner.network.vision_input import vision_input
from learner.network.vmdnn import VMDNN
from learner.tensors import to_tensors
from proto.episode import Episode
from proto.errors import UserError
from proto.variables import number_of

Array = NDArray[np.float64]

PENALTIES: Final = np.logspace(-7, 1, 17)
"""Penalties of the regression that are tried, as fractions of the features' mean square."""


@dataclass(frozen=True)
class ClassifierScore:
    """How well the classifier read a variable, at the end of the window of its question.

    Attributes:
        value: name of the variable.
        classes: how many there are.
        right: fraction of sequences for which the nearest class got the highest probability.
        error: mean distance of the value from the mean of the classes under the probabilities; None
            for a discrete variable.
    """

    value: str
    classes: int
    right: float
    error: float | None


@dataclass(frozen=True)
class RegressionScore:
    """How well a regression from V_S at the end of a phase predicts a value of other sequences.

    Attributes:
        phase: name of the phase.
        value: name of the variable.
        error: mean distance of the prediction from the value.
        blind_error: the same for a prediction without vision, the mean of the learned sequences.
    """

    phase: str
    value: str
    error: float
    blind_error: float


class Vision:
    """V_F and V_S of a checkpoint and, if it is from pre-training, its classifier.

    Attributes:
        asked: what the classifier was asked, by name of the variable; empty without a classifier.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        training = checkpoint.metadata.training
        self.asked = {} if training is None else training.asked
        self._network = VMDNN(checkpoint.metadata.network)
        self._network.load_state_dict(to_tensors(checkpoint.part(NETWORK_PREFIX)))
        self._classifier = to_tensors(checkpoint.part(CLASSIFIER_PREFIX))

    @torch.no_grad()
    def see(self, episode: Episode) -> NDArray[np.float32]:
        """V_S (T, units) in an episode."""
        images = torch.from_numpy(vision_input(episode.images))
        return np.asarray(self._network.see(images[None])[0])

    @torch.no_grad()
    def classify(self, seen: NDArray[np.float32]) -> dict[str, Array]:
        """Probabilities of the classes of each variable for V_S (T, units), by its name.

        They are those at the end of the window in which the variable is asked for.
        """
        pfc = run_levels([self._network.pfc], torch.from_numpy(seen)[None], "bottom_up")[0]
        sums = pfc @ self._classifier["weight"].T + self._classifier["bias"]
        parts = torch.split(sums, [len(each.classes) for each in self.asked.values()], dim=1)
        probabilities = {}
        for (name, each), part in zip(self.asked.items(), parts, strict=True):
            last = max(int(len(seen) * each.window[1]) - 1, 0)
            probabilities[name] = np.asarray(torch.softmax(part[last].double(), dim=0))
        return probabilities


def score_classifier(vision: Vision, episodes: Sequence[Episode]) -> list[ClassifierScore]:
    """How well the classifier reads each variable; empty without a classifier."""
    if not vision.asked:
        return []
    probabilities = [vision.classify(vision.see(episode)) for episode in episodes]
    return [
        _score(name, asked.classes, np.stack([each[name] for each in probabilities]), episodes)
        for name, asked in vision.asked.items()
    ]


def _score(
    name: str, classes: Classes, shares: Array, episodes: Sequence[Episode]
) -> ClassifierScore:
    """The score of probabilities (N, classes) of a variable's classes in N episodes."""
    answers = shares.argmax(1)
    if isinstance(classes[0], str):
        truth = [classes.index(str(episode.situation[name])) for episode in episodes]
        right = float(np.mean(answers == np.array(truth)))
        return ClassifierScore(name, len(classes), right, error=None)
    centres, values = np.asarray(classes, np.float64), _values(episodes, name)
    nearest = np.abs(values[:, None] - centres).argmin(1)
    error = float(np.abs(shares @ centres - values).mean())
    return ClassifierScore(name, len(classes), float((answers == nearest).mean()), error)


def score_regression(
    vision: Vision, learned: Sequence[Episode], tested: Sequence[Episode]
) -> list[RegressionScore]:
    """How well V_S at the end of each phase predicts each value, by linear regression.

    Args:
        vision: the vision.
        learned: sequences that the regression is fitted to.
        tested: sequences that it is tested on.

    Returns:
        Scores by phase and variable. Discrete variables are left out, and those that are the same
        in all of `learned` or missing in some episode.

    Raises:
        UserError: no value is left, or no phase occurs in all episodes.
    """
    values = _common_values([*learned, *tested])
    values = [value for value in values if np.ptp(_values(learned, value)) > 0]
    seen, seen_tested = (_at_ends(vision, episodes) for episodes in (learned, tested))
    shared = set.intersection(*(set(ends) for ends in (*seen, *seen_tested)))
    phases = [phase for phase in seen[0] if phase in shared]
    if not values or not phases:
        raise UserError("the sequences have no phase, or no varying value, in common")
    scores = []
    for phase in phases:
        features, features_tested = (
            np.stack([ends[phase] for ends in each]).astype(np.float64)
            for each in (seen, seen_tested)
        )
        for value in values:
            known, truth = _values(learned, value), _values(tested, value)
            predicted = ridge_regression(features, known, features_tested)
            error, blind = (np.abs(each - truth).mean() for each in (predicted, known.mean()))
            scores.append(RegressionScore(phase, value, float(error), float(blind)))
    return scores


def ridge_regression(features: Array, values: Array, others: Array) -> Array:
    """Predict values (m,) for features (m, F) from features (n, F) and their values (n,).

    The penalty is chosen by cross-validation: all samples with one value are left out together, so
    that the regression is judged by values that it has not seen.
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
    """Squared error of cross-validation in which all samples with one value are left out together.

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
