"""A message in the outbox arrives, is refused, or stays, and never delays the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from proto.codec import Wire
from proto.keys import Role
from proto.outbox import IN_FLIGHT, RESEND_AFTER_AT_MOST_S, Outbox

AFTER_S = 5.0


class Link:
    """Collects what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Wire]] = []

    def __call__(self, key: str, wire: Wire) -> None:
        self.sent.append((key, wire))

    def take(self) -> list[str]:
        """Contents of what was sent since the last call."""
        sent, self.sent = self.sent, []
        return [wire.payload.decode() for _, wire in sent]


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def wire(content: str) -> Wire:
    return Wire("application/msgpack;vmdnn.test.1", content.encode())


@pytest.fixture
def link() -> Link:
    return Link()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def outbox(tmp_path: Path, link: Link, clock: Clock) -> Outbox:
    return Outbox(tmp_path, link, resend_after_s=AFTER_S, clock=clock)


def fill(outbox: Outbox, first: str, count: int) -> list[str]:
    names = [f"{first}{number:02d}" for number in range(count)]
    for name in names:
        outbox.add(name, "key", wire(name))
    return names


def suffixes(folder: Path) -> list[str]:
    return sorted(path.suffix for path in folder.iterdir())


def test_a_message_is_on_disk_before_it_is_sent(tmp_path: Path) -> None:
    def look(_key: str, _wire: Wire) -> None:
        seen.append(suffixes(tmp_path))

    seen: list[list[str]] = []
    Outbox(tmp_path, look).add("a", "key/of/a", wire("content\n\x00of a"))
    assert seen == [[".message"]]


def test_a_message_is_sent_again_at_growing_intervals_until_its_receipt_arrives(
    outbox: Outbox, link: Link, clock: Clock, tmp_path: Path
) -> None:
    outbox.add("a", "key/of/a", wire("content\n\x00of a"))
    for pause_s in (AFTER_S, 2 * AFTER_S, 4 * AFTER_S, *[RESEND_AFTER_AT_MOST_S] * 3):
        assert link.sent == [("key/of/a", wire("content\n\x00of a"))]
        link.take()
        clock.now_s += pause_s - 0.1
        outbox.send_due()
        assert link.take() == []
        clock.now_s += 0.1
        outbox.send_due()
    link.take()
    outbox.received("a")
    outbox.received("a")
    outbox.received("never heard of")
    clock.now_s += 1000.0
    outbox.send_due()
    assert link.take() == []
    assert len(outbox) == 0
    assert list(tmp_path.iterdir()) == []


def test_a_new_process_sends_the_messages_of_the_old_one_in_order(
    tmp_path: Path, link: Link
) -> None:
    old = Outbox(tmp_path, Link())
    for name in "abc":
        old.add(f"episode-{name}", "key", wire(name))
    old.received("episode-b")
    (tmp_path / "1-episode-d.message.0123abcd.part").write_bytes(b"{")  # killed while writing
    new = Outbox(tmp_path, link)
    assert len(new) == 2
    assert suffixes(tmp_path) == [".message", ".message"]
    new.send_due()
    assert link.take() == ["a", "c"]
    new.received("episode-a")
    assert len(Outbox(tmp_path, Link())) == 1


def test_a_prepared_message_is_sent_only_if_its_process_died(tmp_path: Path, link: Link) -> None:
    old = Outbox(tmp_path, link)
    with old.sent_if_killed("lives", "key", wire("lives")):
        assert suffixes(tmp_path) == [".prepared"]
    assert suffixes(tmp_path) == []
    dies = old.sent_if_killed("dies", "key/of/it", wire("dies"), [Role.EVALUATOR])
    dies.__enter__()
    assert (len(old), link.sent) == (0, [])
    new = Outbox(tmp_path, link)
    new.send_due()
    assert link.sent == [("key/of/it", wire("dies"))]
    assert new.missing == {Role.EVALUATOR}
    assert (old.of_dead, new.of_dead) == (0, 1)
    new.received("dies", Role.EVALUATOR)
    assert new.of_dead == 0
    assert suffixes(tmp_path) == []


def test_the_oldest_messages_are_sent_first_and_not_all_at_once(outbox: Outbox, link: Link) -> None:
    names = fill(outbox, "m", IN_FLIGHT + 3)
    assert link.take() == names[:IN_FLIGHT]
    outbox.received(names[0])
    outbox.send_due()
    assert link.take() == [names[IN_FLIGHT]], "an answer makes room for the next"


def test_messages_without_receipt_delay_no_others(outbox: Outbox, link: Link, clock: Clock) -> None:
    unanswered = fill(outbox, "unanswered", IN_FLIGHT)
    good = fill(outbox, "good", 2)
    assert link.take() == unanswered
    clock.now_s += AFTER_S
    outbox.send_due()
    sent = link.take()
    assert sent[:2] == good
    assert sent[2:] == unanswered[: IN_FLIGHT - 2], "the window is full, and no fuller"
    for name in good:
        outbox.received(name)
    outbox.send_due()
    link.take()
    for second in range(100):  # from then on they are rarely sent, also while others are answered
        clock.now_s += 1.0
        if second % 10 == 0:
            outbox.add(f"other{second}", "key", wire("other"))
            outbox.received(f"other{second}")
        outbox.send_due()
    assert len([sent for sent in link.take() if sent != "other"]) < 6 * IN_FLIGHT
    clock.now_s += RESEND_AFTER_AT_MOST_S
    outbox.send_due()
    outbox.add("new", "key", wire("new"))
    clock.now_s += AFTER_S
    outbox.send_due()
    assert "new" in link.take()
    assert len(outbox) == IN_FLIGHT + 1


def test_when_the_receiver_returns_all_messages_are_sent_soon(
    outbox: Outbox, link: Link, clock: Clock
) -> None:
    names = fill(outbox, "m", 3)
    for _ in range(10):
        clock.now_s += RESEND_AFTER_AT_MOST_S
        outbox.send_due()
    link.take()
    clock.now_s += AFTER_S
    outbox.received(names[1])
    outbox.send_due()
    assert link.take() == [names[0], names[2]]


def test_a_refused_message_is_put_aside_and_never_sent_again(
    outbox: Outbox, link: Link, clock: Clock, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    refused = fill(outbox, "refused", IN_FLIGHT)
    good = fill(outbox, "good", 1)
    link.take()
    for name in refused:
        outbox.refused(name, "of another task")
    outbox.send_due()
    assert link.take() == good
    assert (len(outbox), outbox.put_aside) == (1, IN_FLIGHT)
    outbox.refused(refused[0], "of another task")
    assert outbox.put_aside == IN_FLIGHT
    assert "was refused: of another task" in caplog.text
    clock.now_s += 1000.0
    outbox.send_due()
    assert link.take() == good
    assert suffixes(tmp_path) == [".message", *[".refused"] * IN_FLIGHT]
    again = Outbox(tmp_path, link)
    assert (len(again), again.put_aside) == (1, IN_FLIGHT)


def test_a_damaged_file_is_put_aside(
    tmp_path: Path, link: Link, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "1-a.message").write_bytes(b"\x00\x01\x02")
    (tmp_path / "2-b.message").write_bytes(b'{"key": 3}\nrest')
    outbox = Outbox(tmp_path, link)
    outbox.add("c", "key", wire("c"))
    assert link.take() == ["c"]
    assert (len(outbox), outbox.put_aside) == (1, 2)
    assert suffixes(tmp_path) == [".damaged", ".damaged", ".message"]
    assert "is damaged" in caplog.text


def test_a_message_whose_content_is_damaged_is_not_sent(tmp_path: Path, link: Link) -> None:
    Outbox(tmp_path, link).add("a", "key", wire("content"))
    (path,) = tmp_path.glob("*.message")
    path.write_bytes(path.read_bytes().replace(b"content", b"cOntent"))
    link.take()
    outbox = Outbox(tmp_path, link)
    outbox.send_due()
    assert link.take() == []
    assert (len(outbox), outbox.put_aside) == (0, 1)


def test_a_file_larger_than_any_message_is_not_read(tmp_path: Path, link: Link) -> None:
    path = tmp_path / "1-a.message"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # a sparse file
    outbox = Outbox(tmp_path, link)
    outbox.send_due()
    assert (len(outbox), outbox.put_aside) == (0, 1)


def test_a_message_leaves_when_all_its_receivers_have_it(
    outbox: Outbox, link: Link, clock: Clock, tmp_path: Path
) -> None:
    both = [Role.EVALUATOR, Role.RECORDER]
    outbox.add("a", "key", wire("a"), both)
    outbox.received("a", Role.EVALUATOR)
    outbox.received("a", Role.EVALUATOR)
    outbox.received("a", Role.LEARNER)
    assert outbox.missing == {Role.RECORDER}
    clock.now_s += AFTER_S
    outbox.send_due()
    assert link.take() == ["a", "a"]

    # The next process does not know who has it already, and asks both again.
    again = Outbox(tmp_path, link, clock=clock)
    again.send_due()
    assert again.missing == set(both)
    again.received("a", Role.RECORDER)
    assert len(again) == 1
    again.received("a", Role.EVALUATOR)
    assert len(again) == 0
    assert list(tmp_path.iterdir()) == []


def test_a_message_of_an_older_version_needs_one_receipt(tmp_path: Path, link: Link) -> None:
    old = b'{"key": "key", "encoding": "application/msgpack;vmdnn.test.1"}\nold'
    (tmp_path / "1-a.message").write_bytes(old)
    outbox = Outbox(tmp_path, link)
    outbox.send_due()
    outbox.received("a", Role.EVALUATOR)
    assert len(outbox) == 0
