"""Plays many episodes in several worker processes.

Episodes are independent: the same jobs give the same episodes with any number of workers.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from actors.player import play
from actors.policies.by_name import make_policy
from actors.policies.contract import Policy, StatefulPolicy
from actors.policies.planned import make_tutor
from actors.simulator import Simulator, make_simulator
from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.recordings.episodes import write_episode
from proto.suites import Conditions
from proto.variables import Situation
from services.playing.parent import end_with_parent
from services.robot_meshes import robot_meshes


@dataclass(frozen=True)
class Job:
    """One episode to be played.

    Attributes:
        situation: the values of the task's variables by name.
        seed: seed of all random numbers in the episode.
        kind: why the episode is played.
        noisy: add noise to the tutor's execution; only for the tutor.
        record_to: file to record the episode to, or None.
        states: store the activity of the policy's subnets in the episode; only for networks.
        conditions: conditions of the suite that it belongs to.
    """

    situation: Situation
    seed: int
    kind: Kind
    noisy: bool = False
    record_to: Path | None = None
    states: bool = False
    conditions: Conditions | None = None


def play_all(
    config: Config, policy: str, jobs: Sequence[Job], *, workers: int
) -> Generator[tuple[Job, Episode], None, None]:
    """Play jobs and yield each with its episode when it is finished, in any order.

    If the iterator is closed or interrupted, the running episodes are finished and no other is
    started.

    Args:
        config: the whole configuration.
        policy: a name for `actors.policies.by_name.make_policy`.
        jobs: the episodes to play.
        workers: number of processes; with 1 the episodes are played in this process.

    Raises:
        UserError: a worker could not play or died, or a job requests states of a policy that has
            none.
    """
    if workers <= 1 or len(jobs) <= 1:
        player = _Player(config, policy)
        yield from ((job, player.play(job)) for job in jobs)
        return
    waiting = iter(jobs)
    with _pool(min(workers, len(jobs)), config, policy) as pool:
        with _interrupts_ignored():  # workers that start here inherit this
            running = {pool.submit(_play_in_worker, job): job for job in islice(waiting, workers)}
        try:
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    job = running.pop(future)
                    for next_job in islice(waiting, 1):
                        running[pool.submit(_play_in_worker, next_job)] = next_job
                    yield job, future.result()
        except BrokenProcessPool as error:
            raise UserError(
                "a worker process died; if there is too little memory, use fewer --workers"
            ) from error


class _Player:
    """Plays one job after another with the same simulator."""

    def __init__(self, config: Config, policy: str) -> None:
        self._config = config
        self._policy = policy
        self._digest = config.digest()
        self._task = make_task(config.task)
        self._policies: dict[bool, Policy] = {}
        self._simulators: dict[bool, Simulator] = {}

    def play(self, job: Job) -> Episode:
        policy = self._policy_for(job)
        stateful = _check_stateful(policy) if job.states else None
        # Pictures are needed only if the policy uses them or they are recorded.
        simulator = self._simulator(render=policy.looks or job.record_to is not None)
        episode = play(
            simulator,
            self._task,
            policy,
            job.situation,
            seed=job.seed,
            kind=job.kind,
            config_digest=self._digest,
            conditions=job.conditions,
        )
        if stateful is not None:
            episode = replace(episode, states=stateful.states(episode.images))
        if job.record_to is not None:
            write_episode(job.record_to, episode, robot=robot_meshes())
        return episode

    def _policy_for(self, job: Job) -> Policy:
        if job.noisy not in self._policies:
            self._policies[job.noisy] = (
                make_tutor(self._task, self._config.tutor)
                if job.noisy
                else make_policy(self._policy, self._task)
            )
        return self._policies[job.noisy]

    def _simulator(self, *, render: bool) -> Simulator:
        if render not in self._simulators:
            config = self._config.simulator.model_copy(update={"render": render})
            self._simulators[render] = make_simulator(config)
        return self._simulators[render]


def _check_stateful(policy: Policy) -> StatefulPolicy:
    if not isinstance(policy, StatefulPolicy):
        raise UserError(f"policy {policy.name!r} has no states; only networks have states")
    return policy


def _pool(workers: int, config: Config, policy: str) -> ProcessPoolExecutor:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # number of torch's threads in each worker
    return ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_worker,
        initargs=(config, policy),
    )


_arguments: tuple[Config, str]
_player: _Player | None = None


def _begin_worker(config: Config, policy: str) -> None:
    global _arguments  # noqa: PLW0603 - a worker process plays for one pool only
    _arguments = (config, policy)
    threading.Thread(target=end_with_parent, daemon=True).start()


def _play_in_worker(job: Job) -> Episode:
    # The first job makes the player, not the initializer, so that a UserError reaches the caller.
    global _player  # noqa: PLW0603
    if _player is None:
        _player = _Player(*_arguments)
    return _player.play(job)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C, which reaches every process of a terminal; the parent handles it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
