"""The actor on the bus: plays the episodes that learner and evaluator ask for."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

import numpy as np

from actors.disturbances.staging import Staging, checked_staging
from actors.inquiry import Inquiry
from actors.left_outboxes import LOOK_EVERY_S, OUTBOXES, LeftOutboxes
from actors.old_rollouts import divide_old_rollouts
from actors.player import LiveStep, play
from actors.policies.contract import Policy
from actors.policies.guided import GuidedPolicy
from actors.policies.planned import make_tutor
from actors.receipts import Receipts
from actors.simulator import Crop, Simulator, make_simulator, player_of
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from actors.view import focal_lengths, view_of
from learner.checkpoint import Checkpoint
from learner.network_policy import NetworkPolicy
from learner.policy_message import policy_limit, policy_of
from proto.agreement import ANSWERING, Agreement
from proto.bus import Bus
from proto.codec import MessageError, Wire, encode
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import membership
from proto.messages import (
    EYE_SIZE,
    LIVE_SCENE_EVERY,
    OUTSIDE_SIZE,
    POLICIES_KEPT,
    Correction,
    EpisodeFailed,
    EpisodeOutcome,
    Live,
    LiveScene,
    Pictures,
    PolicyVersion,
    Rollout,
    Sequence,
    Trial,
    TrialRequest,
    TutoringCase,
    TutoringRequest,
)
from proto.metrics import ActorMetrics
from proto.outbox import Outbox
from proto.pace import Pace
from proto.periodic import every
from proto.plain_text import plain
from proto.situations import situation_of
from proto.suites import Conditions
from proto.variables import Situation

LOG = logging.getLogger(__name__)

IDLE_S: Final = 0.3
"""How long to wait before asking again, when there is nothing to play."""
DRAIN_LOOK_S: Final = 0.1
OUTBOX_PERIOD_S: Final = 1.0
OUTBOX_LIMIT: Final = 100
"""An actor plays no more for a receiver that owes it so many receipts."""
REPORT_WITHIN_S: Final = 15.0
"""How long an actor waits at its start for receipts of reports that its predecessor died."""
UNSERVED_S: Final = 30.0
"""How often to say that the run has neither a learner nor an evaluator."""
COMPARE_AGAIN_S: Final = 5.0
"""How long to wait before the settings are compared again, if they differ."""
PICTURES_PERIOD_S: Final = 1.0
"""Least time between two pictures for viewers: to render them takes longer than a control step."""
PRACTICE_LIMIT: Final = 8
"""An actor does not practise when so many rollouts are without a receipt."""


@dataclass(frozen=True)
class Assignment:
    """An episode to play.

    Attributes:
        kind: why it is played.
        task: the task.
        policy: the policy that acts.
        situation: the situation.
        seed: seed of the episode.
        training: id of the training that the policy comes from, empty for the tutor.
        conditions: conditions of the suite that it belongs to.
        staging: how it is staged, if that was checked already.
    """

    kind: Kind
    task: Task
    policy: Policy
    situation: Situation
    seed: int
    training: str = ""
    conditions: Conditions | None = None
    staging: Staging | None = None


@dataclass(frozen=True)
class _Offer:
    """A policy that was published and fits the run.

    Attributes:
        run_id: id of its training.
        version: its version.
        checkpoint: the policy.
    """

    run_id: str
    version: int
    checkpoint: Checkpoint

    def is_newer_than(self, run_id: str, version: int) -> bool:
        """Whether it is of another training, or of this one and newer."""
        return self.run_id != run_id or self.version > version


def live_message(actor: str, assignment: Assignment, live: LiveStep) -> Live:
    """The message that is published in every control step while anyone watches."""
    return Live(
        actor=actor,
        kind=assignment.kind,
        policy=assignment.policy.name,
        policy_version=assignment.policy.version,
        step=live.step,
        phase=live.phase,
        image=live.image,
        joints_deg=live.joints_deg.astype(np.float32),
        action=live.action.astype(np.float32),
        body_poses=live.bodies.rows.astype(np.float32),
        focal_px=focal_lengths(live.crop),
        scene=_live_scene(live) if live.step % LIVE_SCENE_EVERY == 0 else None,
        pfc=live.pfc,
    )


def _live_scene(live: LiveStep) -> LiveScene:
    view = view_of(live.scene, [])
    return LiveScene(tuple(live.bodies.places), view.boxes, view.fixed_links)


def _earlier_policy(older: Mapping[int, Checkpoint], version: int) -> NetworkPolicy:
    """An earlier version of the policy.

    Raises:
        UserError: it is none of those that the actor has, or it cannot act.
    """
    if version not in older:
        raise UserError(f"this actor does not have policy {version}")
    try:
        return NetworkPolicy(older[version], "the policy")
    except (ValueError, MemoryError) as error:
        raise UserError(f"policy {version} cannot be used: {error}") from error


class _StoppedError(Exception):
    """The episode is given up because the actor should stop."""


class _SimulationError(Exception):
    """The episode cannot be used: the simulation gave values that cannot be."""


def _encoded(message: object) -> Wire:
    try:
        return encode(message)
    except MessageError as error:
        raise _SimulationError(str(error)) from error


class Shower(Protocol):
    """Has a person show what the learner asks for."""

    def show(
        self, simulator: Simulator, assignment: Assignment, actor: str, config_digest: str
    ) -> Episode | None:
        """Let a person show an episode; None if they do not want to, or the actor should stop.

        Args:
            simulator: plays the scene.
            assignment: what is to be shown. Its policy acts where the person lets it, if it is a
                correction.
            actor: id of the actor.
            config_digest: digest of the actor's settings.
        """


class Actor:
    """Plays one episode after another, and keeps each on disk until its receipt comes.

    It takes a newer policy only between two episodes, because the recurrent state of one policy
    means nothing to another.
    """

    def __init__(
        self,
        config: Config,
        bus: Bus,
        lifecycle: Lifecycle,
        *,
        backend: str | None = None,
        drain_s: float = 0.0,
        shower: Shower | None = None,
    ) -> None:
        """Make the simulator, and find the messages that a former process with this id left.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.
            lifecycle: says when to pause and to stop.
            backend: name of this actor's simulator; None for `simulator.backend`.
            drain_s: how long it waits for receipts before it ends (s).
            shower: has a person show what the learner asks for; this actor then plays nothing else.

        Raises:
            UserError: the simulator cannot run on this machine, or the run's folder cannot be
                written.
        """
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._drain_s = drain_s
        self._shower = shower
        self._agreement = Agreement(config, bus)
        self._serving: set[tuple[Role, str]] = set()  # learners and evaluators that are there
        self._joined = threading.Event()  # set when a learner or evaluator has joined
        self._task = make_task(config.task)
        self._tasks = {self._task.name: self._task}
        if (first := config.pretraining_task) is not None:
            self._tasks[first] = make_task(config.task_called(first))
        chosen = {} if backend is None else {"backend": backend}
        self._simulator = make_simulator(config.simulator.model_copy(update=chosen))
        self._player = player_of(self._simulator)
        folder = config.run_folder / "outbox" / bus.id
        divide_old_rollouts(folder)
        self._outboxes = tuple(Outbox(folder / each, self._deliver) for each in OUTBOXES)
        self._sequences, self._rollouts, self._outcomes = self._outboxes
        self._receipts = Receipts(bus)
        self._left = LeftOutboxes(config.run_folder, bus, self._receipts)
        keys = bus.keys
        self._ask_learner = Inquiry[TutoringRequest, TutoringCase | Correction](
            lambda request: bus.ask(keys.request_tutoring, request, TutoringCase, Correction)
        )
        self._ask_evaluator = Inquiry[TrialRequest, Trial](
            lambda request: bus.ask(keys.request_trial, request, Trial)
        )
        self._policy: NetworkPolicy | None = None
        self._policy_run = ""
        # With first trials every version; otherwise only the newest.
        kept = POLICIES_KEPT if config.evaluator.first_trials else 1
        self._offers: deque[_Offer] = deque(maxlen=kept)  # newer than the policy, oldest first
        # Of one training, oldest first: the evaluator may ask for trials of earlier versions.
        self._known: deque[_Offer] = deque(maxlen=POLICIES_KEPT)
        self._offering = threading.Lock()
        self._pace = Pace()
        self._episodes = 0
        self._failed = 0
        self._refused_policies = 0
        self._last: Episode | None = None
        self._pictures_at_s = 0.0
        self._can_render = config.simulator.render

    def run(self) -> None:
        """Play until it should stop; the episode that is played then is given up.

        Raises:
            UserError: its configuration does not fit the run.
            StorageError: it should stop, and an episode cannot be written to disk.
        """
        keys = self._bus.keys
        for role in ANSWERING:
            self._bus.watch_presence(role, partial(self._on_presence, role))
        self._agreement.check()
        self._receipts.pass_on(self._bus.id, self._outboxes)
        self._bus.subscribe_newest(
            keys.policy,
            self._on_policy,
            PolicyVersion,
            limit=policy_limit(self._config.network),
        )
        try:
            with (
                membership(self._bus, self, self._lifecycle),
                every(OUTBOX_PERIOD_S, self._sequences.send_due),
                every(OUTBOX_PERIOD_S, self._rollouts.send_due),
                every(OUTBOX_PERIOD_S, self._outcomes.send_due),
                every(LOOK_EVERY_S, self._left.look),
            ):
                self._left.look()
                self._report_deaths()
                while not self._lifecycle.stopping:
                    self._play_next()
                self._wait_for_receipts()
        finally:
            self._ask_learner.close()
            self._ask_evaluator.close()
            self._left.close()
            self._simulator.close()

    def metrics(self) -> ActorMetrics:
        """Metrics at this moment."""
        last = self._last
        return ActorMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused + self._refused_policies,
            policy_version=self._policy.version if self._policy else 0,
            steps_per_s=self._pace.per_second(),
            episodes=self._episodes,
            last_outcome=last.outcome.reason if last else None,
            last_kind=last.kind if last else None,
            backend=self._simulator.name,
            outbox=self._waiting,
            put_aside=sum(each.put_aside for each in self._outboxes),
            failed=self._failed,
            paused=self._lifecycle.paused,
        )

    def checkpoint(self) -> str:
        """Write nothing: finished episodes are on disk until their receipts come."""
        return f"{self._waiting} episodes wait for their receipts on disk"

    @property
    def _behind(self) -> int:
        """Episodes of its policy for which evaluator or recorder owe a receipt."""
        return max(len(self._rollouts), len(self._outcomes))

    @property
    def _unanswered(self) -> int:
        return sum(map(len, self._outboxes))

    @property
    def _waiting(self) -> int:
        return self._unanswered + len(self._left)

    def _wait_for_receipts(self) -> None:
        """Wait until nothing of its own is in an outbox any more, or for `drain_s`."""
        over_s = time.monotonic() + self._drain_s
        while self._unanswered and time.monotonic() < over_s:
            self._lifecycle.waits_for(self._missing)
            time.sleep(DRAIN_LOOK_S)
        if self._drain_s and self._unanswered:
            LOG.warning("ends with %d messages without a receipt", self._unanswered)

    def _report_deaths(self) -> None:
        """Send what killed the former process; play nothing before it is known, or it kills again.

        Whoever does not answer is not waited for.
        """
        over_s = time.monotonic() + REPORT_WITHIN_S
        while deaths := sum(outbox.of_dead for outbox in self._outboxes):
            for outbox in self._outboxes:
                outbox.send_due()
            if self._lifecycle.stopping or time.monotonic() > over_s:
                return
            self._lifecycle.waits_for(f"receipts for {deaths} reports of the former process")
            self._lifecycle.wait(0.1)

    def _play_next(self) -> None:
        assignment = None
        if not self._lifecycle.paused and self._agrees():
            assignment = self._next_assignment()
        if assignment is None:
            if self._unserved:
                self._lifecycle.waits_for(self._unserved, log_again_s=UNSERVED_S)
            else:
                self._lifecycle.waits_for(self._missing)
            self._lifecycle.wait(IDLE_S)
            return
        self._lifecycle.waits_for("")
        try:
            episode = self._play(assignment)
            self._send(episode)
        except _StoppedError:
            return
        except _SimulationError as error:
            self._failed += 1
            self._report_failure(assignment, str(error))
            return
        self._episodes += 1
        self._last = episode
        LOG.debug(
            "played %s with the seed %d by %s, version %d: %s",
            *(episode.kind, episode.seed, episode.policy, episode.policy_version),
            episode.outcome.reason,
        )

    def _next_assignment(self) -> Assignment | None:
        if self._shower is not None:
            while self._offers:
                self._take_next_policy()
            return self._tutoring()
        first = self._first_trial()
        return first or self._tutoring() or self._trial() or self._practice()

    def _agrees(self) -> bool:
        """Whether the settings still fit the run; compared when a learner or evaluator joined."""
        if not self._joined.is_set():
            return True
        self._joined.clear()
        if problem := self._agreement.problem():
            LOG.error("plays nothing until this is mended: %s", problem)
            self._joined.set()
            self._lifecycle.wait(COMPARE_AGAIN_S)
            return False
        return True

    def _on_presence(self, role: Role, name: str, alive: bool) -> None:
        if alive:
            self._serving.add((role, name))
            self._joined.set()
        else:
            self._serving.discard((role, name))

    @property
    def _unserved(self) -> str:
        """What is missing if neither a learner nor an evaluator is there; empty otherwise."""
        if self._serving or self._bus.hub_is_away or self._lifecycle.paused:
            return ""
        return f"a learner or an evaluator of the run {self._bus.keys.run}: nobody serves it"

    @property
    def _missing(self) -> str:
        """What it takes to play."""
        if self._lifecycle.paused:
            return "the end of the pause"
        if self._bus.hub_is_away:
            return "the hub"
        silent = [
            str(role)
            for role, inquiry in (
                (Role.LEARNER, self._ask_learner),
                (Role.EVALUATOR, self._ask_evaluator),
            )
            if inquiry.unanswered
        ]
        if silent:
            return f"an answer of the {' and the '.join(silent)}"
        if missing := sorted(set().union(*(each.missing for each in self._outboxes))):
            return f"receipts of the {' and the '.join(missing)}"
        return "something to play" if self._policy else "the first policy"

    def _deliver(self, key: str, wire: Wire) -> None:
        """Send what is in the outbox, also if it was kept while the run had another name."""
        self._bus.deliver_wire(self._bus.keys.renamed(key, self._bus.id), wire)

    def _tutoring(self) -> Assignment | None:
        """A tutored case or a correction that the learner asks for; None if there is none."""
        if len(self._sequences) >= OUTBOX_LIMIT:
            return None
        version = self._policy.version if self._policy else 0
        request = TutoringRequest(
            self._bus.id, self._policy_run, version, self._agreement.digest, self._player
        )
        for answer in self._ask_learner.answers(request):
            try:
                if isinstance(answer, Correction):
                    return self._guidance(answer)
                return self._demonstration(answer)
            except UserError as error:
                LOG.warning("the learner's request cannot be played: %s", plain(error))
        return None

    def _demonstration(self, asked: TutoringCase) -> Assignment:
        """A demonstration of a tutored case.

        Raises:
            UserError: there is no such case.
        """
        task = self._task_called(asked.task)
        situations = task.tutored()
        if asked.case >= len(situations):
            raise UserError(f"{task.name} has no tutored case {asked.case}")
        tutor = make_tutor(task, self._config.tutor if asked.repeat > 0 else None)
        return Assignment(Kind.TUTORING, task, tutor, situations[asked.case], asked.seed)

    def _guidance(self, asked: Correction) -> Assignment:
        """A correction: the policy acts, and the tutor or a person guides it.

        Raises:
            UserError: there is no policy, or the situation is not one of the task.
        """
        task = self._task_called(asked.task)
        staging = checked_staging(
            self._simulator, task, asked.situation, asked.conditions, asked.seed
        )
        if self._policy is None:
            raise UserError("there is no policy to be guided")
        guided: Policy = self._policy
        if self._shower is None:
            guidance_deg = self._config.tutor.guidance_deg
            guided = GuidedPolicy(self._policy, make_tutor(task), guidance_deg)
        return Assignment(
            Kind.CORRECTION,
            task,
            guided,
            asked.situation,
            asked.seed,
            self._policy_run,
            asked.conditions,
            staging,
        )

    def _task_called(self, name: str) -> Task:
        if name not in self._tasks:
            raise UserError(f"this actor plays {' and '.join(self._tasks)}, not the task {name!r}")
        return self._tasks[name]

    def _trial(self) -> Assignment | None:
        """A trial that the evaluator asks for; None if there is none.

        It is one of this policy or, if all of the newest are played, of an earlier version.
        """
        if self._policy is None or self._behind >= OUTBOX_LIMIT:
            return None
        version, digest = self._policy.version, self._agreement.digest
        with self._offering:
            older = {
                known.version: known.checkpoint
                for known in self._known
                if known.run_id == self._policy_run and known.version < version
            }
        request = TrialRequest(
            self._bus.id, self._policy_run, version, digest, self._player, tuple(older)
        )
        for trial in self._ask_evaluator.answers(request):
            try:
                policy = self._policy
                if trial.policy_version != version:
                    policy = _earlier_policy(older, trial.policy_version)
                return self._rollout(Kind.TRIAL, policy, trial.seed, trial.conditions)
            except UserError as error:
                LOG.warning("the evaluator's trial cannot be played: %s", plain(error))
        return None

    def _practice(self) -> Assignment | None:
        """A random situation of a suite that is practised, and that this actor can play.

        None without a policy, without such a suite, or if practice is off or ahead of receipts.
        """
        if self._policy is None or not self._config.actor.practice:
            return None
        if self._behind >= PRACTICE_LIMIT:
            return None
        drawn = [
            (seed, suite.conditions(seed))
            for suite in self._config.practised_suites()
            for seed in (secrets.choice(suite.practice_seeds),)
            if self._player.can_play(suite.backend, suite.conditions(seed))
        ]
        if not drawn:
            return None
        seed, conditions = secrets.choice(drawn)
        try:
            return self._rollout(Kind.PRACTICE, self._policy, seed, conditions)
        except UserError as error:
            LOG.warning("a situation cannot be practised: %s", error)
            return None

    def _rollout(
        self, kind: Kind, policy: Policy, seed: int, conditions: Conditions | None
    ) -> Assignment:
        """An episode of the policy in the situation of a seed.

        Raises:
            UserError: the task cannot be played under these conditions.
        """
        situation = situation_of(self._task, conditions, seed)
        staging = checked_staging(self._simulator, self._task, situation, conditions, seed)
        return Assignment(
            kind, self._task, policy, situation, seed, self._policy_run, conditions, staging
        )

    def _play(self, assignment: Assignment) -> Episode:
        if self._shower is not None:
            digest = self._agreement.digest
            shown = self._shower.show(self._simulator, assignment, self._bus.id, digest)
            if shown is None:
                raise _StoppedError
            return shown
        live_key = self._bus.keys.live(self._bus.id)

        def on_step(live: LiveStep) -> None:
            if self._lifecycle.stopping:
                raise _StoppedError
            self._pace.add()
            self._lifecycle.goes_on()
            if self._config.actor.live and self._bus.watched(live_key):
                message = live_message(self._bus.id, assignment, live)
                self._bus.publish(live_key, message, check=False)
                self._publish_pictures(live.step)

        try:
            with self._reported_if_killed(assignment):
                episode = play(
                    self._simulator,
                    assignment.task,
                    assignment.policy,
                    assignment.situation,
                    seed=assignment.seed,
                    kind=assignment.kind,
                    actor=self._bus.id,
                    config_digest=self._agreement.digest,
                    on_step=on_step,
                    conditions=assignment.conditions,
                    staging=assignment.staging,
                )
        except (_StoppedError, UserError, OSError, MemoryError):
            raise  # nothing is wrong with the episode
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
            if self._simulation_is_finite():
                # The next process starts with a new simulator; the report is on disk before.
                self._report_failure(assignment, problem)
                raise
            raise _SimulationError(problem) from error
        return replace(episode, training=assignment.training)

    def _publish_pictures(self, step: int) -> None:
        """Publish what the scene looks like now, if anyone wants to see it and it is due."""
        key, now_s = self._bus.keys.pictures(self._bus.id), time.monotonic()
        if not self._can_render or now_s < self._pictures_at_s or not self._bus.watched(key):
            return
        outside_height, outside_width, _ = OUTSIDE_SIZE
        eye_height, eye_width, _ = EYE_SIZE
        try:
            outside = self._simulator.outside_picture(outside_width, outside_height)
            eye = self._simulator.eye_picture(Crop(), eye_width, eye_height)
        except Exception:  # of a simulator that cannot draw this; its episodes are good
            LOG.exception("no pictures of the scene are published from now on")
            self._can_render = False
            return
        self._bus.publish(key, Pictures(self._bus.id, step, outside, eye), check=False)
        self._pictures_at_s = time.monotonic() + PICTURES_PERIOD_S

    def _simulation_is_finite(self) -> bool:
        joints, bodies = self._simulator.joints_deg(), self._simulator.bodies()
        return bool(np.isfinite(joints).all() and np.isfinite(bodies.rows).all())

    def _send(self, episode: Episode) -> None:
        """Put a finished episode into the outbox.

        Raises:
            _SimulationError: its values are not those of an episode, such as NaN.
            StorageError: the actor should stop, and it cannot be written to disk.
        """
        keys, actor = self._bus.keys, self._bus.id
        if episode.kind in (Kind.TUTORING, Kind.CORRECTION):
            sequence = _encoded(Sequence(episode))
            self._keep(self._sequences, episode, keys.sequence(actor), sequence, Role.LEARNER)
            return
        rollout = _encoded(Rollout(episode, episode.training))
        outcome = _encoded(EpisodeOutcome.of(episode))
        # The rollout first: whatever is counted has its recording.
        recorder, practice = self._config.recorder, episode.kind is Kind.PRACTICE
        if recorder.records(episode.id, practice=practice, precise=episode.outcome.precise):
            key = keys.rollout(actor)
            if recorder.required:
                self._keep(self._rollouts, episode, key, rollout, Role.RECORDER)
            elif self._bus.watched(key):
                self._bus.publish_wire(key, rollout)
        self._keep(self._outcomes, episode, keys.outcome(actor), outcome, Role.EVALUATOR)

    def _keep(self, outbox: Outbox, episode: Episode, key: str, wire: Wire, receiver: Role) -> None:
        when_disk_allows(self._lifecycle, lambda: outbox.add(episode.id, key, wire, [receiver]))

    def _report_failure(self, failed: Assignment, problem: str) -> None:
        """Tell the process that asked for the episode; nobody asks for practice."""
        LOG.warning("the simulation of an episode (%s) failed: %s", failed.kind, problem)
        if failed.kind is Kind.PRACTICE:
            return
        report = self._report_of(failed, problem)
        outbox, receiver = self._outbox_of(failed.kind)
        key, wire = self._bus.keys.failure(self._bus.id), encode(report)
        when_disk_allows(self._lifecycle, lambda: outbox.add(report.id, key, wire, [receiver]))

    def _reported_if_killed(self, played: Assignment) -> AbstractContextManager[None]:
        """Have the next process report an episode that kills this one, such as by a crash."""
        if played.kind is Kind.PRACTICE:
            return nullcontext()
        report = self._report_of(played, "the actor's process died while it played it", died=True)
        outbox, receiver = self._outbox_of(played.kind)
        key = self._bus.keys.failure(self._bus.id)
        return outbox.sent_if_killed(report.id, key, encode(report), [receiver])

    def _report_of(self, failed: Assignment, problem: str, *, died: bool = False) -> EpisodeFailed:
        return EpisodeFailed(
            id=secrets.token_hex(16),
            actor=self._bus.id,
            kind=failed.kind,
            task=failed.task.name,
            seed=failed.seed,
            situation=dict(failed.situation),
            training=failed.training,
            policy_version=failed.policy.version,
            problem=plain(problem)[:1000],
            died=died,
            conditions=failed.conditions,
        )

    def _outbox_of(self, kind: Kind) -> tuple[Outbox, Role]:
        """The outbox of reports about episodes of a kind, and who receives them."""
        if kind is Kind.TRIAL:
            return self._outcomes, Role.EVALUATOR
        return self._sequences, Role.LEARNER

    def _on_policy(self, message: PolicyVersion) -> None:
        """Keep a newer policy of this run until the next episode begins."""
        try:
            offered = _Offer(message.run_id, message.version, policy_of(message, self._config))
        except UserError as error:
            self._refused_policies += 1
            LOG.warning("policy %d cannot be used: %s", message.version, plain(error))
            return
        with self._offering:
            waiting = self._offers[-1] if self._offers else None
            if waiting is None or offered.is_newer_than(waiting.run_id, waiting.version):
                if waiting is not None and offered.run_id != waiting.run_id:
                    self._offers.clear()
                self._offers.append(offered)
                if self._known and self._known[-1].run_id != offered.run_id:
                    self._known.clear()
                self._known.append(offered)

    def _first_trial(self) -> Assignment | None:
        """Take the newer policies, one after the other, until there is no newer one.

        If `evaluator.first_trials` is set, the evaluator is asked first whether it lacks first
        trials of the policy at hand; one of them is returned before a newer policy is taken.
        """
        while self._offers:
            if self._policy is not None and self._config.evaluator.first_trials:
                trial = self._trial()
                if trial is not None:
                    return trial
            self._take_next_policy()
        return None

    def _take_next_policy(self) -> None:
        with self._offering:
            offered = self._offers.popleft()
        held = self._policy.version if self._policy else 0
        if not offered.is_newer_than(self._policy_run, held):
            return
        try:
            policy = NetworkPolicy(offered.checkpoint, "the policy")
        except (ValueError, MemoryError) as error:
            self._refused_policies += 1
            LOG.warning("policy %d cannot be used: %s", offered.version, plain(error))
            return
        self._policy = policy
        self._policy_run = offered.run_id
        LOG.info("acts with policy %d from now on", self._policy.version)
