"""A process on the bus is present, publishes metrics and obeys; some roles allow one process."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub, stop, vmdnn

from proto.bus import Bus, open_bus
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import FROZEN_S, alone_in_run, membership
from proto.messages import Command, Control, ControlReply
from proto.metrics import METRICS, HubMetrics, Metrics


class IdleProcess:
    """A participant that does nothing else."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.saved = 0

    def metrics(self) -> HubMetrics:
        return HubMetrics(
            role=self._bus.role, id=self._bus.id, time_s=time.time(), refused=0, peers=self.saved
        )

    def checkpoint(self) -> str:
        self.saved += 1
        return f"saved {self.saved}"


def test_a_participant_is_present_publishes_metrics_and_obeys_commands() -> None:
    endpoint = free_endpoint()
    config = HubConfig(endpoint=endpoint)
    with (
        listening_hub(endpoint),
        open_bus(config, "test", Role.RECORDER, "idle") as bus,
        open_bus(config, "test", Role.WATCH, "watcher") as watcher,
    ):
        heard: list[Metrics] = []
        watcher.subscribe(watcher.keys.metrics(Role.RECORDER), heard.append, *METRICS)
        lifecycle = Lifecycle()

        def send_command(command: Command) -> list[ControlReply]:
            return watcher.ask(watcher.keys.control(Role.RECORDER), Control(command), ControlReply)

        with membership(bus, IdleProcess(bus), lifecycle):
            eventually(lambda: watcher.present(Role.RECORDER) == {"idle"}, "it is present")
            eventually(lambda: len(heard) >= 2, "it publishes metrics again and again")
            assert send_command(Command.CHECKPOINT) == [
                ControlReply(Role.RECORDER, "idle", "saved 1")
            ]
            send_command(Command.PAUSE)
            assert lifecycle.paused
            send_command(Command.RESUME)
            assert not lifecycle.paused
            assert not lifecycle.stopping
            assert send_command(Command.STOP)[0].note == "stopping"
            assert lifecycle.stopping


def test_a_second_process_of_a_role_in_a_run_is_refused() -> None:
    endpoint = free_endpoint()
    config = HubConfig(endpoint=endpoint)
    with (
        listening_hub(endpoint),
        open_bus(config, "test", Role.LEARNER, "first") as first,
        open_bus(config, "test", Role.LEARNER, "second") as second,
        open_bus(config, "other", Role.LEARNER, "third") as third,
        alone_in_run(first, Lifecycle()),
        alone_in_run(third, Lifecycle()),
        pytest.raises(UserError, match=r"run test has a learner already \(first\)"),
        alone_in_run(second, Lifecycle()),
    ):
        pass


def test_a_token_without_a_living_process_keeps_nobody_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    endpoint = free_endpoint()
    config = HubConfig(endpoint=endpoint)
    with (
        listening_hub(endpoint),
        open_bus(config, "test", Role.LEARNER, "silent") as stranger,
        open_bus(config, "test", Role.LEARNER, "mine") as mine,
    ):
        stranger.announce()
        eventually(lambda: mine.present(Role.LEARNER) == {"silent"}, "it is present")
        with alone_in_run(mine, Lifecycle(), patience_s=0.5):
            pass
    assert "ignores silent, which is present but silent" in caplog.text


PAIRS = 20
COMPETITOR = """
import sys
from proto.bus import open_bus
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run

hub = HubConfig(endpoint=sys.argv[1])
for line in sys.stdin:
    with open_bus(hub, line.strip(), Role.LEARNER, "learner") as bus:
        print("connected", flush=True)
        sys.stdin.readline()
        try:
            with alone_in_run(bus, Lifecycle()):
                print("works", flush=True)
                sys.stdin.readline()
        except UserError:
            print("refused", flush=True)
            sys.stdin.readline()
"""


class Competitor:
    """A process that wants to be the only learner of one run after another."""

    def __init__(self, stack: ExitStack, endpoint: str) -> None:
        self._process = stack.enter_context(
            subprocess.Popen(
                (sys.executable, "-c", COMPETITOR, endpoint),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        stack.callback(self._process.kill)

    def tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def hear(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def test_of_two_that_start_at_the_same_moment_one_remains() -> None:
    endpoint = free_endpoint()
    with listening_hub(endpoint), ExitStack() as stack:
        pair = [Competitor(stack, endpoint) for _ in range(2)]
        for number in range(PAIRS):
            for competitor in pair:
                competitor.tell(f"run-{number}")
            assert [competitor.hear() for competitor in pair] == ["connected"] * 2
            for competitor in pair:
                competitor.tell("start")
            assert sorted(competitor.hear() for competitor in pair) == ["refused", "works"]
            for competitor in pair:
                competitor.tell("end")


@pytest.mark.parametrize("frozen_s", [5.0, pytest.param(15.0, marks=pytest.mark.slow)])
def test_of_one_that_was_frozen_and_one_that_started_meanwhile_one_remains(
    tmp_path: Path, frozen_s: float
) -> None:
    """The hub drops the liveliness token of a frozen process after ten seconds."""
    endpoint = free_endpoint()
    logs = {name: tmp_path / f"{name}.log" for name in ("first", "second")}

    def start(name: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
        folder = f"run.folder={tmp_path / name}"
        return vmdnn("evaluator", "--connect", endpoint, "--set", folder, log=logs[name])

    with (
        listening_hub(endpoint),
        open_bus(HubConfig(endpoint=endpoint), "experiment1", Role.WATCH, "watch") as watch,
        start("first") as first,
    ):
        eventually(lambda: watch.present(Role.EVALUATOR) != set(), "the first works")
        first.send_signal(signal.SIGSTOP)
        frozen_at_s = time.monotonic()
        with start("second") as second:
            if frozen_s > FROZEN_S:
                eventually((tmp_path / "second/experiment1/evaluation").exists, "it works")
            eventually(lambda: time.monotonic() > frozen_at_s + frozen_s, "it was frozen so long")
            first.send_signal(signal.SIGCONT)
            ends, remains = (first, second) if frozen_s > FROZEN_S else (second, first)
            assert ends.wait(PATIENCE_S) == 2
            name = "first" if ends is first else "second"
            assert "run experiment1 has an evaluator already" in logs[name].read_text()
            eventually(lambda: len(watch.present(Role.EVALUATOR)) == 1, "one is present")
            assert stop(remains) == 0
