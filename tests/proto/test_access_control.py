"""What the hub lets through, cell by cell of the table, with real sessions and certificates."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from ports import free_endpoint
from processes import eventually

from deploy.certificates import Authority, make_certificates
from proto.bus import Bus, open_bus, open_hub
from proto.codec import encode
from proto.config import HubConfig
from proto.keys import Keys, Role
from proto.messages import Command, Control, ControlReply, EpisodeFailed, PolicyVersion
from proto.metrics import RecorderMetrics
from proto.permissions import ACTOR_ID, TABLE, Holder, Verb
from proto.security import Certificate, certificate_for, link_settings
from services.board import Board

RUN = "test"
KEYS = Keys(RUN)
IDS = ("one", "vm1", "vm1-2", "vm10")
"""Ids of actors; the machine vm1 has a certificate of its own."""
OWN = ("vm1", "vm1-2")
UNKNOWN = (
    "elsewhere",
    "@/router/one",
    f"vmdnn/{RUN}/other",
    f"vmdnn/{RUN}/sequence",
    f"vmdnn/{RUN}/sequence/one/two",
    f"vmdnn/{RUN}/sequence/one/@adv/pub/a/b/_",
    f"vmdnn/{RUN}/control/watch",
    f"vmdnn/{RUN}/alive/watch/one",
)
"""Keys that are in no row of the table."""
FIRST = zenoh.Priority.REAL_TIME
"""Messages of one priority do not overtake each other."""
WAIT = zenoh.CongestionControl.BLOCK
CERTIFICATES = (*(holder.value for holder in Holder if holder is not Holder.HUB), "actor-vm1")


@dataclass(frozen=True)
class Cell:
    """A key."""

    key: str

    def allowed(self, certificate: str, verb: Verb) -> bool:
        """Whether a row of the table that includes the key allows it."""
        own = verb in {Verb.PUT, Verb.SUBSCRIBE, Verb.REPLY, Verb.TOKEN}
        ids = OWN if certificate == "actor-vm1" and own else ("*",)
        holder = Holder(certificate.partition("-")[0])
        return any(
            row.may(holder, verb) and zenoh.KeyExpr(row.key_expression(each)).includes(self.key)
            for row in TABLE
            for each in ids
        )


def cells() -> list[Cell]:
    keys = list(UNKNOWN)
    for row in TABLE:
        key = row.key.replace("<run>", RUN).replace("<id>", "one").replace("**", "pub/a/b/_")
        ids = IDS if ACTOR_ID in key else ("",)
        keys += [key.replace(ACTOR_ID, each).replace("*", "one") for each in ids]
    return [Cell(key) for key in dict.fromkeys(keys)]


CELLS = cells()


class Net:
    """A hub with certificates, and a session for each."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.certificates = folder / "certificates"
        make_certificates(self.certificates, actors=["vm1"])
        self.config = HubConfig(
            endpoint=free_endpoint().replace("tcp/", "tls/"),
            security="mutual-tls",
            certificates=self.certificates,
            actors=("vm1",),
        )
        own = folder / "own"
        own.mkdir()
        for name in ("authority.crt", "actor-vm1.crt", "actor-vm1.key"):
            shutil.copy(self.certificates / name, own)
        self.own = self.config.model_copy(update={"certificates": own})
        self._stack = stack
        self.bus = stack.enter_context(open_hub(self.config, RUN, "hub"))
        self.bus.announce()
        self.hub: zenoh.Session = self.bus._session
        self.sessions = {name: self._session(name) for name in CERTIFICATES}

    def join(self, role: Role, name: str, holder: Holder | None = None) -> Bus:
        return self._stack.enter_context(open_bus(self.config, RUN, role, name, holder=holder))

    def _session(self, name: str) -> zenoh.Session:
        config = self.own if name == "actor-vm1" else self.config
        certificate = certificate_for(config, Holder(name.partition("-")[0]))
        assert certificate is not None
        assert certificate.name == name
        return self._stack.enter_context(open_session(config.endpoint, certificate))


def open_session(endpoint: str, certificate: Certificate | None, **tls: object) -> zenoh.Session:
    """A session that tries once to connect; `tls` replaces settings of Zenoh's TLS."""
    link = link_settings(certificate, listens=False)
    if certificate is not None:
        link["tls"] = {name: v for name, v in (link["tls"] | tls).items() if v is not None}
    settings = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 700, "exit_on_failure": True},
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": link},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    with ExitStack() as stack:
        yield Net(stack, tmp_path_factory.mktemp("net"))


def handled(session: zenoh.Session) -> None:
    """Wait until the hub has handled what a session sent before."""
    tokens = session.liveliness().get(KEYS.alive("hub", "hub"), timeout=20.0)
    assert [str(token.ok.key_expr) for token in tokens if token.ok] == [KEYS.alive("hub", "hub")]


def drained(channel: Any) -> list[Any]:
    """What is in a channel now."""
    found = []
    with contextlib.suppress(zenoh.ZError):  # the channel of a question that is over
        while (each := channel.try_recv()) is not None:
            found.append(each)
    return found


def collected(channels: list[Any], expected: set[str]) -> list[Any]:
    """What comes to channels, at least until all expected keys have come."""
    found: list[Any] = []

    def all_there() -> bool:
        found.extend(each for channel in channels for each in drained(channel))
        return {str(each.key_expr) for each in found} >= expected

    eventually(all_there, f"all of {sorted(expected)} come", 20.0)
    return found


def denied_first(expected: set[str]) -> list[str]:
    """All keys. When what is allowed has come, what is denied would have come before."""
    return sorted((cell.key for cell in CELLS), key=lambda key: key in expected)


def puts(hub: zenoh.Session, session: zenoh.Session, expected: set[str]) -> set[str]:
    everything = [hub.declare_subscriber(cell.key) for cell in CELLS]
    for key in denied_first(expected):
        session.put(key, b"", priority=FIRST, congestion_control=WAIT)
        session.delete(key, priority=FIRST, congestion_control=WAIT)
    handled(session)
    samples = collected(everything, expected)
    for each in everything:
        each.undeclare()
    assert all(sample.kind == zenoh.SampleKind.PUT for sample in samples)
    return {str(sample.key_expr) for sample in samples}


def subscribes(hub: zenoh.Session, session: zenoh.Session, expected: set[str]) -> set[str]:
    subscribers = [session.declare_subscriber(cell.key) for cell in CELLS]
    handled(session)
    for key in denied_first(expected):
        hub.put(key, b"", priority=FIRST, congestion_control=WAIT)
    handled(session)
    got = {str(sample.key_expr) for sample in collected(subscribers, expected)}
    for each in subscribers:
        each.undeclare()
    return got


def queries(hub: zenoh.Session, session: zenoh.Session, expected: set[str]) -> set[str]:
    asked, replied = set(), []

    def on_query(query: zenoh.Query) -> None:
        with query:
            asked.add(str(query.key_expr))
            query.reply(query.key_expr, b"")

    answering = [hub.declare_queryable(cell.key, on_query) for cell in CELLS]
    handled(session)  # the hub tells it who answers before it answers itself
    for key in denied_first(expected):
        session.get(
            key,
            lambda reply: replied.append(str(reply.ok.key_expr)) if reply.ok else None,
            priority=FIRST,
            congestion_control=WAIT,
            timeout=20.0,
        )
    handled(session)
    eventually(lambda: set(replied) >= expected, "who asks gets replies")
    for each in answering:
        each.undeclare()
    return asked


def replies(hub: zenoh.Session, session: zenoh.Session, _expected: set[str]) -> set[str]:
    def on_query(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    answering = [session.declare_queryable(cell.key, on_query) for cell in CELLS]
    handled(session)
    asked = [hub.get(cell.key, target=zenoh.QueryTarget.ALL, timeout=5.0) for cell in CELLS]
    got = {str(reply.ok.key_expr) for each in asked for reply in each if reply.ok}
    for each in answering:
        each.undeclare()
    return got


def tokens(hub: zenoh.Session, session: zenoh.Session, _expected: set[str]) -> set[str]:
    declared = [session.liveliness().declare_token(cell.key) for cell in CELLS]
    handled(session)
    found = set()
    for cell in CELLS:
        answers = hub.liveliness().get(cell.key, timeout=5.0)
        found |= {str(answer.ok.key_expr) for answer in answers if answer.ok}
    for each in declared:
        each.undeclare()
    return found


def presence(hub: zenoh.Session, session: zenoh.Session, _expected: set[str]) -> set[str]:
    declared = [hub.liveliness().declare_token(cell.key) for cell in CELLS]
    liveliness = session.liveliness()
    asked = [liveliness.get(cell.key, timeout=20.0) for cell in CELLS]
    watching = [liveliness.declare_subscriber(cell.key, history=True) for cell in CELLS]
    handled(session)
    seen, watched = (
        {
            str(getattr(each, "ok", each).key_expr)
            for channel in channels
            for each in drained(channel)
        }
        for channels in (asked, watching)
    )
    for each in (*watching, *declared):
        each.undeclare()
    assert seen == watched
    return seen


TRIED: dict[Verb, Callable[[zenoh.Session, zenoh.Session, set[str]], set[str]]] = {
    Verb.PUT: puts,
    Verb.SUBSCRIBE: subscribes,
    Verb.QUERY: queries,
    Verb.REPLY: replies,
    Verb.TOKEN: tokens,
    Verb.PRESENCE: presence,
}


@pytest.mark.parametrize("verb", Verb)
@pytest.mark.parametrize("certificate", CERTIFICATES)
def test_a_certificate_can_do_what_the_table_allows_and_nothing_else(
    net: Net, certificate: str, verb: Verb
) -> None:
    allowed = {cell.key for cell in CELLS if cell.allowed(certificate, verb)}
    assert TRIED[verb](net.hub, net.sessions[certificate], allowed) == allowed


def policy(version: int) -> PolicyVersion:
    return PolicyVersion("run", version, 10 * version, 0.5, "digest", bytes(300_000))


def test_late_joiners_get_the_newest_policy_and_only_that_of_the_learner(net: Net) -> None:
    forger = net.join(Role.ACTOR, "forger")
    learner = net.join(Role.LEARNER, "learner")
    for version in (1, 2):
        learner.publish_newest(KEYS.policy, policy(version))
    got: list[int] = []
    late = net.join(Role.EVALUATOR, "late")
    late.subscribe_newest(KEYS.policy, lambda each: got.append(each.version), PolicyVersion)
    eventually(lambda: got == [2], "the newest policy comes")
    forger.publish_newest(KEYS.policy, policy(9))
    handled(forger._session)
    learner.publish_newest(KEYS.policy, policy(3))
    eventually(lambda: 3 in got, "the next one comes")
    later: list[int] = []
    net.join(Role.ACTOR, "later").subscribe_newest(
        KEYS.policy, lambda each: later.append(each.version), PolicyVersion
    )
    eventually(lambda: later == [3], "the learner's comes")
    assert got == [2, 3]


def test_a_watcher_sees_everyone_that_is_present(net: Net) -> None:
    board = Board(net.join(Role.WATCH, "board"))
    recorder = net.join(Role.RECORDER, "seen")
    recorder.announce()
    told = RecorderMetrics(
        id="seen", time_s=1.0, refused=0, episodes=0, bytes=0, dropped=0, deleted=0
    )

    def sees() -> bool:
        recorder.publish(KEYS.metrics(Role.RECORDER, "seen"), told)
        return (Role.RECORDER, "seen") in board.view().metrics

    eventually(sees, "the board has its metrics")


def test_only_an_operator_commands(net: Net) -> None:
    obeyed: list[str] = []

    def on_control(control: Control) -> ControlReply:
        obeyed.append(control.command.value)
        return ControlReply(Role.RECORDER, "recorder", "done")

    net.join(Role.RECORDER, "recorder").answer(KEYS.control(Role.RECORDER), Control, on_control)
    watcher = net.join(Role.WATCH, "watch-1")
    stop, pause = Control(Command.STOP), Control(Command.PAUSE)
    assert watcher.ask(KEYS.control(Role.RECORDER), stop, ControlReply, timeout_s=0.5) == []
    operator = net.join(Role.WATCH, "control-1", Holder.OPERATOR)
    assert len(operator.ask(KEYS.control(Role.RECORDER), pause, ControlReply)) == 1
    assert obeyed == ["pause"]


def test_with_a_shared_certificate_an_actor_can_speak_for_another_and_with_its_own_it_cannot(
    net: Net, failure: Callable[..., EpisodeFailed]
) -> None:
    """What docs/security.md says of shared certificates."""
    heard: list[str] = []
    net.join(Role.LEARNER, "hears").subscribe(
        KEYS.failure(), lambda report: heard.append(report.actor), EpisodeFailed
    )
    own = net.sessions["actor-vm1"]
    for session, actor in ((own, "one"), (own, "vm1-2"), (net.sessions["actor"], "vm1-2")):
        wire = encode(failure("0123456789abcdef", actor=actor))
        session.put(KEYS.failure(actor), wire.payload, encoding=wire.encoding)
    eventually(lambda: len(heard) == 2, "two reports come")
    handled(own)
    assert heard == ["vm1-2", "vm1-2"]


def issued(
    authority: Authority,
    folder: Path,
    name: str,
    *,
    days: tuple[int, int],
    hosts: tuple[str, ...] = (),
) -> Certificate:
    """A certificate of an authority, which is valid between two days, counted from now."""
    folder.mkdir(parents=True, exist_ok=True)
    first, last = (datetime.now(UTC) + timedelta(days=day) for day in days)
    file = authority.issue(folder, name, hosts, first, last)
    pem = folder / "authority.crt"
    pem.write_bytes(authority.certificate.public_bytes(Encoding.PEM))
    return Certificate(pem, file, file.with_suffix(".key"), name, last)


def refused(endpoint: str, certificate: Certificate | None, **tls: object) -> bool:
    try:
        open_session(endpoint, certificate, **tls).close()
    except zenoh.ZError:
        return True
    return False


def test_without_a_valid_certificate_nobody_gets_in(net: Net, tmp_path: Path) -> None:
    endpoint, trusted = net.config.endpoint, str(net.certificates / "authority.crt")
    good = certificate_for(net.config, Holder.LEARNER)
    authority = Authority.at(net.certificates)
    assert good is not None
    assert not refused(endpoint, good)
    foreign = issued(Authority.make(), tmp_path / "foreign", "learner", days=(-1, 1))
    expired = issued(authority, tmp_path / "expired", "learner", days=(-2, -1))
    future = issued(authority, tmp_path / "future", "learner", days=(1, 2))
    alone = Authority.make()
    (tmp_path / "alone.crt").write_bytes(alone.certificate.public_bytes(Encoding.PEM))
    (tmp_path / "alone.key").write_bytes(
        alone.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    )
    self_signed = {
        "connect_certificate": str(tmp_path / "alone.crt"),
        "connect_private_key": str(tmp_path / "alone.key"),
    }
    without = dict.fromkeys(self_signed) | {"enable_mtls": False}
    as_hub = certificate_for(net.config, Holder.HUB)
    tries = {
        "another authority": refused(endpoint, foreign, root_ca_certificate=trusted),
        "expired": refused(endpoint, expired),
        "not valid yet": refused(endpoint, future),
        "self-signed": refused(endpoint, good, **self_signed),
        "no certificate": refused(endpoint, good, **without),
        "the hub's certificate": refused(endpoint, as_hub),
        "plain TCP": refused(endpoint.replace("tls/", "tcp/"), None),
    }
    assert tries == dict.fromkeys(tries, True)


@pytest.mark.parametrize(
    ("name", "hosts", "days", "own_authority"),
    [
        ("hub", ("127.0.0.1",), (-1, 1), True),
        ("hub", ("other.example",), (-1, 1), True),
        ("hub", ("127.0.0.1",), (-2, -1), True),
        ("hub", ("127.0.0.1",), (-1, 1), False),
        ("actor", (), (-1, 1), True),
    ],
    ids=["the hub", "another name", "expired", "another authority", "an actor's certificate"],
)
def test_a_process_connects_to_the_hub_only(
    name: str,
    hosts: tuple[str, ...],
    days: tuple[int, int],
    own_authority: bool,
    net: Net,
    tmp_path: Path,
) -> None:
    authority = Authority.at(net.certificates)
    theirs = issued(
        authority if own_authority else Authority.make(), tmp_path, name, days=days, hosts=hosts
    )
    endpoint = free_endpoint().replace("tcp/", "tls/")
    settings = {
        "mode": "router",
        "listen": {"endpoints": [endpoint], "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": link_settings(theirs, listens=True)},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        is_hub = (name, hosts, days, own_authority) == ("hub", ("127.0.0.1",), (-1, 1), True)
        assert refused(endpoint, certificate_for(net.config, Holder.LEARNER)) is not is_hub
