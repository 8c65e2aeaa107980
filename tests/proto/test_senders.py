"""Messages are taken only from those who may send them, between real sessions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from fitting import make_policy
from hypothesis import given
from hypothesis import strategies as st
from outcomes import NOT_LIFTED
from ports import free_endpoint
from processes import eventually

from proto.bus import Bus, open_bus, open_hub
from proto.config import HubConfig
from proto.episode import Episode
from proto.keys import Keys, Role
from proto.messages import PolicyVersion, Receipt, Rollout, Verdict
from proto.senders import Sender, is_id, origin_problem

KEYS = Keys("test")
VERDICT = Verdict("t", 1, "experiment1", 2**30, {"object_y_m": 0.25}, NOT_LIFTED, "sapien")
LEARNER, EVALUATOR, ACTOR = (
    Sender(role, "x") for role in (Role.LEARNER, Role.EVALUATOR, Role.ACTOR)
)


@given(st.text(max_size=80) | st.from_regex(r"\A(actor|hub|king)/[a-z.-]{0,70}\n?\Z"))
def test_what_is_read_as_a_sender_is_a_role_and_an_id(text: str) -> None:
    sender = Sender.parse(text)
    if sender is not None:
        assert str(sender) == text
        assert is_id(sender.id)


@pytest.mark.parametrize(
    ("message", "key", "sender", "problem"),
    [
        (Receipt("e"), KEYS.receipt(Role.LEARNER, "a"), LEARNER, ""),
        (Receipt("e"), KEYS.receipt(Role.LEARNER, "a"), EVALUATOR, ""),
        (Receipt("e"), KEYS.receipt(Role.LEARNER, "a"), ACTOR, "not actor/x"),
        (Receipt("e"), KEYS.receipt(Role.LEARNER, "a"), None, "without a name"),
        (VERDICT, KEYS.verdict, EVALUATOR, ""),
        (VERDICT, KEYS.verdict, LEARNER, "only evaluator"),
        (make_policy(1), KEYS.policy, LEARNER, ""),
        (make_policy(1), KEYS.policy, EVALUATOR, "only learner"),
    ],
)
def test_some_messages_come_from_some_roles_only(
    message: Any, key: str, sender: Sender | None, problem: str
) -> None:
    found = origin_problem(message, key, sender)
    assert problem in found
    assert bool(problem) == bool(found)


def test_an_episode_comes_under_the_key_of_its_actor(make_episode: Callable[..., Episode]) -> None:
    rollout = Rollout(make_episode(3, actor="a"), "t")
    assert origin_problem(rollout, KEYS.rollout("a"), None) == ""
    assert "another process" in origin_problem(rollout, KEYS.rollout("b"), None)


@pytest.fixture
def joined() -> Iterator[Callable[[Role, str], Bus]]:
    hub = HubConfig(endpoint=free_endpoint())
    with ExitStack() as stack:
        stack.enter_context(open_hub(hub, "test", "hub"))
        yield lambda role, name: stack.enter_context(open_bus(hub, "test", role, name))


def test_strangers_publish_no_policies_and_give_no_receipts(
    joined: Callable[[Role, str], Bus],
) -> None:
    actor = joined(Role.ACTOR, "a")
    stranger, learner = joined(Role.WATCH, "w"), joined(Role.LEARNER, "l")
    policies: list[PolicyVersion] = []
    receipts: list[tuple[Receipt, Sender]] = []
    actor.subscribe_newest(KEYS.policy, policies.append, PolicyVersion)
    actor.subscribe_with_sender(
        KEYS.receipt(Role.LEARNER, "a"),
        lambda receipt, sender: receipts.append((receipt, sender)),
        Receipt,
    )
    for bus in (stranger, learner):
        eventually(
            lambda bus=bus: bus.watched(KEYS.receipt(Role.LEARNER, "a")), "the actor listens"
        )
    stranger.publish_newest(KEYS.policy, make_policy(9))
    stranger.deliver(KEYS.receipt(Role.LEARNER, "a"), Receipt("forged"))
    eventually(lambda: actor.refused == 2, "both are refused")
    learner.publish_newest(KEYS.policy, make_policy(1))
    learner.deliver(KEYS.receipt(Role.LEARNER, "a"), Receipt("true"))
    eventually(lambda: bool(policies and receipts), "those of the learner arrive")
    assert [policy.version for policy in policies] == [1]
    assert receipts == [(Receipt("true"), Sender(Role.LEARNER, "l"))]

    late = joined(Role.ACTOR, "late")  # gets the newest policy from the publisher's memory
    kept: list[PolicyVersion] = []
    late.subscribe_newest(KEYS.policy, kept.append, PolicyVersion)
    eventually(lambda: bool(kept), "the kept policy")
    assert {policy.version for policy in kept} == {1}


def test_a_fault_in_handling_a_message_ends_nothing(joined: Callable[[Role, str], Bus]) -> None:
    reader, learner = joined(Role.ACTOR, "a"), joined(Role.LEARNER, "l")
    inbox = reader.inbox(KEYS.receipt(Role.LEARNER, "a"), Receipt, capacity=8)
    eventually(lambda: learner.watched(KEYS.receipt(Role.LEARNER, "a")), "the actor listens")
    for name in ("bad", "good"):
        learner.deliver(KEYS.receipt(Role.LEARNER, "a"), Receipt(name))
    seen = []

    def handle(receipt: Receipt) -> None:
        seen.append(receipt.episode)
        if receipt.episode == "bad":
            raise KeyError("bad")

    eventually(lambda: inbox.handle(handle, timeout_s=0.1) and len(seen) == 2, "both are handled")
    assert seen == ["bad", "good"]
    assert reader.refused == 1


def test_a_token_that_is_no_id_is_nobody(joined: Callable[[Role, str], Bus]) -> None:
    actor = joined(Role.ACTOR, "a")
    actor.announce()
    odd = joined(Role.ACTOR, "b\nforged")
    odd.announce()
    seen: list[str] = []
    watcher = joined(Role.WATCH, "w")
    watcher.watch_presence(Role.ACTOR, lambda name, _: seen.append(name))
    eventually(lambda: "a" in seen, "the actor is seen")
    assert set(seen) == {"a"}
    eventually(lambda: watcher.present(Role.ACTOR) == {"a"}, "only the actor is present")
