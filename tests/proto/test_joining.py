"""A process that joins gets the run's configuration from its learner, and an id of its own."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import listening_hub, run_vmdnn

from proto.bus import Bus, open_bus
from proto.config import Config, HubConfig, load_config
from proto.errors import UserError
from proto.joining import Claim, answer_configuration, ask_configuration
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.messages import ConfigurationRequest, RunConfiguration

OURS = ["run.name=test", "task.attention=fixed", "network.pfc.tau=31", "run.folder=/theirs"]
OF_THIS_MACHINE = ["run.name=test", "run.folder=/ours", "actor.practice=false"]


class Network:
    """A hub, and sessions at it."""

    def __init__(self, stack: ExitStack) -> None:
        self.endpoint = free_endpoint()
        self._stack = stack
        stack.enter_context(listening_hub(self.endpoint))

    def join(self, role: Role, name: str) -> Bus:
        bus = open_bus(HubConfig(endpoint=self.endpoint), "test", role, name)
        return self._stack.enter_context(bus)

    @contextmanager
    def learner(self, config: Config) -> Iterator[None]:
        with open_bus(HubConfig(endpoint=self.endpoint), "test", Role.LEARNER, "learner") as bus:
            answer_configuration(bus, config)
            yield


@pytest.fixture(scope="module")
def net() -> Iterator[Network]:
    with ExitStack() as stack:
        yield Network(stack)


def test_the_configuration_comes_from_the_learner(net: Network) -> None:
    theirs = load_config(None, [*OURS, "hub.endpoint=tcp/127.0.0.1:1"])
    with net.learner(theirs):
        got = ask_configuration(net.join(Role.ACTOR, "a"), OF_THIS_MACHINE, Lifecycle())
    assert got is not None
    assert (got.task, got.network) == (theirs.task, theirs.network)
    assert got.run.folder == Path("/ours")
    assert got.hub == HubConfig()
    assert not got.actor.practice


def test_without_a_learner_it_waits_until_it_is_stopped(net: Network) -> None:
    lifecycle = Lifecycle()
    with ThreadPoolExecutor() as pool:
        asking = pool.submit(ask_configuration, net.join(Role.ACTOR, "b"), [], lifecycle)
        while "from its learner" not in lifecycle.waiting_for:
            pass
        lifecycle.stop()
        assert asking.result(30) is None


@pytest.mark.parametrize(
    ("words", "allowed"),
    [
        ("task.name=touch:TouchBox", "task.name=touch:TouchBox"),
        ("simulator.backend=my.still:Still", "simulator.backend=my.still:Still"),
        ("learner.pretraining.task=touch:TouchBox", "learner.pretraining.task=touch:TouchBox"),
    ],
)
def test_code_is_run_only_if_this_machine_names_it(words: str, allowed: str, net: Network) -> None:
    bus = net.join(Role.ACTOR, "c")
    with net.learner(load_config(None, [*OURS, words])):
        with pytest.raises(UserError, match=r"names code to run, .*not taken over the network"):
            ask_configuration(bus, OF_THIS_MACHINE, Lifecycle())
        assert ask_configuration(bus, [*OF_THIS_MACHINE, allowed], Lifecycle()) is not None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"run": {"name": "test"}, "learner": {"of_the_future": 1}}', "there is no such key"),
        ('{"run": {"name": "other"}}', "is not what it was there"),
        ('{"run": {"name": "test"}}', "all processes of a run need the same vmdnn"),
        ("[", "cannot be read"),
        ("[]", "has no section `run`"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_refused(
    text: str, problem: str, net: Network
) -> None:
    with open_bus(HubConfig(endpoint=net.endpoint), "test", Role.LEARNER, "learner") as learner:
        learner.answer(
            learner.keys.configuration,
            ConfigurationRequest,
            lambda _: RunConfiguration(text, "0123456789ab"),
        )
        with pytest.raises(UserError, match=problem):
            ask_configuration(net.join(Role.ACTOR, "d"), [], Lifecycle())


def test_an_id_is_used_once_also_by_those_who_join_at_the_same_time(net: Network) -> None:
    first = Claim(net.join(Role.ACTOR, "same"))
    assert first.holds(Lifecycle())
    with ThreadPoolExecutor() as pool:
        claims = [Claim(net.join(Role.ACTOR, name)) for name in ["same", *["new"] * 5]]
        held = list(pool.map(lambda claim: claim.holds(Lifecycle()), claims))
    assert held[0] is False
    assert sum(held) == 1


def test_an_actor_with_the_id_of_another_is_refused(net: Network, tmp_path: Path) -> None:
    assert Claim(net.join(Role.ACTOR, "mine")).holds(Lifecycle())
    words = ("--connect", net.endpoint, "--set", f"run.folder={tmp_path}")
    ended = run_vmdnn("actor", "--run", "test", "--id", "mine", *words)
    assert ended.returncode == 2
    assert "the run test has an actor with the id mine already, on another machine" in ended.stderr
