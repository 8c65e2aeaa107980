"""The plane of the PFC's two main components, computed from tutored sequences."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from learner.checkpoint import NETWORK_PREFIX, load_checkpoint
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import Parameters
from learner.network.vision_input import vision_input
from proto.episode import Floats, Image, Kind
from proto.errors import UserError
from proto.plain_text import plain
from proto.recordings.episodes import read_episode
from services.archive import Recording, RunArchive
from services.figures.components import Array, Components

LOG = logging.getLogger(__name__)

SEQUENCES: Final = 12
"""So many tutored sequences span the plane."""
DRAWN_EVERY: Final = 2
"""Every second step of a tutored sequence is drawn."""


@dataclass(frozen=True)
class Plane:
    """The plane of the PFC's states in tutored sequences, as a policy sees them.

    Attributes:
        version: version of the policy.
        components: the two main components.
        phase_names: names of the phases.
        paths: for each sequence its points (T, 2), and the index (T,) of the phase of each.
    """

    version: int
    components: Components
    phase_names: Sequence[str]
    paths: Sequence[tuple[Floats, Floats]]

    def project(self, states: Floats) -> Floats:
        """Project states (T, units); (T, 2)."""
        return self.components.project(states.astype(np.float64)).astype(np.float32)

    def fits(self, version: int, units: int) -> bool:
        """Whether states of a policy version lie in the plane."""
        return version == self.version and units == len(self.components.mean)

    def as_json(self) -> dict[str, Any]:
        """The plane for the page."""
        return {
            "version": self.version,
            "explained": np.round(self.components.explained, 3).tolist(),
            "phases": list(self.phase_names),
            "sequences": len(self.paths),
            "paths": [
                [*np.round(points.T, 3).tolist(), phases.tolist()]
                for points, phases in (
                    (points[::DRAWN_EVERY], phases[::DRAWN_EVERY]) for points, phases in self.paths
                )
            ],
        }


class PlaneMaker:
    """Makes the plane of a run's newest policy, and again when there is a newer one."""

    def __init__(self, archive: RunArchive, task: str) -> None:
        """Make nothing yet.

        Args:
            archive: the files of the run.
            task: name of the run's task.
        """
        self._archive = archive
        self._task = task
        self._made_of: tuple[Path, int] | None = None
        self.plane: Plane | None = None

    def look(self) -> None:
        """Make the plane if there is a policy and a sequence, and one of them is new."""
        policy = self._archive.newest_policy()
        tutored = [
            each
            for each in self._archive.tutored()
            if each.heading.kind is Kind.TUTORING and each.heading.task == self._task
        ]
        chosen = tutored[:: max(1, len(tutored) // SEQUENCES)][:SEQUENCES]
        if policy is None or not chosen or self._made_of == (policy, len(chosen)):
            return
        self._made_of = (policy, len(chosen))
        try:
            self.plane = _plane(policy, chosen)
        except UserError as error:  # such as a file that has just been deleted
            LOG.warning("the plane of the PFC cannot be computed: %s", plain(error, 300))


def _plane(policy_file: Path, recordings: Sequence[Recording]) -> Plane:
    checkpoint = load_checkpoint(policy_file)
    # In numpy: the compiled network would need torch in this process.
    network = NumpyNetwork(
        checkpoint.metadata.network, cast("Parameters", checkpoint.part(NETWORK_PREFIX))
    )
    episodes = [read_episode(each.path) for each in recordings]
    states = [_states(network, episode.images) for episode in episodes]
    components = Components.of(np.concatenate(states))
    return Plane(
        version=checkpoint.metadata.version,
        components=components,
        phase_names=episodes[0].phase_names,
        paths=[
            (components.project(each).astype(np.float32), episode.phases.astype(np.float32))
            for each, episode in zip(states, episodes, strict=True)
        ],
    )


def _states(network: NumpyNetwork, images: Image) -> Array:
    """Activity (T, units) of the PFC of a network that sees images (T, 48, 64)."""
    network.reset()
    states = []
    for image in images:
        network.step(vision_input(image))
        states.append(network.pfc())
    return np.stack(states).astype(np.float64)
