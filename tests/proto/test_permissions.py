"""The table of permissions, its document, and the hub's access control that is made of it."""

from __future__ import annotations

from pathlib import Path

from proto.keys import Keys, Role
from proto.permissions import TABLE, Holder, Verb, access_control, document_table

DOCUMENT = Path(__file__).parents[2] / "docs" / "security.md"


def test_the_document_has_the_table() -> None:
    lines = DOCUMENT.read_text().splitlines()
    table = [line for line in lines if line.startswith(("| key |", "|---|", "| `vmdnn/"))]
    assert "\n".join(table) == document_table()


def test_every_key_has_a_row() -> None:
    keys = Keys("<run>")
    members = [role for role in Role if role is not Role.WATCH]
    ids = {role: "<actor>" if role is Role.ACTOR else "<id>" for role in members}
    assert {row.key for row in TABLE} == {
        keys.policy,
        f"{keys.policy}/@adv/**",
        keys.sequence("<actor>"),
        keys.outcome("<actor>"),
        keys.rollout("<actor>"),
        keys.failure("<actor>"),
        *(keys.receipt(each, "<actor>") for each in (Role.LEARNER, Role.EVALUATOR, Role.RECORDER)),
        keys.verdict,
        keys.request_tutoring,
        keys.request_trial,
        keys.settings,
        keys.configuration,
        keys.identity("<actor>"),
        keys.claim(Role.LEARNER),
        keys.claim(Role.EVALUATOR),
        keys.live("<actor>"),
        keys.pictures("<actor>"),
        *(keys.metrics(role, name) for role, name in ids.items()),
        keys.metrics(),
        *(keys.alive(role, name) for role, name in ids.items()),
        keys.alive(),
        *(keys.control(role) for role in members),
    }


def test_what_matters_most_is_given_to_one_holder_alone() -> None:
    def holders(key: str, verb: Verb) -> set[Holder]:
        return {each for row in TABLE if row.key == key for each in Holder if row.may(each, verb)}

    keys = Keys("<run>")
    assert holders(keys.policy, Verb.PUT) == {Holder.LEARNER}
    assert holders(keys.verdict, Verb.PUT) == {Holder.EVALUATOR}
    assert all(holders(keys.control(role), Verb.QUERY) <= {Holder.OPERATOR} for role in Role)
    looks = {row.key.split("/")[2] for row in TABLE if row.allowed.get(Holder.WATCHER)}
    assert looks == {"metrics", "alive", "live", "pictures"}


def test_an_actor_with_a_certificate_of_its_own_is_bound_to_its_name() -> None:
    made = access_control(["vm1"])
    assert made["default_permission"] == "deny"
    assert {"id": "actor-vm1", "cert_common_names": ["actor-vm1"]} in made["subjects"]
    (put,) = (rule for rule in made["rules"] if rule["id"] == "actor-vm1 put ingress")
    assert "vmdnn/*/sequence/vm1" in put["key_exprs"]
    assert all(key.endswith(("/vm1", "/vm1-$*")) for key in put["key_exprs"])
