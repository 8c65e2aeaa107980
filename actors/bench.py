"""How fast an actor plays on this machine, and what its loop costs beside the simulator."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from statistics import median
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from actors.actor import Assignment, live_message
from actors.attention import crop_of_focus, targets_of_action
from actors.player import LiveStep, play
from actors.policies.contract import Policy
from actors.policies.planned import make_tutor
from actors.simulator import Simulator, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from learner.checkpoint import NETWORK_PREFIX, Checkpoint, CheckpointMetadata, CodeRanges
from learner.network.numpy_network import NumpyNetwork, Parameters, make_acting_network
from learner.network.subnets import parameter_shapes
from learner.network.vision_input import vision_input
from learner.network_policy import NetworkPolicy
from proto.body import ACTION_VALUES, FOCUS
from proto.codec import encode
from proto.config import Config, NetworkConfig
from proto.episode import Floats, Image, Kind
from proto.machine import machine_name
from proto.messages import Rollout
from proto.metrics import Stage
from proto.variables import Situation

ROUNDS: Final = 7
LIMIT_S: Final = 17.0
"""No further round begins after so long."""


@dataclass(frozen=True)
class ActorSpeed:
    """What `bench_actor` measured; medians, which other work on the machine disturbs least.

    Attributes:
        machine: processor and number of cores.
        backend: name of the simulator.
        physics_ms: time of one physics step.
        render_ms: time of one observation, rendering and all.
        network_ms: time of one step of the network, from picture to action, as it acts.
        network_numpy_ms: the same in numpy, as it acts where nothing can be compiled.
        core_ms: the part of `network_ms` that PFC, M_S, M_F and M_O take.
        steps_per_s: control steps per second of the actor's whole loop.
        ratio: processor time of the whole loop over that of the bare simulator doing the same;
            waiting, such as for a core that others use, does not count.
        episode_s: time of one tutored episode.
    """

    machine: str
    backend: str
    physics_ms: float
    render_ms: float
    network_ms: float
    network_numpy_ms: float
    core_ms: float
    steps_per_s: float
    ratio: float
    episode_s: float


def bench_actor(config: Config) -> ActorSpeed:
    """Measure an actor in less than half a minute.

    The whole loop is an episode as the actor's process plays it while someone watches: observing,
    the network, judging, recording, and encoding what goes to the bus. The bare loop does the same
    in the simulator, and nothing else. They take turns, an episode each: a loop that another
    interrupted at every step would find its data gone from the caches.

    Raises:
        UserError: the simulator cannot run on this machine.
    """
    task = make_task(config.task)
    situation = task.tutored()[len(task.tutored()) // 2]
    with closing(make_simulator(config.simulator)) as simulator:
        theatre = _Theatre(simulator, task, situation)
        tutor = make_tutor(task)
        checkpoint = _random_checkpoint(config.network)
        pupil = _Pupil(NetworkPolicy(checkpoint, "the benchmark"), task.plan(situation))
        others = _OtherNetworks(checkpoint)
        tutored = _Laps()
        theatre.play(tutor)  # warms up
        end = time.perf_counter() + LIMIT_S
        for number in range(ROUNDS):
            if number > 0 and time.perf_counter() > end:
                break
            theatre.play_bare(pupil.actions)
            theatre.play_measured(pupil)
            if number % 2 == 0:  # the ratio needs more rounds than these
                with tutored:
                    theatre.play(tutor)
                theatre.play(tutor, others.step)
    return ActorSpeed(
        machine=machine_name(),
        backend=simulator.name,
        physics_ms=1e3 * median(theatre.physics) / config.simulator.substeps,
        render_ms=1e3 * median(theatre.render),
        network_ms=1e3 * median(pupil.network_laps),
        network_numpy_ms=1e3 * median(others.numpy_laps),
        core_ms=1e3 * median(others.core_laps),
        steps_per_s=1.0 / median(theatre.whole_time),
        ratio=theatre.whole_work.typical() / theatre.bare_work.typical(),
        episode_s=median(tutored),
    )


class _Laps(list[float]):
    """How long laps took, in seconds."""

    def __enter__(self) -> None:
        self._started = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.append(time.perf_counter() - self._started)


class _Rounds:
    """Processor time that each control step of the same episode took, round after round."""

    def __init__(self) -> None:
        self._rounds: list[list[float]] = []
        self._began = math.nan

    def begin(self) -> None:
        """Start a round."""
        self._rounds.append([])
        self._began = math.nan

    def lap(self) -> None:
        """A control step is over; the first time it only begins."""
        self._rounds[-1].append(time.process_time() - self._began)
        self._began = time.process_time()

    def typical(self) -> float:
        """Seconds of all steps, each its median over the rounds."""
        return float(np.median(self._rounds, axis=0)[1:].sum())


class _Theatre:
    """Plays one situation in several ways, and measures them."""

    def __init__(self, simulator: Simulator, task: Task, situation: Situation) -> None:
        self.whole_time, self.render, self.physics = _Laps(), _Laps(), _Laps()
        self.whole_work, self.bare_work = _Rounds(), _Rounds()
        self._simulator = simulator
        self._task = task
        self._situation = situation

    def play_bare(self, actions: NDArray[np.float64]) -> None:
        """The simulator alone."""
        self._simulator.reset(self._task.scene(self._situation))
        self.bare_work.begin()
        focus = float(self._task.start[FOCUS])
        for action in actions:
            with self.render:
                self._simulator.observe(crop_of_focus(focus))
            self.bare_work.lap()
            with self.physics:
                self._simulator.step(targets_of_action(action))
            focus = float(action[FOCUS])

    def play_measured(self, policy: Policy) -> None:
        """The whole loop."""
        self.whole_work.begin()
        began = time.perf_counter()
        self.play(policy, lambda _: self.whole_work.lap())
        self.whole_time.append((time.perf_counter() - began) / len(self._task.phases))

    def play(self, policy: Policy, on_image: Callable[[Image], None] | None = None) -> None:
        """An episode as the actor's process plays it, but for the wire itself."""
        assignment = Assignment(Kind.TRIAL, self._task, policy, self._situation, seed=0)

        def on_step(live: LiveStep) -> None:
            encode(live_message("bench", assignment, live), check=False)
            if on_image is not None:
                on_image(live.image)

        episode = play(
            self._simulator,
            self._task,
            policy,
            self._situation,
            seed=assignment.seed,
            kind=assignment.kind,
            on_step=on_step,
        )
        encode(Rollout(episode, "bench"))


class _Pupil:
    """Steps a network, but does as the tutor would: all of its work, and a real grasp."""

    name = "bench"
    version = 0
    looks = True
    target: NDArray[np.float64] | None = None

    def __init__(self, network: NetworkPolicy, actions: NDArray[np.float64]) -> None:
        self.actions = actions
        self.outputs: Floats | None = None
        self.network_laps = _Laps()
        self._network = network

    def begin(self, situation: Situation, seed: int) -> None:
        self._network.begin(situation, seed)
        self._next = iter(self.actions)

    def step(self, image: Image) -> NDArray[np.float64]:
        with self.network_laps:
            self._network.step(image)
        self.outputs = self._network.outputs
        return next(self._next)


class _OtherNetworks:
    """The network again, in numpy and in parts, to be measured beside the one that acts."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.numpy_laps, self.core_laps = _Laps(), _Laps()
        parameters = cast("Parameters", checkpoint.part(NETWORK_PREFIX))
        self._numpy = NetworkPolicy(checkpoint, "the benchmark", NumpyNetwork)
        self._parts = make_acting_network(checkpoint.metadata.network, parameters)

    def step(self, image: Image) -> None:
        """One step of each."""
        with self.numpy_laps:
            self._numpy.step(image)
        seen = self._parts.see(vision_input(image))
        with self.core_laps:
            self._parts.act(seen)


def _random_checkpoint(config: NetworkConfig) -> Checkpoint:
    """A network of the configured sizes that has learned nothing."""
    rng = np.random.default_rng(0)
    tensors = {
        NETWORK_PREFIX + name: rng.uniform(-0.1, 0.1, shape).astype(np.float32)
        for name, shape in parameter_shapes(config).items()
    }
    metadata = CheckpointMetadata(
        run="bench",
        version=0,
        stage=Stage.COUPLED,
        epoch=0,
        loss=None,
        config_digest="",
        network=config,
        code=CodeRanges(
            minima=tuple(value.minimum for value in ACTION_VALUES),
            maxima=tuple(value.maximum for value in ACTION_VALUES),
        ),
    )
    return Checkpoint(metadata, tensors)
