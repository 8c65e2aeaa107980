"""Which role may do what under which key: the one table of it.

The hub's access control is made of it (`access_control`), and so is the table in docs/security.md
(`document_table`). Everything that the table does not allow is denied.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from proto.keys import Keys, Role


class Holder(StrEnum):
    """Who can hold a certificate; its common name says which of them."""

    HUB = "hub"
    LEARNER = "learner"
    EVALUATOR = "evaluator"
    RECORDER = "recorder"
    ACTOR = "actor"
    OPERATOR = "operator"
    WATCHER = "watcher"


class Verb(StrEnum):
    """What can be done under a key.

    put: publish messages.
    subscribe: receive messages.
    query: ask questions.
    reply: answer questions.
    token: declare a liveliness token.
    presence: see liveliness tokens.
    """

    PUT = "put"
    SUBSCRIBE = "subscribe"
    QUERY = "query"
    REPLY = "reply"
    TOKEN = "token"
    PRESENCE = "presence"


HOLDER_OF: Final[Mapping[Role, Holder]] = {
    Role.HUB: Holder.HUB,
    Role.LEARNER: Holder.LEARNER,
    Role.EVALUATOR: Holder.EVALUATOR,
    Role.RECORDER: Holder.RECORDER,
    Role.ACTOR: Holder.ACTOR,
    Role.WATCH: Holder.WATCHER,
}
"""Whose certificate a process shows. Who commands the processes of a run shows the operator's."""

ACTOR_ID: Final = "<actor>"
"""Stands for the id of an actor in the keys of the table."""
_RUN: Final = "<run>"
_ID: Final = "<id>"
_LOOKERS: Final = (Holder.WATCHER, Holder.OPERATOR)
_MEMBERS: Final = (Role.HUB, Role.LEARNER, Role.EVALUATOR, Role.RECORDER, Role.ACTOR)
_RECEIVERS: Final = (Role.LEARNER, Role.EVALUATOR, Role.RECORDER)


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        key: the key, with `<run>`, `<actor>` and `<id>` for what differs.
        allowed: what each holder may do under it.
    """

    key: str
    allowed: Mapping[Holder, frozenset[Verb]]

    def may(self, holder: Holder, verb: Verb) -> bool:
        """Whether a holder may do something under the key."""
        return verb in self.allowed.get(holder, ())

    def key_expression(self, actor: str = "*") -> str:
        """Key expression of Zenoh for all runs.

        Args:
            actor: key expression for the id of the actor.
        """
        return self.key.replace(_RUN, "*").replace(_ID, "*").replace(ACTOR_ID, actor)


def _row(key: str, *allowed: tuple[Holder | Iterable[Holder], Iterable[Verb]]) -> Row:
    verbs: dict[Holder, frozenset[Verb]] = {}
    for holders, what in allowed:
        for holder in (holders,) if isinstance(holders, Holder) else holders:
            verbs[holder] = verbs.get(holder, frozenset()) | frozenset(what)
    return Row(key, verbs)


def _rows() -> Iterator[Row]:
    keys = Keys(_RUN)
    put, subscribe, query, reply = Verb.PUT, Verb.SUBSCRIBE, Verb.QUERY, Verb.REPLY
    token, presence = Verb.TOKEN, Verb.PRESENCE
    learner, evaluator, actor = Holder.LEARNER, Holder.EVALUATOR, Holder.ACTOR
    recorder = Holder.RECORDER
    readers = (actor, evaluator, recorder)
    # Late joiners ask the publisher for the newest policy. They ask below `@adv`, which `*` and
    # `**` do not match; the answer has the key of the policy.
    yield _row(keys.policy, (learner, (put, reply)), (readers, (subscribe, query)))
    yield _row(
        f"{keys.policy}/@adv/**",
        (learner, (put, reply, token)),
        (readers, (subscribe, query, presence)),
    )
    yield _row(keys.sequence(ACTOR_ID), (actor, (put,)), (learner, (subscribe,)))
    yield _row(keys.outcome(ACTOR_ID), (actor, (put,)), (evaluator, (subscribe,)))
    yield _row(keys.rollout(ACTOR_ID), (actor, (put,)), (recorder, (subscribe,)))
    yield _row(keys.failure(ACTOR_ID), (actor, (put,)), ((learner, evaluator), (subscribe,)))
    for role in _RECEIVERS:
        yield _row(keys.receipt(role, ACTOR_ID), (HOLDER_OF[role], (put,)), (actor, (subscribe,)))
    yield _row(keys.verdict, (evaluator, (put,)), (learner, (subscribe,)))
    yield _row(keys.request_tutoring, (actor, (query,)), (learner, (reply,)))
    yield _row(keys.request_trial, (actor, (query,)), (evaluator, (reply,)))
    yield _row(
        keys.settings,
        ((learner, evaluator, recorder, actor), (query,)),
        ((learner, evaluator), (reply,)),
    )
    yield _row(keys.configuration, ((evaluator, recorder, actor), (query,)), (learner, (reply,)))
    yield _row(keys.identity(ACTOR_ID), (actor, (query, reply)))
    for role in (Role.LEARNER, Role.EVALUATOR):
        yield _row(keys.claim(role), (HOLDER_OF[role], (query, reply)))
    yield _row(keys.live(ACTOR_ID), (actor, (put,)), (_LOOKERS, (subscribe,)))
    yield _row(keys.pictures(ACTOR_ID), (actor, (put,)), (_LOOKERS, (subscribe,)))
    for role in _MEMBERS:
        name = ACTOR_ID if role is Role.ACTOR else _ID
        # The evaluator listens whether the learner needs practice.
        listeners = (evaluator,) if role is Role.LEARNER else ()
        yield _row(
            keys.metrics(role, name), (HOLDER_OF[role], (put, subscribe)), (listeners, (subscribe,))
        )
    # A subscription must be within the key of one row, so the wildcard has a row of its own.
    yield _row(keys.metrics(), ((*_LOOKERS, recorder), (subscribe,)))
    for role in _MEMBERS:
        name = ACTOR_ID if role is Role.ACTOR else _ID
        yield _row(keys.alive(role, name), (HOLDER_OF[role], (token,)))
    yield _row(keys.alive(), (Holder, (presence,)))
    for role in _MEMBERS:
        yield _row(keys.control(role), (HOLDER_OF[role], (reply,)), (Holder.OPERATOR, (query,)))


TABLE: Final = tuple(_rows())
"""All keys. The hub itself is the router: what it does is listed, but it is not held to it."""

_OWN: Final = frozenset({Verb.PUT, Verb.SUBSCRIBE, Verb.REPLY, Verb.TOKEN})
"""What an actor with a certificate of its own may do under its own id only."""

_INGRESS: Final[Mapping[Verb, tuple[str, ...]]] = {
    Verb.PUT: ("put",),
    Verb.SUBSCRIBE: ("declare_subscriber",),
    Verb.QUERY: ("query",),
    Verb.REPLY: ("declare_queryable", "reply"),
    Verb.TOKEN: ("liveliness_token",),
    Verb.PRESENCE: ("liveliness_query", "declare_liveliness_subscriber"),
}
"""Zenoh's messages from a holder to the hub that a verb needs."""
_EGRESS: Final[Mapping[Verb, tuple[str, ...]]] = {
    Verb.PUT: ("declare_subscriber",),
    Verb.SUBSCRIBE: ("put",),
    Verb.QUERY: ("declare_queryable", "reply"),
    Verb.REPLY: ("query",),
    Verb.TOKEN: ("liveliness_query", "declare_liveliness_subscriber"),
    Verb.PRESENCE: ("liveliness_token",),
}
"""Zenoh's messages from the hub to a holder that a verb needs."""


def own_ids(name: str) -> tuple[str, str]:
    """Key expressions for the ids under which a certificate `actor-NAME` may act.

    They are `NAME` and `NAME-1`, `NAME-2` and so on, for several actors on one machine.
    """
    return name, f"{name}-$*"


def access_control(actors: Sequence[str]) -> dict[str, Any]:
    """Section `access_control` of the hub's Zenoh configuration.

    Args:
        actors: names of the actors with certificates of their own, `actor-NAME`.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    certificates: list[tuple[Holder, str, tuple[str, ...]]] = [
        *((holder, holder.value, ("*",)) for holder in Holder if holder is not Holder.HUB),
        *((Holder.ACTOR, f"{Holder.ACTOR}-{name}", own_ids(name)) for name in actors),
    ]
    for holder, common_name, ids in certificates:
        made = list(_rules(holder, common_name, ids))
        rules += made
        subjects.append({"id": common_name, "cert_common_names": [common_name]})
        policies.append({"rules": [rule["id"] for rule in made], "subjects": [common_name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(holder: Holder, common_name: str, ids: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    for verb in Verb:
        rows = [row for row in TABLE if row.may(holder, verb)]
        if not rows:
            continue
        own = ids if holder is Holder.ACTOR and verb in _OWN else ("*",)
        ingress = {row.key_expression(actor) for row in rows for actor in own}
        # Towards an actor also come declarations that span all actors, such as the learner's
        # subscription to all sequences. Receipts of other actors must not come.
        received = own if verb is Verb.SUBSCRIBE else ("*",)
        egress = {row.key_expression(actor) for row in rows for actor in received}
        for flow, messages, expressions in (
            ("ingress", _INGRESS[verb], ingress),
            ("egress", _EGRESS[verb], egress),
        ):
            yield {
                "id": f"{common_name} {verb} {flow}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": sorted(expressions),
            }


def document_table() -> str:
    """The table in Markdown, as it stands in docs/security.md."""
    lines = [
        f"| key | {' | '.join(Holder)} |",
        f"|---|{'---|' * len(Holder)}",
        *(f"| `{row.key}` |{''.join(_cell(row, holder) for holder in Holder)}" for row in TABLE),
    ]
    return "\n".join(lines)


def _cell(row: Row, holder: Holder) -> str:
    verbs = ", ".join(verb for verb in Verb if row.may(holder, verb))
    return f" {verbs} |" if verbs else " |"
