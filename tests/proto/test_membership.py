"""Processes live, tell, obey and stop; ids are never shared."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually, listening_hub

from proto.bus import Bus, open_bus
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Role
from proto.membership import Lifecycle, alone_in_run, every, membership, only_one, own_id
from proto.messages import Command, Control, ControlReply
from proto.metrics import METRICS, HubMetrics, Metrics


class Clerk:
    """A member of the bus that does nothing else."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.saved = 0

    def metrics(self) -> HubMetrics:
        return HubMetrics(id=self._bus.id, time_s=time.time(), refused=0, peers=self.saved)

    def checkpoint(self) -> str:
        self.saved += 1
        return f"saved {self.saved}"


def test_a_member_is_present_tells_and_obeys() -> None:
    endpoint = free_endpoint()
    config = HubConfig(endpoint=endpoint)
    with (
        listening_hub(endpoint),
        open_bus(config, "test", Role.RECORDER, "clerk") as bus,
        open_bus(config, "test", Role.WATCH, "watcher") as watcher,
    ):
        heard: list[Metrics] = []
        watcher.subscribe(watcher.keys.metrics(Role.RECORDER), heard.append, *METRICS)
        lifecycle = Lifecycle()

        def tell(command: Command) -> list[ControlReply]:
            return watcher.ask(watcher.keys.control(Role.RECORDER), Control(command), ControlReply)

        with membership(bus, Clerk(bus), lifecycle):
            eventually(lambda: watcher.present(Role.RECORDER) == {"clerk"}, "it is present")
            eventually(lambda: len(heard) >= 2, "it tells its metrics again and again")
            assert tell(Command.CHECKPOINT) == [ControlReply(Role.RECORDER, "clerk", "saved 1")]
            tell(Command.PAUSE)
            assert lifecycle.paused
            tell(Command.RESUME)
            assert not lifecycle.paused
            assert not lifecycle.stopping
            assert tell(Command.STOP)[0].note == "stopping"
            assert lifecycle.stopping


def test_only_one_of_a_role_in_a_run() -> None:
    endpoint = free_endpoint()
    config = HubConfig(endpoint=endpoint)
    with (
        listening_hub(endpoint),
        open_bus(config, "test", Role.LEARNER, "first") as first,
        open_bus(config, "test", Role.LEARNER, "second") as second,
        open_bus(config, "other", Role.LEARNER, "third") as third,
    ):
        alone_in_run(first, Lifecycle())
        first.announce()
        eventually(lambda: second.present(Role.LEARNER) == {"first"}, "the first is present")
        alone_in_run(third, Lifecycle())
        with pytest.raises(UserError, match=r"run test has a learner already \(first\)"):
            alone_in_run(second, Lifecycle(), patience_s=0.5)


def test_what_is_repeated_goes_on_after_a_failure() -> None:
    calls: list[int] = []

    def fail() -> None:
        calls.append(1)
        raise RuntimeError("on purpose")

    with every(0.01, fail):
        eventually(lambda: len(calls) >= 3, "three calls")
    seen = len(calls)
    time.sleep(0.05)
    assert len(calls) == seen


def test_signals_ask_to_stop() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            lifecycle = Lifecycle()
            lifecycle.stop_on_signals()
            assert not lifecycle.stopping
            os.kill(os.getpid(), number)
            lifecycle.wait(10.0)
            assert lifecycle.stopping
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGINT, before[1])


def test_ids_are_free_names_of_this_host(tmp_path: Path) -> None:
    with own_id(tmp_path, Role.ACTOR, None) as first, own_id(tmp_path, Role.ACTOR, None) as second:
        assert first.endswith("-1")
        assert second.endswith("-2")
        with own_id(tmp_path, Role.RECORDER, None) as other_role:
            assert other_role == first
    with own_id(tmp_path, Role.ACTOR, None) as again:
        assert again == first


def test_a_wanted_id_is_refused_while_it_is_taken(tmp_path: Path) -> None:
    with own_id(tmp_path, Role.ACTOR, "a") as taken:
        assert taken == "a"
        refused = pytest.raises(UserError, match="an actor with the id 'a' already works")
        with refused, only_one(tmp_path, Role.ACTOR, "a"):
            pass
    with own_id(tmp_path, Role.ACTOR, "a"):
        pass


def test_a_killed_process_frees_its_id(tmp_path: Path) -> None:
    script = (
        "import pathlib, sys, time\n"
        "from proto.membership import own_id\n"
        f"with own_id(pathlib.Path({str(tmp_path)!r}), 'actor', 'mortal'):\n"
        "    print('mine', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"mine\n"
        with pytest.raises(UserError), only_one(tmp_path, Role.ACTOR, "mortal"):
            pass
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    with only_one(tmp_path, Role.ACTOR, "mortal"):
        pass
