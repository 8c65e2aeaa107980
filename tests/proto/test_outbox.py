"""What is in the outbox arrives, or stays in the outbox."""

from __future__ import annotations

from pathlib import Path

import pytest
from processes import eventually

from proto.codec import Wire
from proto.outbox import IN_FLIGHT, Outbox


class Link:
    """Collects what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Wire]] = []

    def __call__(self, key: str, wire: Wire) -> None:
        self.sent.append((key, wire))

    @property
    def payloads(self) -> list[bytes]:
        return [wire.payload for _, wire in self.sent]


def wire(content: str) -> Wire:
    return Wire("application/msgpack;vmdnn.test.1", content.encode())


def test_what_is_added_is_on_disk_before_it_is_sent(tmp_path: Path) -> None:
    def look(_key: str, _wire: Wire) -> None:
        assert [path.suffix for path in tmp_path.iterdir()] == [".message"]
        looked.append(True)

    looked: list[bool] = []
    Outbox(tmp_path, look).add("a", "key/of/a", wire("content\n\x00of a"))
    assert looked == [True]


def test_it_is_sent_again_until_its_receipt_comes(tmp_path: Path) -> None:
    link = Link()
    outbox = Outbox(tmp_path, link, resend_after_s=0.0)
    outbox.add("a", "key/of/a", wire("content\n\x00of a"))
    outbox.send_due()
    outbox.send_due()
    assert link.sent == [("key/of/a", wire("content\n\x00of a"))] * 3
    outbox.received("a")
    outbox.received("a")
    outbox.received("never heard of")
    outbox.send_due()
    assert len(link.sent) == 3
    assert len(outbox) == 0
    assert list(tmp_path.iterdir()) == []


def test_it_is_not_sent_again_at_once(tmp_path: Path) -> None:
    link = Link()
    outbox = Outbox(tmp_path, link, resend_after_s=0.2)
    outbox.add("a", "key", wire("a"))
    outbox.send_due()
    assert len(link.sent) == 1

    def sent_again() -> bool:
        outbox.send_due()
        return len(link.sent) == 2

    eventually(sent_again, "it is due again")


def test_a_new_process_finds_what_the_old_one_left_in_order(tmp_path: Path) -> None:
    old = Outbox(tmp_path, Link())
    for name in "abc":
        old.add(f"episode-{name}", "key", wire(name))
    old.received("episode-b")
    (tmp_path / "1-episode-d.unfinished").write_bytes(b"{")  # killed while writing
    link = Link()
    new = Outbox(tmp_path, link)
    assert len(new) == 2
    new.send_due()
    assert link.payloads == [b"a", b"c"]
    new.received("episode-a")
    assert len(Outbox(tmp_path, Link())) == 1


def test_the_oldest_go_first_and_not_all_at_once(tmp_path: Path) -> None:
    link = Link()
    outbox = Outbox(tmp_path, link)
    names = [f"{number:02d}" for number in range(IN_FLIGHT + 3)]
    for name in names:
        outbox.add(name, "key", wire(name))
    assert link.payloads == [name.encode() for name in names[:IN_FLIGHT]]
    outbox.received(names[0])
    outbox.send_due()
    assert link.payloads[-1] == names[IN_FLIGHT].encode()


def test_a_damaged_file_is_put_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "1-a.message").write_bytes(b"\x00\x01\x02")
    (tmp_path / "2-b.message").write_bytes(b'{"key": 3}\nrest')
    link = Link()
    outbox = Outbox(tmp_path, link)
    outbox.add("c", "key", wire("c"))
    assert link.payloads == [b"c"]
    assert len(outbox) == 1
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [
        ".damaged",
        ".damaged",
        ".message",
    ]
    assert "put aside" in caplog.text
