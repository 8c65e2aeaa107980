"""Configurations of a run's processes are compared on joining, through a real hub."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fitting import settings_digest
from ports import free_endpoint
from processes import run_vmdnn, vmdnn

from proto.agreement import Agreement, differences, settings_of
from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig, load_config
from proto.errors import UserError
from proto.keys import Role
from proto.metrics import LearnerMetrics


@pytest.mark.parametrize(
    "override",
    [
        "task.name=reaching",
        "task.attention=fixed",
        "task.own_option=[1,2]",
        "simulator.physics_period_s=0.01",
        "simulator.render=false",
        "network.pfc.tau=30",
        "network.mstnn_fast.kernel=[22,12]",
        "tutor.guidance_deg=2",
        "learner.pretraining.task=reaching",
    ],
)
def test_the_digest_depends_on_what_must_agree(override: str) -> None:
    assert settings_digest(override) != settings_digest()
    key = override.partition("=")[0]
    ours, theirs = (settings_of(load_config(None, words)) for words in ([], [override]))
    assert [line.partition(" ")[0] for line in differences(ours, theirs)] == [key]


@pytest.mark.parametrize(
    "override",
    [
        "hub.endpoint=tcp/10.0.0.1:7447",
        "run.folder=/elsewhere",
        "run.seed=7",
        "actor.practice=false",
        "learner.epochs=7",
        "evaluator.trials_per_policy=7",
        "recorder.practice=false",
        "simulator.backend=my_simulators.still:Still",
    ],
)
def test_the_digest_does_not_depend_on_the_rest(override: str) -> None:
    assert settings_digest(override) == settings_digest()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


def join(stack: ExitStack, hub: HubConfig, role: Role, name: str) -> Bus:
    return stack.enter_context(open_bus(hub, "test", role, name))


def test_a_process_with_other_settings_is_refused_by_key(stack: ExitStack) -> None:
    hub = HubConfig(endpoint=free_endpoint())
    stack.enter_context(open_hub(hub, "test", "hub"))
    learner, actor = join(stack, hub, Role.LEARNER, "l"), join(stack, hub, Role.ACTOR, "a")
    other = load_config(None, ["network.pfc.tau=30", "task.attention=fixed", "learner.epochs=7"])
    Agreement(load_config(None), actor).check()  # nobody is there to disagree
    Agreement(load_config(None), learner).answer()
    Agreement(load_config(None, ["actor.practice=false"]), actor).check()
    with pytest.raises(UserError) as raised:
        Agreement(other, actor).check()
    message = str(raised.value)
    assert "differs from that of the learner l" in message
    assert "network.pfc.tau is 30.0 here and 150.0 there" in message
    assert 'task.attention is "fixed" here and "active" there' in message
    assert "learner.epochs" not in message


def test_an_actor_with_another_configuration_does_not_join(tmp_path: object) -> None:
    words = ("--connect", endpoint := free_endpoint(), "--set", "run.name=test")
    words += ("--set", f"run.folder={tmp_path}", "--set", "simulator.render=false")
    with ExitStack() as stack:
        bus = stack.enter_context(open_hub(HubConfig(endpoint=endpoint), "test", "hub"))
        inbox = bus.inbox(bus.keys.metrics(Role.LEARNER), LearnerMetrics, capacity=1)
        stack.enter_context(vmdnn("learner", *words))
        assert inbox.take(timeout_s=60.0) is not None, "the learner has started"
        ended = run_vmdnn(
            *("actor", *words, "--set", "simulator.physics_period_s=0.01"),
            *("--set", "task.attention=fixed"),
        )
    assert ended.returncode == 2
    assert "simulator.physics_period_s is 0.01 here and 0.005 there" in ended.stderr
    assert 'task.attention is "fixed" here and "active" there' in ended.stderr
    assert "Traceback" not in ended.stderr
