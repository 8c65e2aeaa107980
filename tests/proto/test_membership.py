"""A process on the bus is present, publishes metrics and obeys; some roles allow one process."""

from __future__ import annotations

import time

import pytest
from ports import free_endpoint
from processes import eventually, listening_hub

from proto.bus import Bus, open_bus
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.membership import alone_in_run, membership
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
    ):
        alone_in_run(first, Lifecycle())
        with membership(first, IdleProcess(first), Lifecycle()):
            eventually(lambda: second.present(Role.LEARNER) == {"first"}, "the first is present")
            alone_in_run(third, Lifecycle())
            with pytest.raises(UserError, match=r"run test has a learner already \(first\)"):
                alone_in_run(second, Lifecycle(), patience_s=3.0)


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
        alone_in_run(mine, Lifecycle(), patience_s=0.5)
    assert "ignores silent, which is present but silent" in caplog.text
