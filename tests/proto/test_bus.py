"""The bus between real sessions, through a real hub in another process."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from subprocess import Popen

import pytest
import zenoh
from ports import free_endpoint
from processes import eventually, listening_hub, run_vmdnn, stop

from proto.bus import LARGEST_MESSAGE, Attachment, Bus, open_bus, open_hub
from proto.codec import encode
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Keys, Role
from proto.messages import (
    Command,
    Control,
    ControlReply,
    PolicyVersion,
    Receipt,
    TrialRequest,
    TutoringCase,
    TutoringRequest,
)
from proto.outbox import Outbox
from proto.suites import Player

KEYS = Keys("test")
SAPIEN = Player("sapien")


class Network:
    """A hub and sessions at it."""

    def __init__(self, stack: ExitStack, endpoint: str) -> None:
        self.endpoint = endpoint
        self._stack = stack
        self.hub: Popen[bytes]
        self.start_hub()

    def start_hub(self) -> None:
        self.hub = self._stack.enter_context(listening_hub(self.endpoint))

    def join(self, role: Role, name: str) -> Bus:
        bus = open_bus(HubConfig(endpoint=self.endpoint), "test", role, name)
        return self._stack.enter_context(bus)

    def stranger(self) -> zenoh.Session:
        """A session of someone who knows nothing of vmdnn's messages."""
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{self.endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        return self._stack.enter_context(zenoh.open(config))


@contextmanager
def network() -> Iterator[Network]:
    with ExitStack() as stack:
        yield Network(stack, free_endpoint())


@pytest.fixture(scope="module")
def shared() -> Iterator[Network]:
    with network() as made:
        yield made


def policy(version: int) -> PolicyVersion:
    return PolicyVersion("run", version, 10 * version, 0.5, "digest", bytes(300_000))


def matched(bus: Bus, key: str) -> None:
    """Wait until the bus sees a subscriber of a key."""
    with_publisher = bus._session.declare_publisher(key)
    eventually(lambda: with_publisher.matching_status.matching, f"a subscriber of {key}")
    with_publisher.undeclare()


def test_messages_arrive_in_order_complete_and_once(shared: Network) -> None:
    sender, reader = shared.join(Role.LEARNER, "l"), shared.join(Role.ACTOR, "in-order")
    inbox = reader.inbox(KEYS.receipt(Role.LEARNER, "in-order"), Receipt, capacity=200)
    matched(sender, KEYS.receipt(Role.LEARNER, "in-order"))
    sent = [Receipt(f"episode-{number}") for number in range(100)]
    for receipt in sent:
        sender.deliver(KEYS.receipt(Role.LEARNER, "in-order"), receipt)
    assert [inbox.take(timeout_s=10.0) for _ in sent] == sent
    assert inbox.take(timeout_s=0.1) is None


def test_a_key_is_watched_as_long_as_someone_subscribes(shared: Network) -> None:
    sender = shared.join(Role.ACTOR, "watched")
    key = KEYS.live("watched")
    assert not sender.watched(key)
    with shared.join(Role.WATCH, "onlooker") as onlooker:
        onlooker.subscribe(KEYS.live(), lambda _: None, Receipt)
        eventually(lambda: sender.watched(key), "the onlooker is noticed")
        assert not sender.watched(KEYS.sequence("watched"))
    eventually(lambda: not sender.watched(key), "that it is gone is noticed")


def test_a_full_inbox_drops_the_oldest_and_says_so(shared: Network) -> None:
    sender, reader = shared.join(Role.LEARNER, "l2"), shared.join(Role.ACTOR, "full")
    inbox = reader.inbox(KEYS.receipt(Role.LEARNER, "full"), Receipt, capacity=3)
    matched(sender, KEYS.receipt(Role.LEARNER, "full"))
    for number in range(10):
        sender.deliver(KEYS.receipt(Role.LEARNER, "full"), Receipt(f"episode-{number}"))
    eventually(lambda: inbox.dropped == 7, "seven dropped")
    assert inbox.take() == Receipt("episode-7")


def test_an_invalid_message_is_counted_and_logged_once_and_dropped(
    shared: Network, caplog: pytest.LogCaptureFixture
) -> None:
    key = KEYS.receipt(Role.LEARNER, "guarded")
    reader, sender = shared.join(Role.ACTOR, "guarded"), shared.join(Role.LEARNER, "honest")
    stranger = shared.stranger()
    received: list[Receipt] = []
    reader.subscribe(key, received.append, Receipt)
    matched(sender, key)
    wire = encode(Receipt("fine"))
    with caplog.at_level(logging.WARNING):
        stranger.put(key, b"what?")
        stranger.put(key, wire.payload[:-1], encoding=wire.encoding)
        stranger.put(key, b"\xc1" * 100, encoding=wire.encoding, attachment=b"{")
        stranger.put(key, bytes(100_000), encoding=wire.encoding)
        stranger.delete(key)
        sender.publish(key, TutoringCase("experiment1", 1, 2))
        sender.publish(key, TutoringCase("experiment1", 1, 3))
        stranger.put(key, wire.payload, encoding=wire.encoding)  # only known senders give receipts
        eventually(lambda: reader.refused == 8, "eight refused")
        sender.deliver(key, Receipt("fine"))
        eventually(lambda: len(received) == 1, "the good one arrives")
    logged = [record.message for record in caplog.records if "refused" in record.message]
    assert len(logged) == 2
    assert sum("learner/honest" in line for line in logged) == 1
    assert all("encoding: expected application/msgpack;vmdnn.receipt.2" in line for line in logged)


def test_an_attachment_is_written_as_every_message_is() -> None:
    attachment = Attachment.of(b"payload", 'actor/"x"\\')
    assert attachment.written() == encode(attachment, check=False).payload
    assert Attachment.read(zenoh.ZBytes(attachment.written())) == attachment


def test_a_corrupted_payload_is_refused(shared: Network) -> None:
    key = KEYS.receipt(Role.LEARNER, "digest")
    reader, stranger = shared.join(Role.ACTOR, "digest"), shared.stranger()
    inbox = reader.inbox(key, Receipt, capacity=5)
    matched(shared.join(Role.LEARNER, "digest"), key)
    genuine = encode(Receipt("genuine"))
    attachment = b'{"sender": "actor/x", "sha256": "' + b"0" * 64 + b'"}'
    stranger.put(key, genuine.payload, encoding=genuine.encoding, attachment=attachment)
    eventually(lambda: inbox.take() is None and reader.refused == 1, "the changed one is refused")


def test_a_callback_that_fails_does_not_end_the_subscription(shared: Network) -> None:
    sender, reader = shared.join(Role.LEARNER, "l3"), shared.join(Role.ACTOR, "failing")
    received: list[Receipt] = []

    def fail_at_first(receipt: Receipt) -> None:
        received.append(receipt)
        if len(received) == 1:
            raise RuntimeError("on purpose")

    reader.subscribe(KEYS.receipt(Role.LEARNER, "failing"), fail_at_first, Receipt)
    matched(sender, KEYS.receipt(Role.LEARNER, "failing"))
    for name in ("first", "second"):
        sender.deliver(KEYS.receipt(Role.LEARNER, "failing"), Receipt(name))
    eventually(lambda: len(received) == 2, "the second message")


def test_a_query_is_answered_with_a_message_or_with_nothing(shared: Network) -> None:
    learner, actor = shared.join(Role.LEARNER, "asked"), shared.join(Role.ACTOR, "asking")
    cases = [TutoringCase("experiment1", 3, 1)]

    def hand_out(request: TutoringRequest) -> TutoringCase | None:
        if request.actor == "fail":
            raise RuntimeError("on purpose")
        return cases.pop() if cases else None

    learner.answer(KEYS.request_tutoring, TutoringRequest, hand_out)

    def ask(name: str) -> list[TutoringCase]:
        return actor.ask(
            KEYS.request_tutoring, TutoringRequest(name, "", 0, "d", SAPIEN), TutoringCase
        )

    eventually(
        lambda: ask("fail") == [] and ask("asking") == [TutoringCase("experiment1", 3, 1)],
        "an answer",
    )
    assert ask("asking") == []
    assert (
        actor.ask(KEYS.request_tutoring, TrialRequest("a", "b", 1, "d", SAPIEN), TutoringCase) == []
    )
    assert learner.refused == 1


def test_a_query_without_receiver_returns_at_once_without_answers(shared: Network) -> None:
    actor = shared.join(Role.ACTOR, "lonely")
    answers: list[list[TutoringCase]] = []

    def ask() -> None:
        request = TutoringRequest("lonely", "", 0, "d", SAPIEN)
        answers.append(actor.ask("vmdnn/test/nobody", request, TutoringCase, timeout_s=30.0))

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(15.0)
    assert answers == [[]]


def test_the_newest_policy_reaches_late_joiners_only_once() -> None:
    with network() as net:
        learner, early = net.join(Role.LEARNER, "learner"), net.join(Role.ACTOR, "early")
        seen: dict[str, list[int]] = {"early": [], "late": []}
        early.subscribe_newest(
            KEYS.policy, lambda new: seen["early"].append(new.version), PolicyVersion
        )
        for version in (1, 2, 3):
            learner.publish_newest(KEYS.policy, policy(version))
        # Of versions that follow one another at once, one may be left out, but not the newest.
        eventually(lambda: seen["early"][-1:] == [3], "the newest for who is there")
        assert seen["early"] == sorted(set(seen["early"]))
        late = net.join(Role.ACTOR, "late")
        late.subscribe_newest(
            KEYS.policy, lambda new: seen["late"].append(new.version), PolicyVersion
        )
        eventually(lambda: seen["late"] == [3], "the newest for who comes late")


def test_everything_reconnects_after_the_hub_was_killed() -> None:
    with network() as net:
        learner, actor = net.join(Role.LEARNER, "learner"), net.join(Role.ACTOR, "actor")
        versions: list[int] = []
        presence: list[tuple[str, bool]] = []

        def answers() -> list[TutoringCase]:
            question = TutoringRequest("actor", "", 0, "d", SAPIEN)
            return actor.ask(KEYS.request_tutoring, question, TutoringCase)

        actor.announce()
        learner.watch_presence(Role.ACTOR, lambda name, alive: presence.append((name, alive)))
        learner.answer(
            KEYS.request_tutoring, TutoringRequest, lambda _: TutoringCase("experiment1", 0, 0)
        )
        actor.subscribe_newest(KEYS.policy, lambda new: versions.append(new.version), PolicyVersion)
        learner.publish_newest(KEYS.policy, policy(1))
        eventually(lambda: versions == [1] and presence == [("actor", True)], "the beginning")

        net.hub.kill()
        eventually(lambda: presence[-1] == ("actor", False), "everyone is gone without a hub")
        assert answers() == []
        learner.publish_newest(KEYS.policy, policy(2))  # into the void
        net.start_hub()
        eventually(lambda: presence[-1] == ("actor", True), "the actor is present again")
        eventually(lambda: versions[-1] == 2, "what was published without a hub arrives")
        eventually(lambda: answers() != [], "questions are answered again")


@pytest.mark.parametrize("away_s", [0.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_a_new_hub_that_knows_nothing_serves_late_joiners_and_outboxes(
    tmp_path: Path, away_s: float
) -> None:
    with network() as net:
        learner, actor = net.join(Role.LEARNER, "learner"), net.join(Role.ACTOR, "actor")
        arrived: list[TutoringCase] = []
        versions: list[int] = []
        key = KEYS.sequence("actor")
        learner.subscribe(key, arrived.append, TutoringCase)
        learner.publish_newest(KEYS.policy, policy(7))
        outbox = Outbox(tmp_path, actor.deliver_wire, resend_after_s=1.0)

        net.hub.kill()
        net.hub.wait()
        lost_at_s = time.monotonic()
        eventually(lambda: actor.peers == 0, "the hub is missed")
        kept = TutoringCase("experiment1", 3, 1)
        outbox.add("episode", key, encode(kept))  # into the void
        eventually(lambda: time.monotonic() >= lost_at_s + away_s, "it is away", away_s + 10)
        net.start_hub()

        def is_resent() -> bool:
            outbox.send_due()
            return kept in arrived

        eventually(is_resent, "the outbox goes on")
        late = net.join(Role.ACTOR, "late")
        late.subscribe_newest(KEYS.policy, lambda new: versions.append(new.version), PolicyVersion)
        eventually(lambda: versions == [7], "the newest policy for who comes late")


def test_presence_ends_with_the_process(shared: Network) -> None:
    watcher, mortal = shared.join(Role.LEARNER, "watcher"), shared.join(Role.RECORDER, "mortal")
    seen: list[tuple[str, bool]] = []
    watcher.watch_presence(Role.RECORDER, lambda name, alive: seen.append((name, alive)))
    mortal.announce()
    eventually(lambda: seen == [("mortal", True)], "it is seen")
    assert watcher.present(Role.RECORDER) == {"mortal"}
    mortal.close()
    eventually(lambda: seen[-1] == ("mortal", False), "it is missed")
    assert watcher.present(Role.RECORDER) == set()


def test_without_a_hub_the_error_says_what_to_do() -> None:
    endpoint = free_endpoint()
    with pytest.raises(
        UserError, match=f"no hub answers at {endpoint}: start one with `vmdnn hub`"
    ):
        open_bus(HubConfig(endpoint=endpoint), "test", Role.ACTOR, "actor")


def test_for_a_port_in_use_the_error_says_what_to_do(shared: Network) -> None:
    with pytest.raises(UserError, match=r"Address already in use.*another port"):
        open_hub(HubConfig(endpoint=shared.endpoint), "test", "second")
    ended = run_vmdnn("hub", "--connect", shared.endpoint)
    assert ended.returncode == 2
    assert "another hub" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_stopped_hub_ends_cleanly() -> None:
    with network() as net:
        net.join(Role.ACTOR, "actor")
        assert stop(net.hub) == 0


def test_a_message_that_is_too_large_is_not_passed_on_and_harms_nobody(shared: Network) -> None:
    sender, reader = shared.join(Role.LEARNER, "large-1"), shared.join(Role.ACTOR, "large-2")
    inbox = reader.inbox("vmdnn/test/large", PolicyVersion, capacity=5)
    stranger = shared.stranger()
    publisher = stranger.declare_publisher("vmdnn/test/large")
    eventually(lambda: publisher.matching_status.matching, "a subscriber")
    publisher.put(bytes(LARGEST_MESSAGE + 2**20))
    matched(sender, "vmdnn/test/large")
    sender.deliver("vmdnn/test/large", policy(1))
    assert inbox.take(timeout_s=30.0) == policy(1)
    assert reader.refused == 0


def test_large_messages_go_through_shared_memory_too(shared: Network) -> None:
    config = HubConfig(endpoint=shared.endpoint, shared_memory=True)
    with (
        open_bus(config, "test", Role.LEARNER, "near") as sender,
        open_bus(config, "test", Role.ACTOR, "nearby") as reader,
    ):
        inbox = reader.inbox("vmdnn/test/near", PolicyVersion, capacity=5)
        matched(sender, "vmdnn/test/near")
        sender.deliver("vmdnn/test/near", policy(1))
        assert inbox.take(timeout_s=10.0) == policy(1)


def test_any_zenoh_client_can_send_commands_as_plain_json(shared: Network) -> None:
    bus, stranger = shared.join(Role.RECORDER, "obedient"), shared.stranger()
    heard: list[Control] = []

    def obey(control: Control) -> ControlReply:
        heard.append(control)
        return ControlReply(Role.RECORDER, "obedient", "paused")

    bus.answer(KEYS.control(Role.RECORDER), Control, obey)

    def ask() -> list[str]:
        replies = stranger.get(
            KEYS.control(Role.RECORDER),
            payload='{"command": "pause"}',
            encoding="application/json;vmdnn.control.1",
        )
        return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]

    eventually(lambda: ask() != [], "an answer")
    assert json.loads(ask()[0]) == {"role": "recorder", "id": "obedient", "note": "paused"}
    assert set(heard) == {Control(Command.PAUSE)}
