"""The evaluator as a process assigns trials, counts each once, and continues after a kill."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest
from fitting import fitting_fields, make_policy, settings_digest, task_called
from outcomes import NOT_LIFTED, PRECISE
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub, run_vmdnn, stop, vmdnn
from run_metrics import LEARNER

from proto.bus import Bus, open_bus
from proto.config import HubConfig
from proto.disturbances import Ability
from proto.episode import Episode, Kind, Outcome
from proto.keys import Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    EpisodeFailed,
    EpisodeOutcome,
    Receipt,
    Trial,
    TrialRequest,
    Verdict,
)
from proto.metrics import EvaluatorMetrics, Stage
from proto.suites import Conditions, Player
from services.evaluator import _reasons, _report
from services.trials.success import Tally

TASK = task_called("experiment1")
MakeEpisode = Callable[..., Episode]
SAPIEN = Player("sapien")


class EvaluatorSetup:
    """A hub, an evaluator, and sessions that play the roles of learner and actors."""

    def __init__(self, stack: ExitStack, folder: Path, make_episode: MakeEpisode) -> None:
        self._stack = stack
        self._make_episode = make_episode
        self.endpoint = free_endpoint()
        self.log = folder / "evaluator.log"
        self.words = (
            *("--connect", self.endpoint, "--set", f"run.folder={folder}"),
            *("--set", "run.name=test", "--set", "evaluator.trials_per_policy=3"),
            *("--set", "evaluator.seed=70", "--set", "evaluator.lease_s=1000"),
            *("--set", "done.trials=3"),
            *("--set", "done.policy_versions=2"),
        )
        stack.enter_context(listening_hub(self.endpoint))
        self.metrics: EvaluatorMetrics | None = None
        self.learner = self.join(Role.LEARNER, "learner")
        self.learner.announce()
        self.learner.subscribe(
            self.learner.keys.metrics(Role.EVALUATOR), self._listen, EvaluatorMetrics
        )
        self.verdicts: list[Verdict] = []
        self.learner.subscribe(self.learner.keys.verdict, self.verdicts.append, Verdict)
        self.process = self.start()

    def start(self, *more: str) -> Popen[bytes]:
        self.metrics = None
        self.process = self._stack.enter_context(
            vmdnn("evaluator", *self.words, *more, log=self.log)
        )
        return self.process

    def restart(self, *more: str) -> None:
        self.process.kill()
        self.process.wait()
        self.start(*more)

    def tell_stage(self, stage: Stage) -> None:
        """Publish the learner's metrics in a stage."""
        metrics = replace(LEARNER, id="learner", stage=stage)
        self.learner.publish(self.learner.keys.metrics(Role.LEARNER, "learner"), metrics)

    def join(self, role: Role, name: str) -> Bus:
        bus = open_bus(HubConfig(endpoint=self.endpoint), "test", role, name)
        return self._stack.enter_context(bus)

    def publish(self, version: int, run_id: str = "training") -> None:
        policy = make_policy(version, run_id)
        self.learner.publish_newest(self.learner.keys.policy, policy)

    def ask(
        self, actor: Bus, version: int, run_id: str = "training", player: Player = SAPIEN
    ) -> list[int]:
        given = self.ask_with_older(actor, version, (), run_id, player)
        assert {asked for asked, _ in given} <= {version}
        return [seed for _, seed in given]

    def ask_with_older(
        self,
        actor: Bus,
        version: int,
        older: tuple[int, ...],
        run_id: str = "training",
        player: Player = SAPIEN,
    ) -> list[tuple[int, int]]:
        """Version and seed of the trial that an actor gets that also holds older versions."""
        request = TrialRequest(actor.id, run_id, version, settings_digest(), player, older)
        key = actor.keys.request_trial
        given = actor.ask(
            key, request, Trial, timeout_s=PATIENCE_S
        )  # a late answer is a lost trial
        return [(trial.policy_version, trial.seed) for trial in given]

    def ask_until_given(self, actor: Bus, version: int) -> int:
        seeds: list[int] = []

        def given() -> bool:
            seeds.extend(self.ask(actor, version))
            return bool(seeds)

        eventually(given, f"a trial of policy {version}")
        return seeds[0]

    def verdicts_by_seed(self) -> dict[int, Verdict]:
        return {verdict.seed: verdict for verdict in self.verdicts}

    def wait_for_metrics(self, ready: Callable[[EvaluatorMetrics], bool]) -> EvaluatorMetrics:
        """Wait until the newest metrics satisfy `ready`."""
        eventually(lambda: self.metrics is not None and ready(self.metrics), "the expected metrics")
        assert self.metrics is not None
        return self.metrics

    def send(self, actor: Bus, seed: int, version: int, **fields: object) -> Episode:
        """Send an outcome until its receipt arrives."""
        episode = self._episode(actor, seed, version, **fields)
        outcome = EpisodeOutcome.of(episode)
        assert self._answer(actor, episode.id, actor.keys.outcome(actor.id), outcome) == ""
        return episode

    def refused(self, actor: Bus, seed: int, version: int, **fields: object) -> str:
        """Send an outcome until it is refused; return the reason."""
        episode = self._episode(actor, seed, version, **fields)
        outcome = EpisodeOutcome.of(episode)
        return self._answer(actor, episode.id, actor.keys.outcome(actor.id), outcome)

    def fail(self, actor: Bus, report: EpisodeFailed) -> str:
        """Report a failed simulation until its receipt arrives; return the refusal."""
        return self._answer(actor, report.id, actor.keys.failure(actor.id), report)

    def _episode(self, actor: Bus, seed: int, version: int, **fields: object) -> Episode:
        given = {
            **fitting_fields(),
            "kind": Kind.TRIAL,
            "outcome": PRECISE,
            "id": f"{seed}-{version}",
            "situation": dict(TASK.sample(seed)),
            "training": "training",
            **fields,
        }
        steps = len(given["phases"])
        return self._make_episode(steps, actor=actor.id, seed=seed, policy_version=version, **given)

    def _answer(self, actor: Bus, name: str, key: str, message: object) -> str:
        receipts: list[Receipt] = []
        actor.subscribe(actor.keys.receipt(Role.EVALUATOR, actor.id), receipts.append, Receipt)

        def answers() -> list[Receipt]:
            return [receipt for receipt in list(receipts) if receipt.episode == name]

        def answered() -> bool:
            actor.deliver(key, message)
            return bool(answers())

        eventually(answered, "an answer")
        return answers()[0].refusal

    def _listen(self, metrics: EvaluatorMetrics) -> None:
        self.metrics = metrics


@pytest.fixture
def setup(tmp_path: Path, make_episode: MakeEpisode) -> Iterator[EvaluatorSetup]:
    with ExitStack() as stack:
        yield EvaluatorSetup(stack, tmp_path, make_episode)


def counts(metrics: EvaluatorMetrics) -> dict[int, int]:
    return {score.version: score.trials for score in metrics.policies}


def test_every_policy_gets_the_same_situations_each_counted_once(setup: EvaluatorSetup) -> None:
    actor, other = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "b")
    setup.publish(1)
    seeds = [setup.ask_until_given(actor, 1), *setup.ask(other, 1), *setup.ask(actor, 1)]
    assert seeds == [70, 71, 72]
    assert setup.ask(other, 1) == [], "all three are being played"
    setup.wait_for_metrics(lambda metrics: metrics.leases == 3)

    setup.send(actor, 70, 1)
    setup.send(actor, 70, 1)
    setup.send(other, 70, 1, id="another-episode-of-this-trial", outcome=NOT_LIFTED)
    setup.send(other, 71, 1, outcome=NOT_LIFTED)
    assert setup.refused(other, 99, 1) == "no trial with the seed 99 is asked for"
    setup.send(actor, 2**30 + 5, 1, kind=Kind.PRACTICE)
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 2})
    score = metrics.policies[0]
    assert (score.precise.successes, score.precise.rate) == (1, 0.5)
    assert score.precise.wilson95 == pytest.approx((0.0945, 0.9055), abs=1e-3)
    assert score.reasons == {"not_lifted": 1}
    assert not metrics.done

    setup.publish(2)
    assert setup.ask_until_given(actor, 2) == 70
    assert [*setup.ask(actor, 2), *setup.ask(actor, 2)] == [71, 72]
    assert setup.ask(actor, 1) == [], "only the newest policy is tried"
    setup.send(actor, 72, 1)  # was under way when the newer policy came
    for seed in (70, 71, 72):
        setup.send(actor, seed, 2)
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 3, 2: 3})
    assert metrics.done
    assert metrics.leases == 0
    assert setup.ask(actor, 2) == [], "the newest policy is counted in full"


def test_each_policy_gets_its_first_trials_also_when_a_newer_one_is_there(
    setup: EvaluatorSetup,
) -> None:
    setup.restart("--set", "evaluator.first_trials=2")
    actor, other = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "b")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    setup.publish(2)
    assert setup.ask_until_given(other, 2) == 70
    assert setup.ask(other, 1) == [71], "the second first trial of the older policy"
    assert setup.ask(actor, 1) == [], "it gets no more than two"
    assert setup.ask(actor, 3) == []
    setup.send(actor, 70, 1)
    setup.send(other, 71, 1)
    assert setup.ask(actor, 1) == []
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 2})
    assert metrics.leases == 1


def test_it_catches_up_on_earlier_policies_when_nothing_newer_waits(
    setup: EvaluatorSetup,
) -> None:
    actor, other = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "b")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    setup.publish(3)  # version 2 never arrived here
    assert setup.ask_until_given(actor, 3) == 70
    assert setup.ask_with_older(actor, 3, (1, 2)) == [(3, 71)], "the newest comes first"
    assert setup.ask_with_older(other, 3, (1, 2)) == [(3, 72)]
    assert setup.ask_with_older(other, 3, (2,)) == [(2, 70)], "the later of the earlier ones"
    assert setup.ask_with_older(other, 3, (1,)) == [(1, 71)], "70 is being played"
    assert setup.ask_with_older(other, 3, (3, 4)) == [], "these are not earlier"
    for seed, version in ((70, 1), (71, 1), (70, 2), (70, 3), (71, 3), (72, 3)):
        setup.send(
            other if (seed, version) in ((71, 1), (70, 2), (72, 3)) else actor, seed, version
        )
    setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 2, 2: 1, 3: 3})

    setup.tell_stage(Stage.WAITING)  # the learner waits for failures in practice
    eventually(lambda: not setup.ask_with_older(actor, 3, (2,)), "practice comes first")
    setup.tell_stage(Stage.COUPLED)
    eventually(lambda: setup.ask_with_older(other, 3, (1, 2)) != [], "it catches up again")
    setup.wait_for_metrics(lambda metrics: metrics.waiting_for.endswith("of earlier policies"))


def test_it_says_which_earlier_policies_no_actor_can_play_any_more(setup: EvaluatorSetup) -> None:
    actor, other = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "b")
    for bus in (actor, other):
        bus.announce()
    setup.publish(4)
    assert setup.ask_until_given(actor, 4) == 70
    # From here on the evaluator knows what both hold: it may look at any time.
    assert setup.ask_with_older(actor, 4, (3,)) == [(4, 71)]
    assert setup.ask_with_older(other, 4, ()) == [(4, 72)]
    for bus, seed in ((actor, 70), (actor, 71), (other, 72)):
        setup.send(bus, seed, 4)
    assert setup.ask_with_older(actor, 4, (3,)) == [(3, 70)]
    assert setup.ask_with_older(other, 4, ()) == []
    said = "no actor has the policies 1, 2 any more"
    eventually(lambda: said in setup.log.read_text(), "it says so")
    actor.close()
    eventually(lambda: "no actor has policy 3 any more" in setup.log.read_text(), "it says so")
    assert setup.log.read_text().count(said) == 1


def test_nothing_counts_that_was_not_asked_for(setup: EvaluatorSetup) -> None:
    actor, stranger = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "s")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    request = TrialRequest("s", "training", 1, settings_digest("task.attention=fixed"), SAPIEN)
    assert stranger.ask(stranger.keys.request_trial, request, Trial) == []
    for name, wrong, problem in (
        ("no-lease", {}, "was not asked of s"),
        ("no-training", {"training": "invented"}, "no policy 1 of the training invented"),
        ("no-place", {"situation": {}}, "its situation is not the one of the seed 70"),
        ("case", {"situation": dict(TASK.sample(71))}, "its situation is not the one"),
    ):
        assert problem in setup.refused(stranger, 70, 1, id=name, **wrong)
    for name, wrong, problem in (
        ("config", {"config_digest": settings_digest("task.attention=fixed")}, "configuration"),
        ("short", {"phases": TASK.phases[:9], "actions": np.zeros((9, 11), np.float32)}, "9 steps"),
    ):
        steps = len(wrong.get("phases", TASK.phases))  # type: ignore[arg-type]
        fields = {"targets": np.zeros((steps, 11), np.float32), **wrong}
        assert problem in setup.refused(actor, 70, 1, id=name, **fields)

    # Policies that this run never published change nothing, nor do trials of them.
    for odd in (make_policy(10**6, task="reaching"), replace(make_policy(2), version=5, epoch=50)):
        setup.learner.publish_newest(setup.learner.keys.policy, odd)
    unheard = EpisodeOutcome.of(setup._episode(stranger, 70, 9, id="version-9"))
    stranger.deliver(stranger.keys.outcome("s"), unheard)
    setup.send(actor, 70, 1, outcome=PRECISE)
    many = [Outcome(False, False, False, f"reason_{number}", {}) for number in range(2)]
    assert [*setup.ask(actor, 1), *setup.ask(actor, 1)] == [71, 72]
    for seed, outcome in zip((71, 72), many, strict=True):
        setup.send(actor, seed, 1, outcome=outcome)
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 3})
    assert metrics.policies[0].reasons == {"reason_0": 1, "reason_1": 1}
    assert metrics.refused >= 9, "messages are sent until they are answered"


def test_many_trials_that_come_together_take_one_line_of_the_log_for_each_policy(
    make_episode: MakeEpisode, caplog: pytest.LogCaptureFixture
) -> None:
    fields = fitting_fields() | {"kind": Kind.TRIAL, "training": "training"}
    steps = len(fields["phases"])
    played = []
    for seed in range(20):
        fields["outcome"] = NOT_LIFTED if seed < 3 else PRECISE
        episode = make_episode(steps, seed=seed, policy_version=1 + seed % 2, **fields)
        played.append(EpisodeOutcome.of(episode))
    with caplog.at_level(logging.INFO):
        _report(played[:2])
        _report(played)
    assert [record.message for record in caplog.records] == [
        "policy 1, trial 0: not lifted",
        "policy 2, trial 1: not lifted",
        "policy 1, 10 trials: 8 strict",
        "policy 2, 10 trials: 9 strict",
    ]


def test_many_reasons_fit_into_the_metrics() -> None:
    tally = Tally.of(Outcome(False, False, False, f"reason_{n}", {}) for n in range(100))
    told = _reasons(tally)
    assert len(told) == 32
    assert sum(told.values()) == 100


def test_a_trial_that_an_evaluator_before_asked_for_is_not_lost(setup: EvaluatorSetup) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    setup.process.kill()
    setup.process.wait()
    setup.start()
    setup.send(actor, 70, 1)
    setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 1})


def test_the_learner_gets_verdicts_of_practice_but_not_of_trials(
    setup: EvaluatorSetup,
) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(1)
    setup.ask_until_given(actor, 1)
    setup.send(actor, 70, 1, outcome=NOT_LIFTED)
    practice = {"kind": Kind.PRACTICE, "outcome": NOT_LIFTED}
    assert "one of trials" in setup.refused(actor, 70, 1, id="practised", **practice)
    other_task = setup.refused(actor, 98, 1, id="another-task", task="reaching", **practice)
    assert other_task == "this run tests experiment1, not reaching"
    shown = setup.refused(actor, 97, 1, id="shown", kind=Kind.TUTORING)
    assert shown == "an episode of the kind tutoring is not evaluated"
    practised = setup.send(actor, 2**30, 1, kind=Kind.PRACTICE, outcome=NOT_LIFTED)
    eventually(lambda: bool(setup.verdicts), "a verdict")
    assert set(setup.verdicts_by_seed()) == {2**30}
    verdict = setup.verdicts_by_seed()[2**30]
    assert (verdict.run_id, verdict.policy_version, verdict.task) == ("training", 1, "experiment1")
    assert (verdict.outcome, dict(verdict.situation)) == (NOT_LIFTED, dict(practised.situation))


def test_a_killed_evaluator_keeps_its_counts(setup: EvaluatorSetup) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    setup.send(actor, 70, 1)
    setup.process.kill()
    setup.process.wait()
    setup.start()
    setup.send(actor, 70, 1)  # its receipt might have been lost
    assert setup.ask_until_given(actor, 1) == 71
    assert counts(setup.wait_for_metrics(lambda metrics: bool(metrics.policies))) == {1: 1}
    assert stop(setup.process) == 0


def test_a_trial_whose_simulation_fails_three_times_is_a_failure(
    setup: EvaluatorSetup, failure: Callable[..., EpisodeFailed]
) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(1)
    assert setup.ask_until_given(actor, 1) == 70
    trial = {"actor": "a", "kind": Kind.TRIAL, "training": "training", "policy_version": 1}
    trial["situation"] = dict(TASK.sample(70))
    for name in ("first", "second"):
        assert setup.fail(actor, failure(name, seed=70, **trial)) == ""
        assert setup.ask(actor, 1) == [70], "it is tried again"
    late = failure("first", seed=70, **trial)
    assert setup.fail(actor, late) == "", "a copy of a report counts once"
    assert setup.ask(actor, 1) == [71], "and the trial is still being played"
    assert setup.fail(actor, failure("third", seed=70, **trial)) == ""
    assert "seed 99" in setup.fail(actor, failure("nobody-asked", seed=99, **trial))
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 1})
    assert metrics.policies[0].reasons == {"simulation_failed": 1}
    assert metrics.policies[0].lenient.successes == 0
    assert setup.ask(actor, 1) != [70]
    setup.process.kill()
    setup.process.wait()
    setup.start()
    assert setup.ask_until_given(actor, 1) == 71


def test_a_trial_that_kills_three_actors_is_a_failure(
    setup: EvaluatorSetup, failure: Callable[..., EpisodeFailed]
) -> None:
    trial = {"kind": Kind.TRIAL, "training": "training", "policy_version": 1, "seed": 70}
    trial |= {"situation": dict(TASK.sample(70)), "died": True}
    setup.publish(1)
    for attempt in range(3):
        with open_bus(HubConfig(endpoint=setup.endpoint), "test", Role.ACTOR, "mortal") as mortal:
            mortal.announce()
            assert setup.ask_until_given(mortal, 1) == 70
        # The next process of this actor reports what its predecessor died of.
        heir = setup.join(Role.ACTOR, "mortal")
        assert setup.fail(heir, failure(f"death-{attempt}", actor="mortal", **trial)) == ""
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 1})
    assert metrics.policies[0].reasons == {"could_not_be_finished": 1}
    setup.restart()
    assert setup.ask_until_given(setup.join(Role.ACTOR, "other"), 1) == 71
    metrics = setup.wait_for_metrics(lambda metrics: counts(metrics) == {1: 1})
    assert metrics.policies[0].reasons == {"could_not_be_finished": 1}


def test_a_trial_of_a_dead_actor_is_assigned_to_another(setup: EvaluatorSetup) -> None:
    mortal, other = setup.join(Role.ACTOR, "mortal"), setup.join(Role.ACTOR, "other")
    mortal.announce()
    setup.publish(1)
    assert setup.ask_until_given(mortal, 1) == 70
    assert setup.ask(other, 1) == [71]
    mortal.close()
    eventually(lambda: setup.ask(other, 1) == [70], "the dead actor's trial")


def test_a_new_training_is_counted_separately(setup: EvaluatorSetup) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(5)
    assert setup.ask_until_given(actor, 5) == 70
    setup.send(actor, 70, 5)
    setup.wait_for_metrics(lambda metrics: counts(metrics) == {5: 1})
    setup.publish(1, run_id="started-from-nothing")
    setup.wait_for_metrics(lambda metrics: counts(metrics) == {})
    assert setup.ask(actor, 1, run_id="started-from-nothing") == [70]


def test_a_paused_evaluator_counts_but_assigns_no_trials(setup: EvaluatorSetup) -> None:
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(1)
    setup.ask_until_given(actor, 1)
    control = actor.keys.control(Role.EVALUATOR)
    assert [r.note for r in actor.ask(control, Control(Command.PAUSE), ControlReply)] == ["paused"]
    assert setup.ask(actor, 1) == []
    setup.send(actor, 70, 1)
    setup.wait_for_metrics(lambda metrics: metrics.paused and counts(metrics) == {1: 1})
    actor.ask(control, Control(Command.RESUME), ControlReply)
    assert setup.ask(actor, 1) == [71]
    actor.ask(control, Control(Command.STOP), ControlReply)
    assert setup.process.wait(30) == 0


SUITES = (
    "evaluator.suites=[{name: unlearned, trials: 1}, {name: pushed, trials: 2, seed: 500},"
    " {name: elsewhere, trials: 1, seed: 600, backend: other}]"
)


def counts_by_suite(metrics: EvaluatorMetrics) -> dict[str, int]:
    return {suite.name: sum(score.trials for score in suite.policies) for suite in metrics.suites}


def test_each_actor_gets_trials_of_the_suites_that_it_can_play(setup: EvaluatorSetup) -> None:
    setup.restart("--set", SUITES, "--set", "done.trials=2")
    actor, other = setup.join(Role.ACTOR, "a"), setup.join(Role.ACTOR, "b")
    able, plain, foreign = Player("sapien", (Ability.SHOVES,)), SAPIEN, Player("other")
    setup.publish(2)
    assert setup.ask_until_given(actor, 2) == 70
    setup.wait_for_metrics(lambda metrics: metrics.leases == 1)
    assert setup.ask(actor, 2, player=plain) == [], "it cannot push"
    (trial,) = actor.ask(
        actor.keys.request_trial,
        TrialRequest("a", "training", 2, settings_digest(), able),
        Trial,
        timeout_s=60.0,
    )
    assert trial == Trial(2, 500, trial.conditions)
    assert trial.conditions is not None
    assert (trial.conditions.suite, trial.conditions.disturbance) == ("pushed", "pushed")
    assert setup.ask(other, 2, player=foreign) == [600]

    setup.send(actor, 70, 2)
    played = {"conditions": trial.conditions}
    weaker = replace(trial.conditions, strength=trial.conditions.strength / 2 + 5)
    assert "other conditions" in setup.refused(actor, 500, 2, id="w", conditions=weaker)
    assert "no suite" in setup.refused(actor, 500, 2, id="x", conditions=Conditions("beyond"))
    assert "no trial with the seed 71" in setup.refused(actor, 71, 2, id="y", **played)
    here = {"conditions": Conditions("elsewhere"), "id": "z"}
    assert "played in other, not in sapien" in setup.refused(actor, 600, 2, **here)
    setup.send(actor, 500, 2, outcome=NOT_LIFTED, **played)
    practice = {"kind": Kind.PRACTICE, "id": "p", "outcome": NOT_LIFTED}
    assert "one of trials" in setup.refused(actor, 501, 2, **practice)
    metrics = setup.wait_for_metrics(lambda metrics: counts_by_suite(metrics)["pushed"] == 1)
    assert counts_by_suite(metrics) == {"unlearned": 1, "pushed": 1, "elsewhere": 0}
    assert counts(metrics) == {2: 1}, "the first suite"
    assert [(suite.trials, suite.backend) for suite in metrics.suites] == [
        *((1, "sapien"), (2, "sapien"), (1, "other")),
    ]


def test_a_suite_that_no_actor_can_play_is_told_and_not_waited_for(setup: EvaluatorSetup) -> None:
    setup.restart("--set", SUITES, "--set", "done.trials=2")
    actor = setup.join(Role.ACTOR, "a")
    setup.publish(2)
    assert setup.ask_until_given(actor, 2) == 70
    setup.send(actor, 70, 2)

    def told(metrics: EvaluatorMetrics) -> bool:
        return all(suite.unplayable for suite in metrics.suites[1:])

    metrics = setup.wait_for_metrics(told)
    assert [suite.unplayable for suite in metrics.suites] == [
        "",
        "no actor with sapien can play the disturbance pushed",
        "no actor has other",
    ]
    setup.wait_for_metrics(lambda metrics: metrics.done)
    setup.ask(actor, 2, player=Player("other"))
    metrics = setup.wait_for_metrics(lambda metrics: not metrics.suites[2].unplayable)
    assert not metrics.done, "now it can be waited for"


def test_a_suite_that_the_task_cannot_be_played_with_is_bad_input(tmp_path: Path) -> None:
    words = ("--set", f"run.folder={tmp_path}", "--set", "evaluator.suites=[unlearned, pushed]")
    with listening_hub(endpoint := free_endpoint()):
        own = ("--set", "task.name=tests.plain_task:PlainTask")
        ended = run_vmdnn("evaluator", "--connect", endpoint, *words, *own)
    assert ended.returncode == 2
    assert "cannot be played with the disturbance 'pushed'" in ended.stderr


def test_a_second_evaluator_of_the_same_folder_is_refused(setup: EvaluatorSetup) -> None:
    setup.wait_for_metrics(lambda _: True)
    second = run_vmdnn("evaluator", *setup.words, "--id", "second")
    assert second.returncode == 2
    assert "already works in" in second.stderr
