"""The bus: the connection of a process to the others. No other module uses Zenoh.

There are two ways to publish. `publish` may lose messages when a reader or a link is slow; it is
for live data. `deliver` waits for room, but a message in transit is lost when a connection breaks:
a message that must arrive is kept in an `Outbox` until its receipt comes.

An invalid message, or one that its sender may not send (`proto.senders`), is counted, logged once
for each sender, and dropped. Callbacks run in Zenoh's threads and must return quickly. Zenoh does
not survive a fork: start processes with spawn or exec.
A process ends only when all its buses are closed.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Final, Generic, Self, TypeVar

import zenoh
import zenoh.ext

from proto.codec import (
    MEBIBYTE,
    MessageError,
    Text,
    Wire,
    check_size,
    decode,
    encode,
    message,
    schema_of,
)
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Keys, Role
from proto.lifecycle import Lifecycle
from proto.permissions import HOLDER_OF, Holder
from proto.plain_text import plain
from proto.security import (
    Certificate,
    certificate_for,
    hub_access_control,
    link_settings,
    reachable,
    warn_if_insecure,
)
from proto.senders import Sender, is_id, origin_problem

LOG = logging.getLogger(__name__)

CONNECT_WAIT_S: Final = 5.0
"""How long one try to connect to the hub lasts."""
LARGEST_MESSAGE: Final = 132 * MEBIBYTE
"""No session takes a larger message; larger than `proto.messages.POLICY_LIMIT`."""
SHARED_MEMORY_FROM_BYTES: Final = 64 * 1024
_CONNECT_AGAIN_S: Final = 1.0
_SENDERS_REMEMBERED: Final = 1000
_HEARTBEAT_S: Final = 1.0
_WAITING_BATCHES: Final = 16
"""Batches of 64 KiB that may wait in the hub for a receiver; an episode fits into them."""


class NoHubError(UserError):
    """No hub answers, now."""


class CannotListenError(UserError):
    """The hub cannot listen at its endpoint, now."""


M = TypeVar("M")
Answer = TypeVar("Answer")


@message("attachment", 1, form="json")
@dataclass(frozen=True)
class Attachment:
    """What vmdnn sends along with each message; other senders may leave it out.

    Attributes:
        sender: role and id of the sender, such as `actor/host-1`.
        sha256: digest of the payload.
    """

    sender: str
    sha256: Annotated[str, Text(64, "[0-9a-f]{64}")]

    @classmethod
    def of(cls, payload: bytes, sender: str) -> Self:
        """The attachment of a payload."""
        return cls(sender, hashlib.sha256(payload).hexdigest())

    @classmethod
    def read(cls, content: zenoh.ZBytes) -> Self:
        """Decode an attachment, or raise MessageError."""
        encoding = schema_of(cls).encoding
        check_size(len(content), encoding, cls)
        return decode(Wire(encoding, content.to_bytes()), cls)

    def written(self) -> bytes:
        """Encode it: as `encode` does, but several times as fast. Each message has one."""
        return f'{{"sender": {json.dumps(self.sender)}, "sha256": "{self.sha256}"}}'.encode()

    def check(self, payload: bytes) -> None:
        """Compare a payload with the digest; raises MessageError if they differ."""
        if hashlib.sha256(payload).hexdigest() != self.sha256:
            raise MessageError("payload", "differs from its digest in the attachment")


class Inbox(Generic[M]):
    """Messages of a key that wait to be taken; when it is full, the oldest one is dropped.

    Attributes:
        dropped: number of messages that were dropped because they were not taken in time.
    """

    def __init__(self, bus: Bus, classes: tuple[type[M], ...], capacity: int) -> None:
        self.dropped = 0
        self._bus = bus
        self._classes = classes
        self._capacity = capacity
        self._waiting: deque[zenoh.Sample] = deque()
        self._arrived = threading.Condition()

    def __len__(self) -> int:
        return len(self._waiting)

    def take(self, timeout_s: float = 0.0) -> M | None:
        """The oldest valid message; None if none arrives within timeout_s."""
        while (sample := self._next(timeout_s)) is not None:
            try:
                return self._bus.decode(sample, *self._classes)
            except MessageError:
                continue
        return None

    def handle(self, action: Callable[[M], None], timeout_s: float = 0.0) -> bool:
        """Take the oldest valid message and call `action` with it.

        An exception in the action is logged and counted as a refusal, and the message is dropped:
        no message may end a process. A UserError is raised: it is about this machine.

        Args:
            action: what to do with a message.
            timeout_s: how long to wait for one.

        Returns:
            False if none arrived within timeout_s.
        """
        message = self.take(timeout_s)
        if message is None:
            return False
        try:
            action(message)
        except UserError:
            raise
        except Exception:
            LOG.exception("a %s could not be handled", type(message).__name__)
            self._bus.refused += 1
        return True

    def put(self, sample: zenoh.Sample) -> None:
        """Add a sample."""
        with self._arrived:
            if len(self._waiting) == self._capacity:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(sample)
            self._arrived.notify()

    def _next(self, timeout_s: float) -> zenoh.Sample | None:
        with self._arrived:
            if not self._waiting:
                self._arrived.wait(timeout_s)
            return self._waiting.popleft() if self._waiting else None


class Bus:
    """The connection of a process to the other processes of a run.

    Attributes:
        keys: keys of the run.
        role: role of this process.
        id: id of this process.
        refused: number of messages that were dropped because they were invalid.
        certificate: what this process shows at the hub; None without security.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        role: Role,
        process: str,
        certificate: Certificate | None = None,
    ) -> None:
        self.keys = Keys(run)
        self.role = role
        self.id = process
        self.refused = 0
        self.certificate = certificate
        self._session = session
        self._declared: list[Any] = []  # Zenoh undeclares what nobody refers to
        self._newest: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._watched: dict[str, zenoh.Publisher] = {}
        self._complained_about: set[str] = set()
        self._connection = threading.Lock()
        self._hub_is_away = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def peers(self) -> int:
        """Number of Zenoh sessions that are connected to this one."""
        return len(self._session.info.transports())

    @property
    def hub_is_away(self) -> bool:
        """Whether the connection to the hub is lost; it is made again by itself."""
        return self._hub_is_away

    def log_connection(self, endpoint: str) -> None:
        """Log from now on when the hub at an endpoint is lost, and when it is back."""
        LOG.info("connected to the hub at %s", endpoint)

        def look(closed: zenoh.Transport | None = None) -> None:
            with self._connection:
                # The transport that has just closed may still be listed.
                left = [each.zid for each in self._session.info.transports()]
                away = not [zid for zid in left if closed is None or zid != closed.zid]
                if away == self._hub_is_away or self._session.is_closed():
                    return
                self._hub_is_away = away
            if away:
                LOG.warning("lost the hub at %s; waiting for it", endpoint)
            else:
                LOG.info("the hub at %s is back", endpoint)

        def on_change(event: zenoh.TransportEvent) -> None:
            look(event.transport if event.kind == zenoh.SampleKind.DELETE else None)

        listener = self._session.info.declare_transport_events_listener(on_change)
        self._declared.append(listener)
        look()  # the hub may have gone before anyone listened

    def close(self) -> None:
        """Close the connection; further calls do nothing."""
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def watched(self, key: str) -> bool:
        """Whether anyone subscribes to a key, as far as this process knows at this moment."""
        if key not in self._watched:
            self._watched[key] = self._session.declare_publisher(key)
        return bool(self._watched[key].matching_status.matching)  # type: ignore[attr-defined]

    def publish(self, key: str, message: Any, *, check: bool = True) -> None:
        """Publish a message that may be lost.

        Args:
            key: where.
            message: the message.
            check: check its fields before it is sent; without it, receivers drop an invalid one.
        """
        self.publish_wire(key, encode(message, check=check))

    def publish_wire(self, key: str, wire: Wire) -> None:
        """Publish an encoded message that may be lost."""
        self._put(key, wire, zenoh.CongestionControl.DROP)

    def deliver(self, key: str, message: Any, *, check: bool = True) -> None:
        """Publish a message; waits while the link is full. Arguments as in `publish`."""
        self.deliver_wire(key, encode(message, check=check))

    def deliver_wire(self, key: str, wire: Wire) -> None:
        """Publish an encoded message; waits while the link is full."""
        self._put(key, wire, zenoh.CongestionControl.BLOCK)

    def put_raw(self, key: str, payload: bytes) -> None:
        """Publish bytes as they are, without what makes them a message; for benchmarks."""
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def subscribe_raw(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Call `callback` with key and bytes of whatever is published; for benchmarks."""
        self._declared.append(
            self._session.declare_subscriber(
                key, lambda sample: callback(str(sample.key_expr), sample.payload.to_bytes())
            )
        )

    def publish_newest(self, key: str, message: Any) -> None:
        """Publish a message that later subscribers get as well, as long as this process lives."""
        if key not in self._newest:
            self._newest[key] = zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                cache=zenoh.ext.CacheConfig(
                    max_samples=1,
                    replies_config=zenoh.ext.RepliesConfig(
                        congestion_control=zenoh.CongestionControl.BLOCK
                    ),
                ),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(
                    heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
                ),
                publisher_detection=True,
            )
        wire = encode(message)
        self._newest[key].put(
            wire.payload, encoding=wire.encoding, attachment=self._attachment(wire)
        )

    def subscribe(
        self, key: str, callback: Callable[[M], None], *classes: type[M]
    ) -> Callable[[], None]:
        """Call `callback` with every message of `classes` under a key.

        Returns:
            A function that ends the subscription, if it is to end before the bus is closed.
        """
        return self._subscribed(key, self._receiver(callback, classes))

    def _subscribed(self, key: str, receive: Callable[[zenoh.Sample], None]) -> Callable[[], None]:
        declared = self._session.declare_subscriber(key, receive)
        self._declared.append(declared)

        def end() -> None:
            self._declared = [each for each in self._declared if each is not declared]
            declared.undeclare()  # type: ignore[no-untyped-call]

        return end

    def listen(
        self, key: str, callback: Callable[[M], None], *classes: type[M]
    ) -> Callable[[], None]:
        """Call `callback` with every message of `classes` under a key, for some time.

        Returns:
            A function that ends it.
        """
        subscriber = self._session.declare_subscriber(key, self._receiver(callback, classes))

        def end() -> None:
            if not self._session.is_closed():
                subscriber.undeclare()  # type: ignore[no-untyped-call]

        return end

    def subscribe_with_sender(
        self, key: str, callback: Callable[[M, Sender], None], *classes: type[M]
    ) -> Callable[[], None]:
        """Subscribe to messages that only some may send: the callback gets the sender as well.

        Gives a function that ends the subscription.
        """

        def receive(sample: zenoh.Sample) -> None:
            message, sender = self._decode(sample, *classes)
            if sender is not None:
                callback(message, sender)

        return self._subscribed(key, self._guarded(receive))

    def subscribe_newest(
        self,
        key: str,
        callback: Callable[[M], None],
        *classes: type[M],
        limit: int | None = None,
    ) -> None:
        """Subscribe to `publish_newest`: the newest earlier message is received first.

        Args:
            key: where.
            callback: called with each message.
            classes: classes of the messages.
            limit: largest size of a message that is decoded here (bytes).
        """
        self._declared.append(
            zenoh.ext.declare_advanced_subscriber(
                self._session,
                key,
                self._receiver(callback, classes, limit),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
        )

    def inbox(self, key: str, *classes: type[M], capacity: int) -> Inbox[M]:
        """Collect messages of `classes` under a key; at most `capacity` wait to be taken."""
        inbox = Inbox(self, classes, capacity)
        self._declared.append(self._session.declare_subscriber(key, inbox.put))
        return inbox

    def ask(
        self, key: str, question: Any, *answers: type[Answer], timeout_s: float = 2.0
    ) -> list[Answer]:
        """Ask all processes that answer under a key; gives their valid answers.

        The list is empty if nobody answers within timeout_s.
        """
        wire = encode(question)
        replies = self._session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=wire.payload,
            encoding=wire.encoding,
            attachment=self._attachment(wire),
        )
        given = []
        for reply in replies:
            if reply.ok is not None:
                try:
                    given.append(self.decode(reply.ok, *answers))
                except MessageError:
                    continue
        return given

    def answer(self, key: str, question: type[M], callback: Callable[[M], object | None]) -> None:
        """Answer questions under a key with what `callback` returns; None gives no answer."""

        def on_query(query: zenoh.Query) -> None:
            with query:  # a query that is not dropped hangs whoever asks
                try:
                    message = callback(self.decode(query, question))
                    if message is not None:
                        wire = encode(message)
                        query.reply(
                            key,
                            wire.payload,
                            encoding=wire.encoding,
                            attachment=self._attachment(wire),
                        )
                except MessageError:
                    pass
                except Exception:
                    LOG.exception("a question under %s could not be answered", plain(key))

        self._declared.append(self._session.declare_queryable(key, on_query))

    def announce(self) -> None:
        """Declare the liveliness token: this process is present until it closes the bus or dies."""
        token = self._session.liveliness().declare_token(self.keys.alive(self.role, self.id))
        self._declared.append(token)

    def present(self, role: Role) -> set[str]:
        """Ids of the living processes of a role. A token whose name is no id does not count."""
        replies = self._session.liveliness().get(self.keys.alive(role), timeout=2.0)
        names = (
            str(reply.ok.key_expr).rpartition("/")[2] for reply in replies if reply.ok is not None
        )
        return {name for name in names if is_id(name)}

    def watch_presence(self, role: Role, callback: Callable[[str, bool], None]) -> None:
        """Call back with id and True for each living process of a role, with False when it dies.

        When the hub dies, all processes seem to die.
        """

        def on_change(sample: zenoh.Sample) -> None:
            process = str(sample.key_expr).rpartition("/")[2]
            if not is_id(process):
                return
            try:
                callback(process, sample.kind == zenoh.SampleKind.PUT)
            except Exception:
                LOG.exception("presence of %s %s could not be handled", role, process)

        self._declared.append(
            self._session.liveliness().declare_subscriber(
                self.keys.alive(role), on_change, history=True
            )
        )

    def decode(self, received: zenoh.Sample | zenoh.Query, *classes: type[M]) -> M:
        """Decode what was received.

        Raises:
            MessageError: it is invalid; it has been counted and logged.
        """
        return self._decode(received, *classes)[0]

    def refuse(self, sender: str, problem: object) -> None:
        """Count a message as refused, and say why once for each sender.

        Args:
            sender: who sent it; a text from outside.
            problem: what is wrong with it; its text may come from outside.
        """
        self.refused += 1
        if sender in self._complained_about or len(self._complained_about) >= _SENDERS_REMEMBERED:
            return
        self._complained_about.add(sender)
        LOG.warning(
            "refused a message of %s: %s (logged once for each sender)",
            plain(sender, 300),
            plain(problem, 1000),
        )

    def _decode(
        self,
        received: zenoh.Sample | zenoh.Query,
        *classes: type[M],
        limit: int | None = None,
    ) -> tuple[M, Sender | None]:
        """Decode what was received; the message, and its sender if the attachment names one."""
        key = str(received.key_expr)
        encoding = str(received.encoding)
        content, note = received.payload, received.attachment
        name, sender, attachment = key, None, None
        try:
            if note is not None:
                attachment = Attachment.read(note)
                name, sender = f"{attachment.sender} ({key})", Sender.parse(attachment.sender)
            check_size(0 if content is None else len(content), encoding, *classes, limit=limit)
            payload = b"" if content is None else content.to_bytes()
            if attachment is not None:
                attachment.check(payload)
            message = decode(Wire(encoding, payload), *classes, limit=limit)
            if problem := origin_problem(message, key, sender):
                raise MessageError("sender", problem)
        except MessageError as error:
            self.refuse(name, error)
            raise
        return message, sender

    def _put(self, key: str, wire: Wire, congestion: zenoh.CongestionControl) -> None:
        self._session.put(
            key,
            wire.payload,
            encoding=wire.encoding,
            attachment=self._attachment(wire),
            congestion_control=congestion,
        )

    def _attachment(self, wire: Wire) -> bytes:
        return Attachment.of(wire.payload, f"{self.role}/{self.id}").written()

    def _receiver(
        self,
        callback: Callable[[M], None],
        classes: tuple[type[M], ...],
        limit: int | None = None,
    ) -> Callable[[zenoh.Sample], None]:
        return self._guarded(
            lambda sample: callback(self._decode(sample, *classes, limit=limit)[0])
        )

    def _guarded(self, receive: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
        """Call `receive`, and let no exception out into Zenoh's thread."""

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                receive(sample)
            except MessageError:
                pass
            except Exception:
                LOG.exception("a message under %s could not be handled", plain(sample.key_expr))

        return on_sample


def open_bus(
    config: HubConfig, run: str, role: Role, process: str, *, holder: Holder | None = None
) -> Bus:
    """Connect to the hub. A connection that is lost later is made again automatically.

    Args:
        config: the hub.
        run: name of the run.
        role: role of this process.
        process: id of this process.
        holder: whose certificate to show; None for that of the role.

    Raises:
        NoHubError: no hub answers within CONNECT_WAIT_S, or it does not let this process in.
        UserError: the endpoint is not protected, or the certificate cannot be used.
    """
    certificate = certificate_for(config, holder or HOLDER_OF[role])
    warn_if_insecure(config)
    settings = _settings(config, "client", certificate)
    settings["connect"] = {
        "endpoints": [reachable(config.endpoint)],
        "timeout_ms": round(CONNECT_WAIT_S * 1000),
        "exit_on_failure": True,
        "retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2},
    }
    settings["listen"] = {"endpoints": []}
    try:
        session = _open(settings)
    except zenoh.ZError as error:
        raise NoHubError(
            f"no hub answers at {config.endpoint}: start one with `vmdnn hub`, or name the right "
            f"one with --connect {config.endpoint.partition('/')[0]}/HOST:PORT ({_reason(error)})"
        ) from error
    return Bus(session, run, role, process, certificate)


def join_hub(
    config: HubConfig, run: str, role: Role, process: str, lifecycle: Lifecycle
) -> Bus | None:
    """Connect to the hub as soon as there is one; log when it is lost later and when it is back.

    Returns:
        The connection; None if the process was asked to stop before.
    """
    told = False
    while not lifecycle.stopping:
        lifecycle.waits_for(f"the hub at {config.endpoint}")
        try:
            bus = open_bus(config, run, role, process)
        except NoHubError as error:
            if not told:
                LOG.warning("%s. Waiting for it", error)
            told = True
            lifecycle.wait(_CONNECT_AGAIN_S)
        else:
            lifecycle.waits_for("")
            bus.log_connection(config.endpoint)
            return bus
    return None


def open_hub(config: HubConfig, run: str, process: str) -> Bus:
    """Open the hub itself: a Zenoh router inside this process that listens at the endpoint.

    Raises:
        CannotListenError: it cannot listen there.
        UserError: the endpoint is not protected, or the certificate cannot be used.
    """
    certificate = certificate_for(config, Holder.HUB)
    warn_if_insecure(config)
    settings = _settings(config, "router", certificate)
    settings["listen"] = {"endpoints": [config.endpoint], "exit_on_failure": True}
    if certificate is not None:
        settings["access_control"] = hub_access_control(config)
    # A receiver that does not read must not hold up the senders: for it, and for it alone, messages
    # are dropped. What must arrive is sent again (`publish_newest`, and `proto.outbox`).
    settings["qos"] = {
        "network": [
            {
                "messages": ["put"],
                "flows": ["egress"],
                "overwrite": {"congestion_control": "drop"},
            }
        ]
    }
    queue = {"size": {"data": _WAITING_BATCHES}}
    settings["transport"].setdefault("link", {})["tx"] = {"queue": queue}
    try:
        return Bus(_open(settings), run, Role.HUB, process, certificate)
    except zenoh.ZError as error:
        raise CannotListenError(
            f"the hub cannot listen at {config.endpoint}: {_reason(error)}. Is another hub "
            "running there? Stop it, or choose another port with --set hub.endpoint="
            f"{config.endpoint.partition('/')[0]}/HOST:PORT"
        ) from error


def _settings(config: HubConfig, mode: str, certificate: Certificate | None) -> dict[str, Any]:
    return {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},  # the newest sample of a key is kept by its timestamp
        "transport": {
            # A session that receives more closes the link, before it has taken the memory.
            "link": {
                "rx": {"max_message_size": LARGEST_MESSAGE},
                **link_settings(certificate, listens=mode == "router"),
            },
            "shared_memory": {
                "enabled": config.shared_memory,
                "transport_optimization": {"message_size_threshold": SHARED_MEMORY_FROM_BYTES},
            },
        },
    }


def _open(settings: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def _reason(error: zenoh.ZError) -> str:
    """The first cause of a Zenoh error, without locations in Zenoh's source code."""
    text = re.sub(r" at \S+\.rs:\d+\.?", "", str(error))
    causes = re.findall(r"\[\S+: ([^\[\]]+)\]", text)
    return str(causes[-1] if causes else text)
