"""The learner on the bus: asks for sequences, stores them, trains, publishes policies."""

from __future__ import annotations

import logging
import re
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from learner.checkpoint import (
    CheckpointMetadata,
    checkpoint_from_bytes,
    policy_file,
    pretraining_file,
    previous_training_file,
    training_file,
)
from learner.policy_digests import digest_problem
from learner.policy_message import policy_message
from learner.training.recent_epochs import RecentEpochs
from learner.training.training_run import (
    open_training,
    policy_is_due,
    pretraining_is_over,
    save_training,
    write_policy,
)
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.corrections import Round, Situations, situation_of_correction
from learner.tutoring.curriculum import Curriculum
from learner.tutoring.failures import TRIES, Shown
from learner.tutoring.store import TutoringStore
from proto.acceptance import misfit, same_situation
from proto.agreement import OTHER_SETTINGS, Agreement
from proto.bus import Bus, Inbox
from proto.config import Config
from proto.disk_waits import when_disk_allows
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.joining import answer_configuration
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run, membership
from proto.messages import (
    LARGEST_LOSS,
    Correction,
    EpisodeFailed,
    Receipt,
    Sequence,
    TutoringCase,
    TutoringRequest,
    Verdict,
)
from proto.metrics import LearnerMetrics, Stage
from proto.pace import Pace
from proto.plain_text import plain
from proto.players import Players
from proto.recordings.episodes import EpisodeSummary
from proto.seeds import SEEDS_PER_CASE
from proto.senders import Sender
from proto.storage import change_suffix, rename, written_whole
from proto.variables import Situation

LOG = logging.getLogger(__name__)

WAITING: Final = 64
"""Messages that may wait to be handled; more are dropped, and sent again by their actors."""
IDLE_S: Final = 0.2
"""How often to look whether it should stop or may train, while it waits for sequences."""
_TRAINING: Final = (Stage.PRETRAINING, Stage.COUPLED)
_LEARNED_FROM: Final = (Kind.TUTORING, Kind.CORRECTION)


@dataclass(frozen=True)
class _Material:
    """What a stage of training learns from.

    Attributes:
        task: name of the task.
        store: its sequences.
        start_sequences: number of sequences to start with, or fewer where no more can come.
    """

    task: str
    store: TutoringStore
    start_sequences: int


class Learner:
    """Trains, while it receives sequences and hands out cases.

    A training is on disk before its policy is published, so a restarted learner never publishes
    another policy under a version that was published before.
    """

    def __init__(
        self, config: Config, bus: Bus, lifecycle: Lifecycle, *, tasks: Mapping[str, Situations]
    ) -> None:
        """Restore what is in the run's folder.

        Args:
            config: the configuration of the run.
            bus: connection to the other processes.
            lifecycle: says when to pause and to stop.
            tasks: the situations of each task, by the name of the task.

        Raises:
            UserError: the folder holds a training that cannot go on, or the configuration asks for
                a case that the task does not have.
        """
        self._config = config
        self._bus = bus
        self._lifecycle = lifecycle
        self._folder = config.run_folder
        tutored_cases = {name: len(task.tutored()) for name, task in tasks.items()}
        self._curriculum = Curriculum(config, tutored_cases)
        self._tasks = tasks
        self._situations = tasks[config.task.name]
        self._agreement = Agreement(config, bus)
        self._stores = _stores(config)
        found = self._check_stores()
        self._materials = self._make_materials()
        self._trainer = open_training(
            VMDNNRecipe(
                config,
                tasks[config.pretraining_task or config.task.name].questions,
                tasks[config.task.name].distractors,
            ),
            self._folder,
            self._materials[Stage.COUPLED].store,
            self._materials[Stage.PRETRAINING].store,
            rounds=config.learner.corrections.rounds,
        )
        self._training = threading.Lock()  # held while the trainer changes or is written to disk
        self._run_id = _run_id(self._folder)
        self._damaged = 0
        self._published: tuple[int, CheckpointMetadata, bytes] | None = None
        self._find_newest_policy()
        self._round = self._make_round(resumed=True)
        self._players = Players()
        self._unplayable = ""
        self._given_up = 0
        for shown in found:
            self._note(shown)
        self._pace = Pace()
        self._epochs = RecentEpochs()

    def run(self) -> None:
        """Learn until it should stop, then save the training.

        Raises:
            UserError: the run has a learner already, its evaluator has another configuration, the
                training diverged, or the disk is full.
        """
        with alone_in_run(self._bus, self._lifecycle):
            self._run()

    def _run(self) -> None:
        self._agreement.check()
        self._agreement.answer()
        answer_configuration(self._bus, self._config)
        self._write(lambda: self._config.save(self._folder / "config.yaml"))
        self._publish()
        keys = self._bus.keys
        sequences = self._bus.inbox(keys.sequence(), Sequence, capacity=WAITING)
        failures = self._bus.inbox(keys.failure(), EpisodeFailed, capacity=WAITING)
        self._answer_and_listen()
        with membership(self._bus, self, self._lifecycle):
            while not self._lifecycle.stopping:
                may_train = self._may_train
                self._lifecycle.waits_for("" if may_train else self._missing)
                self._receive(sequences, wait_s=0.0 if may_train else IDLE_S)
                self._receive_failures(failures)
                self._look_for_players()
                if may_train:
                    self._train()
        LOG.info(self.checkpoint())

    def metrics(self) -> LearnerMetrics:
        """Metrics at this moment."""
        done, awaited = self._config.done, self._round
        return LearnerMetrics(
            id=self._bus.id,
            time_s=time.time(),
            refused=self._bus.refused,
            stage=self._stage,
            epoch=self._trainer.epochs_done,
            epochs_total=self._trainer.epochs_total,
            epochs_later=self._trainer.epochs_later,
            loss=None if self._trainer.loss is None else min(self._trainer.loss, LARGEST_LOSS),
            learning_rate=self._epochs.learning_rate,
            training=self._run_id,
            sequences=self._sequences,
            sequences_total=self._sequences + self._curriculum.missing,
            round=self._trainer.round,
            rounds=self._config.learner.corrections.rounds,
            corrections=awaited.kept if awaited else 0,
            corrections_total=awaited.most if awaited else 0,
            damaged=self._damaged + sum(len(store.damaged) for store in self._stores.values()),
            given_up=self._given_up,
            epochs_per_s=self._pace.per_second(),
            epochs=self._epochs.taken(),
            policy_version=self._newest_version,
            policies_total=self._config.policy_versions,
            paused=self._lifecycle.paused,
            done=done.ever and self._newest_version >= (done.policy_versions or 0),
        )

    def checkpoint(self) -> str:
        """Write the training to disk, after the epoch that is going on."""
        with self._training:
            self._write(lambda: save_training(self._trainer, self._folder))
            place = training_file(self._folder)
            return f"saved {self._trainer.stage} epoch {self._trainer.epochs_done} to {place}"

    def _write(self, write: Callable[[], None]) -> None:
        """Write to disk; wait while the disk does not allow it."""
        when_disk_allows(self._lifecycle, write)

    @property
    def _missing(self) -> str:
        """What the learner waits for while it does not train."""
        if self._lifecycle.paused:
            return "the end of the pause"
        if self._trainer.finished:
            return ""
        if (awaited := self._round) is not None:
            wanted = f"corrections ({awaited.kept} of {awaited.most})"
        else:
            wanted = f"sequences ({self._sequences} so far)"
        return f"the hub, then {wanted}" if self._bus.hub_is_away else wanted

    @property
    def _newest_version(self) -> int:
        return self._published[0] if self._published else 0

    @property
    def _sequences(self) -> int:
        return sum(map(len, self._stores.values()))

    @property
    def _stage(self) -> Stage:
        awaited, material = self._round, self._materials.get(self._trainer.next_stage)
        waiting = material is not None and not self._is_enough(material)
        if awaited is not None:
            waiting = not awaited.complete
        return Stage.WAITING if waiting else self._trainer.stage

    @property
    def _may_train(self) -> bool:
        return self._stage in _TRAINING and not self._lifecycle.paused

    def _make_materials(self) -> Mapping[Stage, _Material]:
        """What coupled training and pre-training learn from."""
        learner = self._config.learner
        task, first = self._config.task.name, self._config.pretraining_task
        coupled = _Material(task, self._stores[task], learner.start_sequences)
        pretraining = coupled
        if first is not None:
            start_sequences = learner.pretraining.start_sequences
            pretraining = _Material(first, self._stores[first], start_sequences)
        return {Stage.COUPLED: coupled, Stage.PRETRAINING: pretraining}

    def _is_enough(self, material: _Material) -> bool:
        """Whether a stage has the sequences to start with."""
        possible = self._curriculum.size(material.task)
        return len(material.store) >= min(material.start_sequences, possible)

    def _answer_and_listen(self) -> None:
        """Start to hand out cases and corrections."""
        keys = self._bus.keys
        self._bus.answer(keys.request_tutoring, TutoringRequest, self._hand_out)
        self._bus.subscribe_with_sender(keys.verdict, self._on_verdict, Verdict)
        self._bus.watch_presence(Role.ACTOR, self._on_presence)

    def _hand_out(self, request: TutoringRequest) -> TutoringCase | Correction | None:
        if request.config_digest != self._agreement.digest:
            self._bus.refuse(f"actor/{request.actor}", OTHER_SETTINGS)
            return None
        self._players.note(request.actor, request.player)
        if self._lifecycle.paused:
            return None
        awaited = self._round
        if request.player.backend in self._config.tutoring_backends:
            case = self._curriculum.next_case(request.actor)
            if case is not None:
                return case
        return None if awaited is None else awaited.next_correction(request)

    def _look_for_players(self) -> None:
        """Log once if no present actor can play what is waited for."""
        problem, awaited = "", self._round
        backends = self._config.tutoring_backends
        if self._curriculum.missing:
            if self._players.lack(lambda player: player.backend in backends):
                problem = f"cases are not shown: no actor has {' or '.join(backends)}"
        elif awaited is not None and self._players.lack(awaited.is_played_by):
            problem = f"round {awaited.number} waits: no actor can practise or correct in it"
        if problem and problem != self._unplayable:
            LOG.warning(problem)
        self._unplayable = problem

    def _on_verdict(self, verdict: Verdict, sender: Sender) -> None:
        awaited = self._round
        if awaited is not None and (problem := awaited.judge(verdict)):
            self._bus.refuse(str(sender), f"a verdict is ignored: {problem}")

    def _on_presence(self, actor: str, alive: bool) -> None:
        self._players.presence(actor, alive)
        if alive:
            return
        self._curriculum.release(actor)
        if (awaited := self._round) is not None:
            awaited.release(actor)

    def _receive(self, inbox: Inbox[Sequence], wait_s: float) -> None:
        while inbox.handle(self._on_sequence, timeout_s=wait_s):
            wait_s = 0.0

    def _receive_failures(self, inbox: Inbox[EpisodeFailed]) -> None:
        while inbox.handle(self._on_failure):
            pass

    def _answer(self, actor: str, receipt: Receipt) -> None:
        self._bus.deliver(self._bus.keys.receipt(Role.LEARNER, actor), receipt)

    def _on_sequence(self, sequence: Sequence) -> None:
        episode = sequence.episode
        refusal = self._refusal(episode)
        if not refusal and self._wants(episode):
            add = partial(self._stores[episode.task].add, episode)
            if when_disk_allows(self._lifecycle, add):
                self._note(episode)
                LOG.info("stored a %s sequence, %d in all", episode.kind, self._sequences)
            else:
                refusal = "another sequence with this id is stored"
        if refusal:
            self._bus.refuse(f"actor/{episode.actor}", refusal)
        # A second demonstration of a case is not stored, but gets its receipt as well.
        self._answer(episode.actor, Receipt(episode.id, refusal))

    def _on_failure(self, report: EpisodeFailed) -> None:
        if report.kind not in _LEARNED_FROM:  # the evaluator answers it
            return
        awaited = self._round
        if self._curriculum.fail(report) or (awaited is not None and awaited.fail(report)):
            self._given_up += 1
            LOG.warning(
                "the %s of %s with the seed %d is given up, it failed %d times: %s",
                *(report.kind, report.task, report.seed, TRIES, plain(report.problem)),
            )
        self._answer(report.actor, Receipt(report.id))

    def _refusal(self, episode: Episode) -> str:
        """Why this learner will never store a sequence; empty if it might."""
        return plain(self._not_asked_for(episode) or self._misfit(episode), 1000 - len("..."))

    def _not_asked_for(self, episode: Episode) -> str:
        """Why a sequence is none that this learner asks for; empty if it is one."""
        if episode.task not in self._stores:
            return f"this run learns {' and '.join(self._stores)}, not {episode.task}"
        if episode.kind not in _LEARNED_FROM:
            return f"nothing is learned from an episode of the kind {episode.kind}"
        if episode.config_digest != self._agreement.digest:
            return OTHER_SETTINGS
        if episode.kind is Kind.TUTORING:
            return self._curriculum.refusal(episode)
        if episode.training != self._run_id:
            return f"it corrects a policy of another training than {self._run_id}"
        return ""

    def _misfit(self, episode: Episode) -> str:
        """Why a sequence cannot be the one of its seed; empty if it can."""
        task = self._tasks[episode.task]
        if episode.kind is Kind.TUTORING:
            wanted: Situation | None = task.tutored()[episode.seed // SEEDS_PER_CASE]
        else:
            wanted = situation_of_correction(episode, self._config.practised_suites(), task)
        if wanted is None or not same_situation(episode.situation, wanted):
            return f"its situation is not the one of the seed {episode.seed}"
        return misfit(episode, task, self._config.simulator.control_period_s)

    def _check_stores(self) -> list[EpisodeSummary]:
        """Set aside all files that nothing can be learned from; what the others show."""
        found = []
        for name, store in self._stores.items():
            for sequence in store.ids:
                shown = store.summary(sequence)
                if shown is None:
                    continue
                if problem := self._file_problem(shown, name):
                    store.set_aside(sequence, problem)
                else:
                    found.append(shown)
        return found

    def _file_problem(self, episode: EpisodeSummary, task: str) -> str:
        """Why a file of the run's folder is no sequence of a task; empty if it is one."""
        if episode.task != task or episode.kind not in _LEARNED_FROM:
            return f"it shows {episode.task} in an episode of the kind {episode.kind}"
        return misfit(episode, self._tasks[task], self._config.simulator.control_period_s)

    def _wants(self, shown: Shown) -> bool:
        """Whether the curriculum or the round of corrections lacks this sequence."""
        awaited = self._round
        return self._curriculum.wants(shown) or (awaited is not None and awaited.wants(shown))

    def _note(self, shown: Shown) -> None:
        """Note that this sequence is stored, so that it is not asked for any more."""
        self._curriculum.keep(shown)
        if self._round is not None:
            self._round.keep(shown)

    def _make_round(self, *, resumed: bool = False) -> Round | None:
        """The round of corrections that the next epoch has to wait for; None if there is none."""
        if not self._trainer.round_begins:
            return None
        newest = self._run_id, self._newest_version
        return Round(self._config, self._trainer.round, newest, self._situations, resumed=resumed)

    def _end_round(self) -> None:
        """End the round of corrections. Corrections that arrive later are not stored."""
        if self._round is not None:
            LOG.info(
                "round %d is over: %d corrections, %d episodes of practice judged",
                self._round.number,
                self._round.kept,
                self._round.judged,
            )
            self._round = None

    def _train(self) -> None:
        self._end_round()
        with self._training:
            self._trainer.epoch()
            over = pretraining_is_over(self._trainer)
            if over:
                self._write(lambda: self._trainer.save(pretraining_file(self._folder)))
        self._pace.add()
        self._epochs.note(self._trainer)
        if policy_is_due(self._trainer):
            with self._training:
                self._write(lambda: write_policy(self._trainer, self._folder))
            # the training is on disk before its policy is published
            LOG.info(self.checkpoint())
            self._find_newest_policy()
            self._round = self._make_round()
            self._publish()
        elif over or self._trainer.epochs_done % self._config.learner.checkpoint_every_epochs == 0:
            LOG.info(self.checkpoint())

    def _find_newest_policy(self) -> None:
        """Read the newest policy of this training that can be read; set damaged ones aside."""
        folder = policy_file(self._folder, 0).parent
        if not training_file(self._folder).exists():  # an older checkpoint had to be used
            versions = [int(p.stem) for p in folder.glob("*") if re.fullmatch("[0-9]{6}", p.stem)]
            self._trainer.version = max([self._trainer.version, *versions])
        for version in range(self._trainer.version, 0, -1):
            path = policy_file(self._folder, version)
            try:
                content = path.read_bytes()
                metadata = checkpoint_from_bytes(content, f"policy {path}").metadata
                if problem := digest_problem(path, content):
                    raise UserError(f"policy {path} is damaged: {problem}")
            except OSError:  # it is gone, or was set aside
                continue
            except UserError as error:
                self._damaged += 1
                aside = change_suffix(path, ".damaged")
                LOG.warning("%s; it is kept as %s, and the one before is used", error, aside)
                continue
            self._published = metadata.version, metadata, content
            break
        if (held := self._newest_version) < self._trainer.version:
            LOG.warning("policy %d is missing; policy %d is used", self._trainer.version, held)

    def _publish(self) -> None:
        """Publish the newest policy version, if there is any."""
        if self._published is None:
            return
        version, metadata, content = self._published
        self._bus.publish_newest(
            self._bus.keys.policy, policy_message(self._run_id, metadata, content)
        )
        LOG.info("policy %d is published (epoch %d)", version, metadata.epoch)


def _stores(config: Config) -> Mapping[str, TutoringStore]:
    """The store of each task's sequences, by the name of the task."""
    folders = {config.task.name: "tutoring"}
    if config.pretraining_task is not None:
        folders[config.pretraining_task] = "pretraining"
    return {
        task: TutoringStore(config.run_folder / name, sets_aside=True)
        for task, name in folders.items()
    }


def _run_id(folder: Path) -> str:
    """Id of the training in a run's folder; a training that starts anew gets a new one.

    The policies of the former training are moved to another folder.
    """
    path, policies = training_file(folder).with_name("run_id"), policy_file(folder, 0).parent
    before = path.read_text().strip() if path.exists() else ""
    if training_file(folder).exists() or previous_training_file(folder).exists():
        if re.fullmatch("[0-9a-f]{1,64}", before):
            return before
        LOG.warning("%s does not hold the id of the training; it gets a new one", path)
    elif any(policies.glob("*")):
        moved = policies.with_name(f"policies-{secrets.token_hex(4)}")
        rename(policies, moved)
        LOG.warning("the training starts anew; the policies of the former one are in %s", moved)
    run_id = secrets.token_hex(8)
    with written_whole(path) as stream:
        stream.write(run_id.encode())
    return run_id
