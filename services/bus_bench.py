"""Speed of the bus: `vmdnn bench bus`.

Light actors replay one recorded episode again and again, under another id and seed each time, to a
real hub, evaluator and learner. In the same run the same number of sessions sends payloads of the
same size over the same hub to a process that does nothing but answer.
"""

from __future__ import annotations

import os
import queue
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol, TypeVar

import numpy as np

from actors.bench import random_checkpoint
from actors.player import play
from actors.policies.planned import make_tutor
from actors.simulator import make_simulator
from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from learner.checkpoint import checkpoint_bytes
from proto.agreement import digest_of, settings_of
from proto.bus import Bus, NoHubError, open_bus
from proto.codec import Wire, encode
from proto.config import Config, HubConfig
from proto.episode import Episode, Kind
from proto.errors import UserError
from proto.keys import Role
from proto.machine import machine_name
from proto.messages import EpisodeOutcome, PolicyVersion, Receipt
from proto.messages import Sequence as TutoredSequence
from proto.metrics import METRICS
from proto.outbox import IN_FLIGHT
from proto.seeds import SEEDS_PER_CASE
from proto.situations import situation_of
from proto.variables import Situation

ACTORS: Final = (1, 8, 32, 128)
"""Numbers of light actors."""
PHASE_S: Final = 1.5
LIMIT_S: Final = 25.0
"""On a busy machine larger numbers are left out when so much time is over."""
START_WITHIN_S: Final = 60.0
DRAIN_S: Final = 3.0
RUN: Final = "bench"
TICK_S: Final = 1 / os.sysconf("SC_CLK_TCK")
"""The least processor time that the kernel tells apart."""
TRIALS: Final = 100
VERSION: Final = 1000
"""The published policy. Trials of all versions before it count, so there are enough of them."""
PREPARED: Final = 3000
"""Outcomes that are encoded before the time is taken: light actors must not be the slowest."""
RECEIPT_BYTES: Final = 250
"""A receipt with its attachment."""


@dataclass(frozen=True)
class Flow:
    """Episodes of one kind from a number of light actors.

    Attributes:
        actors: number of light actors.
        per_s: episodes stored with receipt, per second, of all light actors together.
        receipt_p50_ms: median time from sending an episode until its receipt (ms).
        receipt_p99_ms: 99th percentile of this time (ms).
        raw_per_s: payloads of the same size answered over the same hub without vmdnn, per second.
        of_raw: per_s in relation to raw_per_s.
        hub_ms: processor time of the hub for each episode (ms).
        receiver_ms: processor time of evaluator or learner for each episode (ms).
        receiver_per_s: episodes for which a second of their processor time is enough.
        hub_mib: memory of the hub (MiB).
        receiver_mib: memory of evaluator or learner (MiB).
    """

    actors: int
    per_s: float
    receipt_p50_ms: float
    receipt_p99_ms: float
    raw_per_s: float
    of_raw: float
    hub_ms: float
    receiver_ms: float
    receiver_per_s: float
    hub_mib: float
    receiver_mib: float


@dataclass(frozen=True)
class BusSpeed:
    """What `vmdnn bench bus` measures.

    Attributes:
        machine: the processor and the cores.
        outcome_bytes: size of an outcome message.
        sequence_bytes: size of a tutored sequence.
        policy_bytes: size of a policy.
        outcomes: trials to the evaluator.
        sequences: tutored sequences to the learner.
        policy_first_ms: time until the first of the largest number of sessions has a policy (ms).
        policy_last_ms: time until the last of them has it (ms).
    """

    machine: str
    outcome_bytes: int
    sequence_bytes: int
    policy_bytes: int
    outcomes: tuple[Flow, ...]
    sequences: tuple[Flow, ...]
    policy_first_ms: float
    policy_last_ms: float


def bench_bus(config: Config, actors: Sequence[int] = ACTORS, phase_s: float = PHASE_S) -> BusSpeed:
    """Measure the bus in less than a minute.

    Args:
        config: names task and simulator.
        actors: numbers of light actors, in rising order; on a busy machine the last are left out.
        phase_s: time for each number and kind of episode (s).

    Raises:
        UserError: the simulator cannot play the episode, or a process does not start.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vmdnn-bench-")))
        bench = _Bench(stack, config, folder)
        outcomes, sequences = [], []
        began_s = time.monotonic()
        for number in actors:
            if time.monotonic() - began_s > LIMIT_S:
                break
            bench.open_sessions(number)
            outcomes.append(bench.measure(_Outcomes(bench), "evaluator", phase_s))
            sequences.append(bench.measure(_Sequences(bench), "learner", phase_s))
        first_ms, last_ms = bench.publish_policy()
        return BusSpeed(
            machine=machine_name(),
            outcome_bytes=len(encode(EpisodeOutcome.of(bench.rollout)).payload),
            sequence_bytes=len(encode(TutoredSequence(bench.episode)).payload),
            policy_bytes=bench.policy_bytes,
            outcomes=tuple(outcomes),
            sequences=tuple(sequences),
            policy_first_ms=first_ms,
            policy_last_ms=last_ms,
        )


@dataclass(frozen=True)
class _Answer:
    """That a message was answered: number of the light actor, id, and when."""

    actor: int
    id: str
    at_s: float


class _Bench:
    """A hub, an evaluator, a learner, a process that only answers, and light actors."""

    def __init__(self, stack: ExitStack, config: Config, folder: Path) -> None:
        self._stack = stack
        self._folder = folder
        self.config = config.model_copy(
            update={
                "run": config.run.model_copy(update={"name": RUN, "folder": folder}),
                "hub": HubConfig(endpoint=_free_endpoint()),
                "tutor": config.tutor.model_copy(update={"repeats": SEEDS_PER_CASE}),
                "learner": config.learner.model_copy(
                    update={
                        "start_sequences": 10**6,  # it stores, but does not begin to train
                        "pretraining": config.learner.pretraining.model_copy(update={"task": None}),
                    }
                ),
                "evaluator": config.evaluator.model_copy(
                    update={"trials_per_policy": TRIALS, "suites": None}
                ),
                "done": type(config.done)(),
            }
        )
        self.task: Task = make_task(self.config.task)
        self.digest = digest_of(settings_of(self.config))
        self.episode = self._recorded()
        self.rollout = replace(self.episode, kind=Kind.TRIAL, training=RUN)
        self._situations: dict[int, Situation] = {}
        self._counts: Counter[str] = Counter()
        self.answers: queue.SimpleQueue[_Answer] = queue.SimpleQueue()
        self.sessions: list[Bus] = []
        self.file = folder / "config.yaml"
        self.config.save(self.file)
        (folder / RUN / "evaluation").mkdir(parents=True)  # as if an evaluator had asked before
        self._pids = {"hub": self._start("hub")}
        self._operator = self._connect(Role.WATCH, "bench")
        heard: set[str] = set()
        self._operator.subscribe(
            self._operator.keys.metrics(), lambda metrics: heard.add(metrics.role), *METRICS
        )
        for role in ("evaluator", "learner"):
            self._pids[role] = self._start(role)
        echo = (sys.executable, "-m", "services.bus_bench", self.config.hub.endpoint)
        stack.enter_context(_running(echo, folder / "echo.log"))
        _wait(lambda: {"evaluator", "learner"} <= heard, "evaluator and learner", folder)
        checkpoint = random_checkpoint(self.config.network)
        metadata = checkpoint.metadata.model_copy(
            update={
                "run": RUN,
                "version": VERSION,
                "epoch": VERSION,
                "loss": 0.5,
                "task": self.config.task.name,
                "config_digest": self.digest,
            }
        )
        self._weights = checkpoint_bytes(replace(checkpoint, metadata=metadata))
        self.policy_bytes = len(self._weights)
        self._learner = self._connect(Role.LEARNER, "learner")
        self._publish()

    def count(self, what: str) -> int:
        """The next number of something: 0, 1, 2 and so on."""
        self._counts[what] += 1
        return self._counts[what] - 1

    def situation(self, seed: int) -> Situation:
        """The situation of the trial with a seed."""
        if seed not in self._situations:
            self._situations[seed] = situation_of(self.task, None, seed)
        return self._situations[seed]

    def open_sessions(self, number: int) -> None:
        """Open sessions until there are so many light actors."""
        for actor in range(len(self.sessions), number):
            bus = self._connect(Role.ACTOR, f"light-{actor}")
            self.sessions.append(bus)
            for role in (Role.EVALUATOR, Role.LEARNER):
                bus.subscribe(bus.keys.receipt(role, bus.id), self._on_receipt(actor), Receipt)
            bus.subscribe_raw(f"{ANSWER}/{bus.id}", self._on_answer(actor))

    def measure(self, source: _Source, receiver: str, phase_s: float) -> Flow:
        """Send episodes for some time, then as many bytes without vmdnn."""
        self._wait_for(source)
        before = {name: _processor_s(self._pids[name]) for name in ("hub", receiver)}
        times, per_s = self._drive(source.send, source.window, phase_s)
        used = {name: _processor_s(self._pids[name]) - s for name, s in before.items()}
        raw = _Raw(self, source)
        _, raw_per_s = self._drive(raw.send, source.window, phase_s / 2)
        if not (times and raw_per_s):
            raise UserError(f"nothing was answered within {phase_s:g} s: this machine is too busy")
        return Flow(
            actors=len(self.sessions),
            per_s=per_s,
            receipt_p50_ms=1e3 * float(np.quantile(times, 0.5)),
            receipt_p99_ms=1e3 * float(np.quantile(times, 0.99)),
            raw_per_s=raw_per_s,
            of_raw=per_s / raw_per_s,
            hub_ms=1e3 * used["hub"] / len(times),
            receiver_ms=1e3 * used[receiver] / len(times),
            receiver_per_s=len(times) / max(used[receiver], TICK_S),
            hub_mib=_memory_mib(self._pids["hub"]),
            receiver_mib=_memory_mib(self._pids[receiver]),
        )

    def publish_policy(self) -> tuple[float, float]:
        """Publish a policy to all sessions; time until the first and the last have it (ms)."""
        arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
        for bus in self.sessions:
            bus.subscribe_newest(
                bus.keys.policy, lambda _: arrived.put(time.perf_counter()), PolicyVersion
            )
        for _ in self.sessions:  # the policy that was published before
            _take(arrived, "the policy", self._folder)
        began_s = time.perf_counter()
        self._publish()
        times = sorted(_take(arrived, "the policy", self._folder) for _ in self.sessions)
        return 1e3 * (times[0] - began_s), 1e3 * (times[-1] - began_s)

    def _publish(self) -> None:
        message = PolicyVersion(RUN, VERSION, VERSION, 0.5, self.digest, self._weights)
        self._learner.publish_newest(self._learner.keys.policy, message)

    def _drive(
        self, send: Callable[[int], str], window: int, phase_s: float
    ) -> tuple[list[float], float]:
        """Keep `window` messages of each light actor unanswered; times of answers, and rate."""
        sent_s: dict[str, float] = {}

        def send_one(actor: int) -> None:
            began_s = time.perf_counter()
            sent_s[send(actor)] = began_s

        began_s = time.perf_counter()
        for _ in range(window):
            for actor in range(len(self.sessions)):
                send_one(actor)
        times: list[float] = []
        while (left_s := began_s + phase_s - time.perf_counter()) > 0:
            try:
                answer = self.answers.get(timeout=left_s)
            except queue.Empty:
                break
            if answer.id in sent_s:
                times.append(answer.at_s - sent_s.pop(answer.id))
                send_one(answer.actor)
        rate = len(times) / (time.perf_counter() - began_s)
        over_s = time.perf_counter() + DRAIN_S
        while sent_s and time.perf_counter() < over_s:
            try:
                answer = self.answers.get(timeout=1.0)
            except queue.Empty:  # the receiver has dropped some; an actor would send them again
                break
            if answer.id in sent_s:
                times.append(answer.at_s - sent_s.pop(answer.id))
        return times, rate

    def _wait_for(self, source: _Source) -> None:
        """Send an episode until it is answered: the receiver may not have heard of the policy."""
        for _ in range(round(START_WITHIN_S)):
            source.send(0)
            try:
                self.answers.get(timeout=1.0)
            except queue.Empty:
                continue
            return
        raise UserError(f"no receipt has come; the logs: {_logs(self._folder)}")

    def _on_receipt(self, actor: int) -> Callable[[Receipt], None]:
        def on_receipt(receipt: Receipt) -> None:
            if receipt.refusal:
                raise ValueError(f"an episode was refused: {receipt.refusal}")
            self.answers.put(_Answer(actor, receipt.episode, time.perf_counter()))

        return on_receipt

    def _on_answer(self, actor: int) -> Callable[[str, bytes], None]:
        def on_answer(_key: str, payload: bytes) -> None:
            name = payload.rstrip(b" ").decode()
            self.answers.put(_Answer(actor, name, time.perf_counter()))

        return on_answer

    def _recorded(self) -> Episode:
        """An episode of the tutor."""
        situation = self.task.tutored()[0]
        with closing(make_simulator(self.config.simulator)) as simulator:
            return play(
                simulator,
                self.task,
                make_tutor(self.task),
                situation,
                seed=0,
                kind=Kind.TUTORING,
                config_digest=self.digest,
            )

    def _connect(self, role: Role, name: str) -> Bus:
        over_s = time.monotonic() + START_WITHIN_S
        while True:
            try:
                bus = open_bus(self.config.hub, RUN, role, name)
            except NoHubError:
                if time.monotonic() > over_s:
                    raise
            else:
                return self._stack.enter_context(bus)

    def _start(self, role: str) -> int:
        command = (sys.executable, "-m", "services.cli", role, "--config", str(self.file))
        return self._stack.enter_context(_running(command, self._folder / f"{role}.log"))


class _Source(Protocol):
    """Messages of one kind that light actors send.

    Attributes:
        window: messages of each actor that wait for a receipt at the same time.
        payload: one of the messages.
    """

    window: int
    payload: bytes

    def send(self, actor: int) -> str:
        """Send the next message of a light actor, and return its id."""


class _Outcomes:
    """Outcomes of trials, all of different seeds or policy versions."""

    window = IN_FLIGHT

    def __init__(self, bench: _Bench) -> None:
        self._bench = bench
        self._outcome = EpisodeOutcome.of(bench.rollout)
        self.payload = encode(self._outcome).payload

        self._prepared: list[list[tuple[str, Wire]]] = [
            [self._next(actor) for _ in range(PREPARED // len(bench.sessions))]
            for actor in range(len(bench.sessions))
        ]

    def send(self, actor: int) -> str:
        prepared = self._prepared[actor]
        name, wire = prepared.pop() if prepared else self._next(actor)
        bus = self._bench.sessions[actor]
        bus.deliver_wire(bus.keys.outcome(bus.id), wire)
        return name

    def _next(self, actor: int) -> tuple[str, Wire]:
        """The id of the next outcome, and the encoded message."""
        bench = self._bench
        number = bench.count("outcome")
        seed = bench.config.evaluator.seed + number % TRIALS
        name = f"outcome-{number:08d}"
        outcome = replace(
            self._outcome,
            id=name,
            actor=bench.sessions[actor].id,
            seed=seed,
            situation=bench.situation(seed),
            policy_version=VERSION - number // TRIALS,
        )
        return name, encode(outcome)


class _Sequences:
    """Tutored sequences, each another repeat of a case."""

    window = 1

    def __init__(self, bench: _Bench) -> None:
        self._bench = bench
        self._cases = bench.task.tutored()
        self.payload = encode(TutoredSequence(bench.episode)).payload

    def send(self, actor: int) -> str:
        bench, bus = self._bench, self._bench.sessions[actor]
        number = bench.count("sequence")
        case, name = number % len(self._cases), f"sequence-{number:08d}"
        episode = replace(
            bench.episode,
            id=name,
            actor=bus.id,
            situation=self._cases[case],
            seed=case * SEEDS_PER_CASE + number // len(self._cases),
        )
        bus.deliver(bus.keys.sequence(bus.id), TutoredSequence(episode))
        return name


class _Raw:
    """Payloads of the size of another source, whose first bytes are the id."""

    def __init__(self, bench: _Bench, other: _Source) -> None:
        self._bench = bench
        self._rest = bytes(len(other.payload))
        self.window = other.window
        self.payload = other.payload

    def send(self, actor: int) -> str:
        bus = self._bench.sessions[actor]
        name = f"raw-{self._bench.count('raw'):08d}"
        start = name.ljust(RECEIPT_BYTES).encode()
        bus.put_raw(f"{RAW}/{bus.id}", (start + self._rest)[: max(len(self._rest), len(start))])
        return name


RAW: Final = "vmdnn-bench/raw"
ANSWER: Final = "vmdnn-bench/answer"


def echo(endpoint: str) -> None:
    """Answer raw payloads with their first bytes, until this process is killed."""
    with open_bus(HubConfig(endpoint=endpoint), RUN, Role.WATCH, "echo") as bus:

        def on_payload(key: str, payload: bytes) -> None:
            actor = key.rpartition("/")[2]
            bus.put_raw(f"{ANSWER}/{actor}", payload[:RECEIPT_BYTES])

        bus.subscribe_raw(f"{RAW}/*", on_payload)
        while True:
            time.sleep(1.0)


@contextmanager
def _running(command: Sequence[str], log: Path) -> Iterator[int]:
    """Run a process until the context ends; gives its id."""
    with log.open("ab") as stream:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream)
    try:
        yield process.pid
    finally:
        process.kill()
        process.wait()


def _wait(reached: Callable[[], bool], what: str, folder: Path) -> None:
    over_s = time.monotonic() + START_WITHIN_S
    while not reached():
        if time.monotonic() > over_s:
            raise UserError(f"{what} did not start; {_logs(folder)}")
        time.sleep(0.05)


Item = TypeVar("Item")


def _take(items: queue.SimpleQueue[Item], what: str, folder: Path) -> Item:
    try:
        return items.get(timeout=START_WITHIN_S)
    except queue.Empty as error:
        raise UserError(f"{what} did not arrive; {_logs(folder)}") from error


def _logs(folder: Path) -> str:
    """The ends of the logs."""
    texts = ((log.stem, log.read_text(errors="replace")) for log in sorted(folder.glob("*.log")))
    return "; ".join(f"{name}: {text.strip()[-300:]}" for name, text in texts if text)


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _processor_s(pid: int) -> float:
    """Processor time of a process (s)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def _memory_mib(pid: int) -> float:
    """Resident memory of a process (MiB)."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    echo(sys.argv[1])
