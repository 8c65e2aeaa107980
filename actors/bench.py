"""How fast an actor plays on this machine, and what its loop costs besides the simulator."""

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
from actors.simulator import Simulator, installed_backends, make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from learner.checkpoint import NETWORK_PREFIX, Checkpoint, CheckpointMetadata, CodeRanges
from learner.network.acting import make_acting_network
from learner.network.numpy_network import NumpyNetwork
from learner.network.subnets import Parameters, parameter_shapes
from learner.network.vision_input import vision_input
from learner.network_policy import NetworkPolicy
from proto.body import ACTION_VALUES, FOCUS
from proto.codec import encode
from proto.config import Config, NetworkConfig
from proto.episode import Floats, Image, Kind
from proto.errors import UserError
from proto.machine import machine_name
from proto.messages import Rollout
from proto.metrics import Stage
from proto.variables import Situation

REPETITIONS: Final = 7
"""How often the loops that are compared are run."""
LIMIT_S: Final = 17.0
"""No further repetition begins after this time."""


@dataclass(frozen=True)
class ActorSpeed:
    """What `bench_actor` measured; medians, because other work on the machine disturbs them least.

    Attributes:
        machine: processor and number of cores.
        backend: name of the simulator.
        physics_ms: time of one physics step.
        render_ms: time of one observation, with its rendering.
        network_ms: time of one step of the network, from picture to action.
        network_numpy_ms: the same in numpy, which acts where nothing can be compiled.
        core_ms: the part of `network_ms` that PFC, M_S, M_F and M_O take.
        steps_per_s: control steps per second of the actor's whole loop.
        ratio: processor time of the whole loop, divided by that of the simulator alone in the same
            episode. Waiting, such as for a core that others use, does not count.
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


def bench_backends(config: Config) -> tuple[list[ActorSpeed], dict[str, str]]:
    """Measure an actor with each installed backend, that of the configuration first.

    Returns:
        What was measured; and for each backend that cannot run on this machine, why.

    Raises:
        UserError: the backend of the configuration cannot run on this machine.
    """
    chosen = config.simulator.backend
    speeds, problems = [bench_actor(config)], {}
    for name in installed_backends():
        if name != chosen:
            simulator = config.simulator.model_copy(update={"backend": name})
            try:
                speeds.append(bench_actor(config.model_copy(update={"simulator": simulator})))
            except UserError as error:
                problems[name] = str(error)
    return speeds, problems


def bench_actor(config: Config) -> ActorSpeed:
    """Measure an actor in less than half a minute.

    The whole loop is an episode as the actor's process plays it while someone watches: observing,
    the network, judging, recording, and encoding what goes to the bus. It is compared with the same
    actions in the simulator alone. The two take turns, an episode each: if they alternated step by
    step, each would find its data gone from the processor's caches.

    Raises:
        UserError: the simulator cannot run on this machine.
    """
    task = make_task(config.task)
    situation = task.tutored()[len(task.tutored()) // 2]
    with closing(make_simulator(config.simulator)) as simulator:
        runner = _EpisodeRunner(simulator, task, situation)
        tutor = make_tutor(task)
        checkpoint = random_checkpoint(config.network)
        policy = _TimedNetworkPolicy(
            NetworkPolicy(checkpoint, "the benchmark"), task.plan(situation)
        )
        variants = _NetworkVariants(checkpoint)
        tutored_timer = _Timer()
        runner.run(tutor)  # warms up
        end = time.perf_counter() + LIMIT_S
        for repetition in range(REPETITIONS):
            if repetition > 0 and time.perf_counter() > end:
                break
            runner.run_simulator_alone(policy.actions)
            runner.run_whole_loop(policy)
            if repetition % 2 == 0:  # the ratio needs more repetitions than the rest
                with tutored_timer:
                    runner.run(tutor)
                runner.run(tutor, variants.step)
    return ActorSpeed(
        machine=machine_name(),
        backend=simulator.name,
        physics_ms=1e3 * median(runner.physics_timer) / config.simulator.substeps,
        render_ms=1e3 * median(runner.render_timer),
        network_ms=1e3 * median(policy.network_timer),
        network_numpy_ms=1e3 * median(variants.numpy_timer),
        core_ms=1e3 * median(variants.core_timer),
        steps_per_s=1.0 / median(runner.step_times_s),
        ratio=runner.whole_loop_work.episode_s() / runner.simulator_work.episode_s(),
        episode_s=median(tutored_timer),
    )


class _Timer(list[float]):
    """Times a block of code each time it is run: `with timer: ...`. Its items are in seconds."""

    def __enter__(self) -> None:
        self._started_s = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.append(time.perf_counter() - self._started_s)


class _StepWork:
    """Processor time of each control step of an episode that is run again and again."""

    def __init__(self) -> None:
        self._episodes_s: list[list[float]] = []
        self._step_began_s = math.nan

    def begin_episode(self) -> None:
        """Begin an episode; it must have as many steps as those before it."""
        self._episodes_s.append([])
        self._step_began_s = math.nan

    def end_step(self) -> None:
        """Record the step that ends now. The first step of an episode has no known beginning."""
        self._episodes_s[-1].append(time.process_time() - self._step_began_s)
        self._step_began_s = time.process_time()

    def episode_s(self) -> float:
        """Seconds of all steps but the first, each step the median over the episodes."""
        return float(np.median(self._episodes_s, axis=0)[1:].sum())


class _EpisodeRunner:
    """Runs the episode of one situation in several ways, and measures them.

    Attributes:
        render_timer: one observation, in the simulator alone.
        physics_timer: one control step, in the simulator alone.
        step_times_s: mean time of a control step of the whole loop, for each episode.
        simulator_work: processor time of the simulator alone.
        whole_loop_work: processor time of the whole loop.
    """

    def __init__(self, simulator: Simulator, task: Task, situation: Situation) -> None:
        self.render_timer, self.physics_timer = _Timer(), _Timer()
        self.step_times_s: list[float] = []
        self.simulator_work, self.whole_loop_work = _StepWork(), _StepWork()
        self._simulator = simulator
        self._task = task
        self._situation = situation

    def run_simulator_alone(self, actions: NDArray[np.float64]) -> None:
        """Run the simulator with actions (T, 11), and nothing else."""
        self._simulator.reset(self._task.scene(self._situation))
        self.simulator_work.begin_episode()
        focus = float(self._task.start[FOCUS])
        for action in actions:
            with self.render_timer:
                self._simulator.observe(crop_of_focus(focus))
            self.simulator_work.end_step()
            with self.physics_timer:
                self._simulator.step(targets_of_action(action))
            focus = float(action[FOCUS])

    def run_whole_loop(self, policy: Policy) -> None:
        """Run the actor's loop with a policy, and measure it."""
        self.whole_loop_work.begin_episode()
        began_s = time.perf_counter()
        self.run(policy, lambda _: self.whole_loop_work.end_step())
        self.step_times_s.append((time.perf_counter() - began_s) / len(self._task.phases))

    def run(self, policy: Policy, on_image: Callable[[Image], None] | None = None) -> None:
        """Run an episode as the actor's process plays it, except that nothing is sent.

        Args:
            policy: what acts.
            on_image: called in each step with what the robot sees.
        """
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


class _TimedNetworkPolicy:
    """Runs the network in each step and times it, but acts as planned, so that the hand grasps.

    Attributes:
        actions: the planned actions (T, 11).
        network_timer: one step of the network, from picture to action.
    """

    name = "bench"
    version = 0
    looks = True
    target: NDArray[np.float64] | None = None

    def __init__(self, network: NetworkPolicy, actions: NDArray[np.float64]) -> None:
        self.actions = actions
        self.outputs: Floats | None = None
        self.network_timer = _Timer()
        self._network = network

    def begin(self, situation: Situation, seed: int) -> None:
        self._network.begin(situation, seed)
        self._remaining_actions = iter(self.actions)

    def step(self, image: Image) -> NDArray[np.float64]:
        with self.network_timer:
            self._network.step(image)
        self.outputs = self._network.outputs
        return next(self._remaining_actions)


class _NetworkVariants:
    """The same network in numpy, and in parts.

    Attributes:
        numpy_timer: one step in numpy, from picture to action.
        core_timer: the part of one step that PFC, M_S, M_F and M_O take.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.numpy_timer, self.core_timer = _Timer(), _Timer()
        parameters = cast("Parameters", checkpoint.part(NETWORK_PREFIX))
        self._numpy = NetworkPolicy(checkpoint, "the benchmark", NumpyNetwork)
        self._parts = make_acting_network(checkpoint.metadata.network, parameters)

    def step(self, image: Image) -> None:
        """Run one step of each."""
        with self.numpy_timer:
            self._numpy.step(image)
        seen = self._parts.see(vision_input(image))
        with self.core_timer:
            self._parts.act(seen)


def random_checkpoint(config: NetworkConfig) -> Checkpoint:
    """A network of the configured sizes with random weights."""
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
