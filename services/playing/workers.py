"""Plays many episodes, on as many processes as there are cores.

Episodes know nothing of each other, so the same jobs give the same episodes with any number of
workers.
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
from proto.variables import Situation


@dataclass(frozen=True)
class Job:
    """One episode to be played.

    Attributes:
        situation: what to play.
        seed: seed of everything random in it.
        kind: why it is played.
        noisy: the tutor's execution is disturbed; for the tutor only.
        record_to: file to write it to, or None.
        states: the episode carries the activity of the policy's subnets; for a network only.
    """

    situation: Situation
    seed: int
    kind: Kind
    noisy: bool = False
    record_to: Path | None = None
    states: bool = False


def play_all(
    config: Config, policy: str, jobs: Sequence[Job], *, workers: int
) -> Generator[tuple[Job, Episode], None, None]:
    """Play jobs and yield each with its episode as it is finished, in any order.

    Closing the iterator, or an interrupt, lets the episodes that are being played come to their end
    and starts no other.

    Args:
        config: the whole configuration.
        policy: a name for `actors.policies.by_name.make_policy`.
        jobs: what to play.
        workers: processes to play in; 1 plays in this one.

    Raises:
        UserError: a worker could not play, or died, or the policy has no states to carry.
    """
    if workers <= 1 or len(jobs) <= 1:
        player = _Player(config, policy)
        yield from ((job, player.play(job)) for job in jobs)
        return
    waiting = iter(jobs)
    with _pool(min(workers, len(jobs)), config, policy) as pool:
        with _interrupts_ignored():  # the workers that start here go on ignoring them
            running = {pool.submit(_play_here, job): job for job in islice(waiting, workers)}
        try:
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    job = running.pop(future)
                    running |= {pool.submit(_play_here, job): job for job in islice(waiting, 1)}
                    yield job, future.result()
        except BrokenProcessPool as error:
            raise UserError(
                "a worker process died; if memory is short, try fewer --workers"
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
        inside = _with_states(policy) if job.states else None
        # Nobody looks at pictures that are neither seen by the policy nor kept.
        simulator = self._simulator(render=policy.looks or job.record_to is not None)
        episode = play(
            simulator,
            self._task,
            policy,
            job.situation,
            seed=job.seed,
            kind=job.kind,
            config_digest=self._digest,
        )
        if inside is not None:
            episode = replace(episode, states=inside.states(episode.images))
        if job.record_to is not None:
            write_episode(job.record_to, episode)
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


def _with_states(policy: Policy) -> StatefulPolicy:
    if not isinstance(policy, StatefulPolicy):
        raise UserError(f"policy {policy.name!r} has no states; only a network's checkpoint has")
    return policy


def _pool(workers: int, config: Config, policy: str) -> ProcessPoolExecutor:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch starts so many threads in each worker
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
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _play_here(job: Job) -> Episode:
    # Made by the first job, not by the initializer, so that a UserError reaches the caller.
    global _player  # noqa: PLW0603
    if _player is None:
        _player = _Player(*_arguments)
    return _player.play(job)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ctrl-C reaches every process of a terminal; workers leave it to the parent."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
