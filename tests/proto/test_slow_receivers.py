"""Whoever reads slowly, or not at all, holds up nobody else: real sessions in real processes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub

from proto.bus import Bus, open_bus
from proto.codec import Wire
from proto.config import HubConfig
from proto.keys import Keys, Role
from proto.messages import Command, Control, ControlReply, PolicyVersion, Receipt

KEYS = Keys("test")
ROLLOUT = Wire("application/msgpack;vmdnn.test.1", bytes(500_000))
"""As large as a rollout."""
LIVE = bytes(4000)
ROUNDS = 60
LONGEST_S = 2.0
"""A sender was held up for 5 s before; a busy machine may take a second."""
VIEWER = """
import sys, time, zenoh

endpoint, how = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
config.insert_json5("scouting/multicast/enabled", "false")
pause_s = {"never": 1e6, "slow": 0.2}.get(how, 0.0)
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("vmdnn/**", lambda _: time.sleep(pause_s))
    print("listens", flush=True)
    sys.stdin.read()
"""


@contextmanager
def viewer(endpoint: str, how: str) -> Iterator[subprocess.Popen[str]]:
    """Someone who subscribes to everything, in a process of its own."""
    with subprocess.Popen(
        (sys.executable, "-c", VIEWER, endpoint, how),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "listens\n"
            yield process
        finally:
            process.kill()


class Traffic:
    """An actor that sends rollouts, and an evaluator that gives receipts."""

    def __init__(self, stack: ExitStack, endpoint: str) -> None:
        def join(role: Role) -> Bus:
            hub = HubConfig(endpoint=endpoint)
            return stack.enter_context(open_bus(hub, "test", role, str(role)))

        self.actor, self.evaluator, self.learner = map(
            join, (Role.ACTOR, Role.EVALUATOR, Role.LEARNER)
        )
        self.received = 0
        self._receipts = self.actor.inbox(
            KEYS.receipt(Role.EVALUATOR, "actor"), Receipt, capacity=1000
        )
        self.evaluator.answer(KEYS.control("evaluator"), Control, self._answer)
        self._rollouts = self.evaluator._session.declare_subscriber(
            KEYS.rollout(), lambda _: self._receive()
        )
        eventually(lambda: self.actor.watched(KEYS.rollout("actor")), "the evaluator listens")

    def _answer(self, _: Control) -> ControlReply:
        return ControlReply(Role.EVALUATOR, "evaluator", "")

    def _receive(self) -> None:
        self.received += 1
        self.evaluator.deliver(KEYS.receipt(Role.EVALUATOR, "actor"), Receipt("episode"))

    def longest_round_s(self) -> float:
        """Send rollouts, ask for work after each; the longest time that one round took (s)."""
        longest_s = 0.0
        for _ in range(ROUNDS):
            started_s = time.monotonic()
            self.actor.deliver_wire(KEYS.rollout("actor"), ROLLOUT)
            for _ in range(10):
                self.actor._session.put(KEYS.live("actor"), LIVE)
            question = Control(Command.PAUSE)
            answers = self.actor.ask(
                KEYS.control("evaluator"), question, ControlReply, timeout_s=PATIENCE_S
            )
            assert len(answers) == 1
            longest_s = max(longest_s, time.monotonic() - started_s)
        return longest_s

    def receipts(self) -> int:
        """Number of receipts that have arrived; they are forgotten."""
        return sum(iter(lambda: self._receipts.take(timeout_s=1.0) is not None, False))


@pytest.mark.parametrize("how", ["never", "frozen", "slow"])
def test_a_viewer_that_does_not_read_holds_up_nobody(how: str) -> None:
    endpoint = free_endpoint()
    with listening_hub(endpoint), ExitStack() as stack:
        traffic = Traffic(stack, endpoint)
        viewers = [stack.enter_context(viewer(endpoint, how)) for _ in range(3)]
        if how == "frozen":
            for process in viewers:
                process.send_signal(signal.SIGSTOP)
        longest_s = traffic.longest_round_s()
        receipts = traffic.receipts()
        print(f"{how}: longest round {longest_s:.3f} s, {receipts} of {ROUNDS} receipts")
        assert longest_s < LONGEST_S
        assert (traffic.received, receipts) == (ROUNDS, ROUNDS), "nobody else misses anything"


def test_a_policy_reaches_its_readers_beside_one_that_does_not_read() -> None:
    endpoint = free_endpoint()
    with listening_hub(endpoint), ExitStack() as stack:
        traffic = Traffic(stack, endpoint)
        versions: list[int] = []
        traffic.actor.subscribe_newest(
            KEYS.policy, lambda policy: versions.append(policy.version), PolicyVersion
        )
        stack.enter_context(viewer(endpoint, "never"))
        started_s = time.monotonic()
        for version in range(1, 21):
            policy = PolicyVersion("run", version, 10 * version, 0.5, "digest", bytes(2_000_000))
            traffic.learner.publish_newest(KEYS.policy, policy)
        assert time.monotonic() - started_s < LONGEST_S * 4
        eventually(lambda: versions[-1:] == [20], "the newest policy")
