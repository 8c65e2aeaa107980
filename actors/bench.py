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

from actors.attention import crop_of_focus, targets_of_action
from actors.player import LiveStep, play
from actors.policies import make_tutor
from actors.policy import Policy
from actors.process import Assignment, live_message
from actors.simulator import Simulator, make_simulator
from actors.tasks.registry import make_task
from actors.tasks.task import Situation, Task
from actors.tutor.plan import plan
from learner.checkpoint import NETWORK_PREFIX, Checkpoint, CheckpointMetadata, CodeRanges
from learner.policy import NetworkPolicy
from learner.stepping import Parameters, SteppingNetwork, make_acting_network
from learner.subnets import parameter_shapes
from learner.vision_input import vision_input
from proto.action import ACTION_VALUES, FOCUS
from proto.codec import encode
from proto.config import Config, NetworkConfig
from proto.episode import Floats, Image, Kind
from proto.machine import machine_name
from proto.messages import Rollout
from proto.metrics import Stage

ROUNDS: Final = 5
LIMIT_S: Final = 15.0
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
        ratio: processor time of one step of the whole loop over that of the bare simulator doing
            the same; waiting, such as for a core that others use, does not count.
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

    The whole loop is an episode as the actor's process plays it: observing, the network, judging,
    recording, and encoding what goes to the bus. In each of its steps a second simulator does the
    same with the same scene and action, and nothing else: the bare loop. Taking turns so often,
    both meet the same machine.

    Raises:
        UserError: the simulator cannot run on this machine.
    """
    task = make_task(config.task)
    situation = task.tutored()[len(task.tutored()) // 2]
    tutor = make_tutor(config, noisy=False)
    checkpoint = random_checkpoint(config.network)
    pupil = _Pupil(NetworkPolicy(checkpoint, "the benchmark"), plan(situation))
    others = _OtherNetworks(checkpoint)
    tutored = _Laps()
    with (
        closing(make_simulator(config.simulator)) as simulator,
        closing(make_simulator(config.simulator)) as second,
    ):
        _play(simulator, task, tutor, situation)  # warms up
        shadow = _Shadow(second, task, others)
        end = time.perf_counter() + LIMIT_S
        while len(tutored) < ROUNDS and (not tutored or time.perf_counter() < end):
            shadow.begin(situation)
            _play(simulator, task, pupil, situation, shadow)
            with tutored:
                _play(simulator, task, tutor, situation)
        backend = simulator.name
    return ActorSpeed(
        machine=machine_name(),
        backend=backend,
        physics_ms=1e3 * median(shadow.physics) / config.simulator.substeps,
        render_ms=1e3 * median(shadow.render),
        network_ms=1e3 * median(pupil.network_laps),
        network_numpy_ms=1e3 * median(others.numpy_laps),
        core_ms=1e3 * median(others.core_laps),
        steps_per_s=1.0 / median(shadow.whole_loop),
        ratio=median(shadow.whole_work) / median(shadow.bare_work),
        episode_s=median(tutored),
    )


class _Laps(list[float]):
    """How long laps took, in seconds of a clock."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        super().__init__()
        self._clock = clock
        self._started = math.nan

    def start(self) -> None:
        self._started = self._clock()

    def stop(self) -> None:
        self.append(self._clock() - self._started)

    def __enter__(self) -> None:
        self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()


class _Pupil:
    """Steps a network, but does as the tutor would: all of its work, and a real grasp."""

    name = "bench"
    version = 0
    looks = True
    target: NDArray[np.float64] | None = None

    def __init__(self, network: NetworkPolicy, actions: NDArray[np.float64]) -> None:
        self.outputs: Floats | None = None
        self.network_laps = _Laps()
        self._network = network
        self._actions = actions

    def begin(self, situation: Situation, seed: int) -> None:
        self._network.begin(situation, seed)
        self._next = iter(self._actions)

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
        self._numpy = NetworkPolicy(checkpoint, "the benchmark", SteppingNetwork)
        self._parts = make_acting_network(checkpoint.metadata.network, parameters)

    def step(self, image: Image) -> None:
        """One step of each."""
        with self.numpy_laps:
            self._numpy.step(image)
        seen = self._parts.see(vision_input(image))
        with self.core_laps:
            self._parts.act(seen)


def random_checkpoint(config: NetworkConfig) -> Checkpoint:
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


class _Shadow:
    """Does in a simulator of its own what another is told, step by step, and measures both."""

    def __init__(self, simulator: Simulator, task: Task, networks: _OtherNetworks) -> None:
        self.whole_loop, self.render, self.physics = _Laps(), _Laps(), _Laps()
        self.whole_work, self.bare_work = _Laps(time.process_time), _Laps(time.process_time)
        self._simulator = simulator
        self._task = task
        self._networks = networks

    def begin(self, situation: Situation) -> None:
        """Start an episode."""
        self._simulator.reset(self._task.scene(situation))
        self._focus = float(self._task.start[FOCUS])
        self._first = True

    def follow(self, live: LiveStep) -> None:
        """Observe and run one control step; between two calls the other loop goes round once."""
        if not self._first:
            self.whole_loop.stop()
            self.whole_work.stop()
        with self.bare_work:
            with self.render:
                self._simulator.observe(crop_of_focus(self._focus))
            with self.physics:
                self._simulator.step(targets_of_action(live.action))
        self._networks.step(live.image)
        self._focus = float(live.action[FOCUS])
        self._first = False
        self.whole_loop.start()
        self.whole_work.start()


def _play(
    simulator: Simulator,
    task: Task,
    policy: Policy,
    situation: Situation,
    shadow: _Shadow | None = None,
) -> None:
    """An episode as the actor's process plays it, but for the wire itself."""
    assignment = Assignment(Kind.TRIAL, task, policy, situation, seed=0)

    def on_step(live: LiveStep) -> None:
        encode(live_message("bench", assignment, live), check=False)
        if shadow is not None:
            shadow.follow(live)

    episode = play(
        simulator, task, policy, situation, seed=0, kind=assignment.kind, on_step=on_step
    )
    encode(Rollout(episode, "bench"))
