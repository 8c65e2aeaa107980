"""Hub, learner, evaluator, recorder and actors together, while processes are killed."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from subprocess import Popen
from typing import Any

from ports import free_endpoint
from processes import eventually, listening_hub, stop, vmdnn

from proto.bus import open_bus
from proto.config import HubConfig
from proto.episode import Kind
from proto.keys import Role
from proto.messages import Live, PolicyVersion
from proto.metrics import METRICS, EvaluatorMetrics, LearnerMetrics, Metrics
from proto.recordings.episodes import read_episode

FIRST_VERSIONS = 4
ROUNDS = 1
VERSIONS = FIRST_VERSIONS + ROUNDS
CORRECTED = 4
TRIALS = 4
CASES = (0, 11, 22, 44)
PRETRAINING_CASES = (0, 14)
SETTINGS = {
    "run.name": "loop",
    "simulator.render": "false",
    "actor.practice": "false",
    "tutor.repeats": 2,
    "learner.cases": list(CASES),
    "learner.start_sequences": 4,
    "learner.pretraining.task": "reaching",
    "learner.pretraining.cases": list(PRETRAINING_CASES),
    "learner.pretraining.repeats": 2,
    "learner.pretraining.epochs": 2,
    "learner.epochs": 30 * FIRST_VERSIONS,
    "learner.publish_every_epochs": 30,
    "learner.checkpoint_every_epochs": 10,
    "learner.corrections": {
        "rounds": ROUNDS,
        "choose": "random",
        "sequences": CORRECTED,
        "epochs": 20,
    },
    "evaluator.trials_per_policy": TRIALS,
    "done.policy_versions": VERSIONS,
    "done.trials": TRIALS,
}


class Loop:
    """The processes of a run, by name."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self.folder = folder / "loop"
        self.endpoint = free_endpoint()
        self._words = ["--connect", self.endpoint, "--set", f"run.folder={folder}"]
        for key, value in SETTINGS.items():
            self._words += ["--set", f"{key}={value}"]
        self.processes: dict[str, Popen[bytes]] = {}

    def start(self, role: str, name: str) -> None:
        self.processes[name] = self._stack.enter_context(
            vmdnn(role, *self._words, "--id", name, log=self.folder.parent / f"{name}.log")
        )

    def start_hub(self) -> None:
        hub = listening_hub(self.endpoint, "--set", "run.name=loop")
        self.processes["hub"] = self._stack.enter_context(hub)

    def kill_and_restart(self, role: str, name: str) -> None:
        self.processes[name].kill()
        self.processes[name].wait()
        self.start(role, name)

    def stop_all(self) -> list[int]:
        return [stop(self.processes[name]) for name in reversed(self.processes)]


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_nothing_is_lost_or_counted_twice_when_processes_are_killed(tmp_path: Path) -> None:
    with ExitStack() as stack:
        loop = Loop(stack, tmp_path)
        loop.start_hub()
        for role in ("learner", "evaluator", "recorder"):
            loop.start(role, role)
        for name in ("actor-1", "actor-2"):
            loop.start("actor", name)
        config = HubConfig(endpoint=loop.endpoint)
        bus = stack.enter_context(open_bus(config, "loop", Role.WATCH, "watch"))
        lives: list[Live] = []
        policies: list[PolicyVersion] = []
        newest: dict[str, Metrics] = {}
        bus.subscribe(bus.keys.live("actor-1"), lives.append, Live)
        kinds: set[Kind] = set()
        bus.subscribe(bus.keys.live(), lambda live: kinds.add(live.kind), Live)
        bus.subscribe_newest(bus.keys.policy, policies.append, PolicyVersion)
        bus.subscribe(bus.keys.metrics(), lambda m: newest.update({m.id: m}), *METRICS)

        eventually(lambda: any(live.step > 20 for live in lives), "a demonstration is going on")
        loop.kill_and_restart("actor", "actor-1")
        eventually(lambda: len(policies) >= 1, "a policy")
        loop.kill_and_restart("learner", "learner")
        eventually(lambda: Kind.CORRECTION in kinds, "a correction is going on")
        loop.kill_and_restart("learner", "learner")
        trials = loop.folder / "evaluation" / "trials.jsonl"
        eventually(lambda: trials.exists() and trials.stat().st_size > 0, "a counted trial")
        loop.kill_and_restart("evaluator", "evaluator")
        loop.processes["hub"].kill()
        loop.start_hub()
        lives.clear()
        eventually(lambda: any(live.step > 20 for live in lives), "a trial is going on")
        loop.kill_and_restart("actor", "actor-1")

        def done() -> bool:
            learner, evaluator = newest.get("learner"), newest.get("evaluator")
            return (
                isinstance(learner, LearnerMetrics)
                and isinstance(evaluator, EvaluatorMetrics)
                and learner.done
                and evaluator.done
            )

        eventually(done, "the run is done", patience_s=150.0)
        # what was tried twice because a lease died with its holder may still be on its way
        outboxes = loop.folder / "outbox"
        eventually(lambda: not list(outboxes.glob("*/*/*")), "every receipt has come")

        def tells_what_it_counted() -> bool:
            counted = Counter(trial["policy_version"] for trial in lines(trials))
            evaluator = newest["evaluator"]
            return isinstance(evaluator, EvaluatorMetrics) and counted == {
                score.version: score.trials for score in evaluator.policies
            }

        eventually(tells_what_it_counted, "the metrics agree with the trial log")
        assert loop.stop_all() == [0] * 6

    for folder, task, cases in (
        ("tutoring", "experiment1", CASES),
        ("pretraining", "reaching", PRETRAINING_CASES),
    ):
        sequences = [read_episode(path) for path in (loop.folder / folder).glob("*.mcap")]
        assert {episode.task for episode in sequences} == {task}
        planned = [case * 1000 + repeat for case in cases for repeat in (0, 1)]
        shown = [episode.seed for episode in sequences if episode.kind is Kind.TUTORING]
        assert sorted(shown) == sorted(planned)
        corrected = {episode.seed for episode in sequences if episode.kind is Kind.CORRECTION}
        assert len(corrected) == len(sequences) - len(planned)
        assert len(corrected) == (ROUNDS * CORRECTED if folder == "tutoring" else 0)

    versions = [policy.version for policy in policies]
    assert versions == sorted(versions)
    assert set(versions) == set(range(1, VERSIONS + 1))
    assert len({policy.run_id for policy in policies}) == 1

    counted = lines(trials)
    each = Counter((trial["policy_version"], trial["seed"]) for trial in counted)
    assert set(each.values()) == {1}
    seeds = {trial["seed"] for trial in counted if trial["policy_version"] == VERSIONS}
    assert seeds == set(range(1000, 1000 + TRIALS))
    recorded = {path.stem.rpartition("_")[2] for path in (loop.folder / "rollouts").glob("*.mcap")}
    assert {trial["episode"] for trial in counted} <= recorded
