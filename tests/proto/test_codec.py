"""Messages are decoded unchanged, and an invalid field is refused by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from proto.codec import (
    Array,
    MessageError,
    Number,
    Text,
    Wire,
    decode,
    encode,
    message,
    record_of,
    schema_of,
)
from proto.episode import BoxLook, Episode, Kind
from proto.messages import (
    Command,
    Control,
    Live,
    LiveScene,
    PolicyVersion,
    Receipt,
    Rollout,
    Sequence,
    Trial,
    TrialRequest,
    TutoringCase,
)
from proto.metrics import METRICS, ActorMetrics, EvaluatorMetrics, PolicyScore, Success, SuiteScore
from proto.suites import MOST_STRETCH, Conditions, Player

MakeEpisode = Callable[..., Episode]

IDS = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", fullmatch=True)
WORDS = st.text(st.characters(categories=("L", "N", "P", "Zs")), max_size=40).filter(
    str.isprintable
)
COUNTS = st.integers(0, 2**31)
PLAYERS = st.builds(Player, WORDS, st.lists(WORDS, max_size=4).map(tuple))
CONDITIONS = st.one_of(
    st.none(),
    st.builds(Conditions, IDS, st.floats(1, MOST_STRETCH)),
    st.builds(Conditions, IDS, st.just(1.0), st.just("pushed"), st.floats(10, 30)),
)
MESSAGES = st.one_of(
    st.builds(Receipt, IDS),
    st.builds(TutoringCase, WORDS, COUNTS, COUNTS),
    st.builds(
        TrialRequest, IDS, IDS, COUNTS, WORDS, PLAYERS, st.lists(COUNTS, max_size=32).map(tuple)
    ),
    st.builds(Trial, COUNTS, st.integers(0, 2**63 - 1), CONDITIONS),
    st.builds(Control, st.sampled_from(Command)),
    st.builds(
        PolicyVersion,
        IDS,
        st.integers(1, 10**6),
        st.integers(10**6, 2**31),
        st.floats(0, 1e9),
        WORDS,
        st.binary(min_size=1, max_size=2000),
    ),
)


@pytest.fixture(scope="module")
def sequence(make_episode: MakeEpisode) -> Sequence:
    return Sequence(make_episode(steps=3))


def same(left: Any, right: Any) -> bool:
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and np.array_equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if hasattr(left, "__dataclass_fields__"):
        return type(left) is type(right) and all(
            same(getattr(left, field.name), getattr(right, field.name)) for field in fields(left)
        )
    return bool(left == right)


def refusal(wire: Wire) -> MessageError | None:
    """Why a sequence is refused; None if it is valid, and then it can be sent again."""
    try:
        encode(decode(wire, Sequence))
    except MessageError as error:
        return error
    return None


@given(MESSAGES)
def test_a_message_is_decoded_unchanged(sent: Any) -> None:
    assert decode(encode(sent), type(sent)) == sent


@given(steps=st.integers(1, 30), with_outputs=st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20)
def test_a_whole_episode_is_decoded_unchanged(
    make_episode: MakeEpisode, steps: int, with_outputs: bool
) -> None:
    episode = make_episode(steps=steps, kind=Kind.TRIAL)
    sent = Rollout(episode if with_outputs else replace(episode, outputs=None), "abc")
    received = decode(encode(sent), Rollout)
    assert same(sent, received)
    received.episode.images[0, 0, 0] = 7  # arrays belong to whoever received them


def test_states_are_decoded_unchanged_and_missing_states_are_not_sent(sequence: Sequence) -> None:
    """So that programs from before there were states understand the others."""
    random = np.random.default_rng(1)
    states = {name: random.random((3, units), np.float32) for name, units in (("a", 5), ("b", 2))}
    sent = Sequence(replace(sequence.episode, states=states))
    received = decode(encode(sent), Sequence).episode.states
    assert received is not None
    assert same(states["a"], received["a"])
    assert same(states["b"], received["b"])
    assert "states" in msgpack.unpackb(encode(sent).payload)["episode"]
    assert "states" not in msgpack.unpackb(encode(sequence).payload)["episode"]
    assert decode(encode(sequence), Sequence).episode.states is None


def test_conditions_are_decoded_unchanged_and_missing_conditions_are_not_sent(
    sequence: Sequence,
) -> None:
    conditions = Conditions("disturbed", 1.2, "noisy", 7.5)
    sent = Sequence(replace(sequence.episode, conditions=conditions))
    assert decode(encode(sent), Sequence).episode.conditions == conditions
    assert "conditions" not in msgpack.unpackb(encode(sequence).payload)["episode"]
    assert decode(encode(sequence), Sequence).episode.suite == "unlearned"


def test_a_live_step_is_decoded_unchanged() -> None:
    random = np.random.default_rng(1)
    sent = Live(
        actor="a-1",
        kind=Kind.TRIAL,
        policy="run",
        policy_version=3,
        step=12,
        phase="lift",
        image=random.integers(0, 256, (48, 64), dtype=np.uint8),
        joints_deg=random.uniform(-90, 90, 18).astype(np.float32),
        action=random.uniform(-90, 90, 11).astype(np.float32),
        body_poses=random.uniform(-1, 1, (2, 7)).astype(np.float32),
        focal_px=np.array([50.0, 60.0], np.float32),
    )
    assert same(decode(encode(sent), Live), sent)
    scene = LiveScene(
        ("object", "l_eye"),
        {"object": BoxLook((0.1, 0.2, 0.3), (1.0, 0.0, 0.5))},
        {"chest": random.uniform(-1, 1, 7).astype(np.float32)},
    )
    sent = replace(sent, scene=scene)
    assert same(decode(encode(sent), Live), sent)
    sent = replace(sent, pfc=random.uniform(-1.7, 1.7, 20).astype(np.float32))
    assert same(decode(encode(sent), Live), sent)


@given(length=st.floats(0, 1, exclude_max=True))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_truncated_message_is_refused(sequence: Sequence, length: float) -> None:
    wire = encode(sequence)
    with pytest.raises(MessageError):
        decode(Wire(wire.encoding, wire.payload[: int(length * len(wire.payload))]), Sequence)


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
def test_a_damaged_message_is_refused_or_still_valid(sequence: Sequence, data: Any) -> None:
    wire = encode(sequence)
    payload = bytearray(wire.payload)
    # most bytes are pixels: half of the damage goes where the structure is
    structure = st.integers(0, 400) | st.integers(len(payload) - 400, len(payload) - 1)
    for place in data.draw(
        st.lists(structure | st.integers(0, len(payload) - 1), min_size=1, max_size=5)
    ):
        payload[place] = data.draw(st.integers(0, 255))
    error = refusal(Wire(wire.encoding, bytes(payload)))
    assert error is None or error.field


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(payload: bytes) -> None:
    for made in (Sequence, Control, ActorMetrics):
        with pytest.raises(MessageError):
            decode(Wire(schema_of(made).encoding, payload), made)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


@given(name=st.sampled_from([field.name for field in fields(Episode)]), plain=PLAIN)
@example(name="phase_names", plain=["one"])  # fewer phases than the steps name
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
def test_a_field_of_another_kind_is_refused_by_name(
    sequence: Sequence, name: str, plain: Any
) -> None:
    wire = encode(sequence)
    content = msgpack.unpackb(wire.payload)
    content["episode"][name] = plain
    error = refusal(Wire(wire.encoding, msgpack.packb(content)))
    if error is not None:
        shares_a_size = {"T", "B"} & set(error.problem.split())
        names_the_phases = name == "phase_names" and error.problem.startswith("phases:")
        named = error.field.startswith(f"episode.{name}")
        assert named or shares_a_size or names_the_phases


@pytest.mark.parametrize(
    ("change", "field", "problem"),
    [
        (lambda e: e.update(images=e["actions"]), "episode.images", "dtype uint8, got 'float32'"),
        (lambda e: e["images"].__setitem__(1, [3, 64, 48]), "episode.images", "[T, 48, 64]"),
        (lambda e: e["actions"].__setitem__(1, [2, 11]), "episode.actions", "T = 2"),
        (lambda e: e["actions"].__setitem__(2, b"12"), "episode.actions", "132 bytes, got 2"),
        (
            lambda e: e.update(states={"pfc": ["float32", [2, 1], bytes(8)]}),
            "episode.states['pfc']",
            "T = 2",
        ),
        (lambda e: e["images"].__setitem__(1, [10**9, 48, 64]), "episode.images", "not in 1..2000"),
        (lambda e: e.pop("seed"), "episode.seed", "missing"),
        (lambda e: e.update(mood=1), "episode.'mood'", "not a field"),
        (lambda e: e.update(seed=-1), "episode.seed", "got -1"),
        (lambda e: e.update(id="../../etc"), "episode.id", "'../../etc'"),
        (lambda e: e.update(task="\x1b[2J"), "episode.task", "printable"),
        (lambda e: e.update(kind="party"), "episode.kind", "tutoring, correction, trial, practice"),
        (lambda e: e["outcome"].update(strict=1), "episode.outcome.strict", "true or false"),
        (lambda e: e["situation"].update(x=None), "episode.situation['x']", "number, got nothing"),
        (lambda e: e["situation"].update(x="a" * 65), "episode.situation['x']", "got 65"),
        (lambda e: e["situation"].update(x=float("nan")), "episode.situation['x']", "got nan"),
        (lambda e: e["phases"].__setitem__(2, b"\x01\x02\x09"), "episode", "in phase 9 of 8"),
        (lambda e: e["outcome"].update(reason="none"), "episode.outcome", "does not fit"),
        (lambda e: e["outcome"].update(lenient=False), "episode.outcome", "lenient"),
        (
            lambda e: e["actions"].__setitem__(2, np.full((3, 11), np.nan, "<f4").tobytes()),
            "episode.actions",
            "finite",
        ),
    ],
)
def test_the_problem_is_named(
    sequence: Sequence, change: Callable[[dict[str, Any]], Any], field: str, problem: str
) -> None:
    wire = encode(sequence)
    content = msgpack.unpackb(wire.payload)
    change(content["episode"])
    with pytest.raises(MessageError) as raised:
        decode(Wire(wire.encoding, msgpack.packb(content)), Sequence)
    assert raised.value.field == field
    assert problem in raised.value.problem


def test_the_sender_refuses_an_invalid_message(sequence: Sequence) -> None:
    wrong = replace(sequence.episode, images=sequence.episode.images[:, :, :32])
    with pytest.raises(MessageError, match=r"episode.images: expected shape \[T, 48, 64\]"):
        encode(Sequence(wrong))


def test_an_unchecked_invalid_message_is_refused_by_the_receiver(sequence: Sequence) -> None:
    assert encode(sequence, check=False) == encode(sequence)
    wrong = replace(sequence, episode=replace(sequence.episode, seed=-1))
    with pytest.raises(MessageError, match=r"episode\.seed"):
        decode(encode(wrong, check=False), Sequence)


def test_another_message_or_version_is_refused(sequence: Sequence) -> None:
    wire = encode(sequence)
    assert wire.encoding == "application/msgpack;vmdnn.sequence.4"
    for encoding in (
        "application/msgpack;vmdnn.sequence.3",
        "application/msgpack;vmdnn.rollout.3",
        "zenoh/bytes",
        "",
    ):
        with pytest.raises(MessageError, match="encoding: expected"):
            decode(Wire(encoding, wire.payload), Sequence)


def test_a_message_that_is_too_large_is_refused_before_it_is_read() -> None:
    wire = encode(Receipt("abc"))
    with pytest.raises(MessageError, match="at most 65536 bytes"):
        decode(Wire(wire.encoding, wire.payload + bytes(70_000)), Receipt)


def test_metrics_are_plain_json() -> None:
    rate = Success(3, 0.75, (0.3, 0.95))
    scores = (PolicyScore(2, 4, rate, rate, rate, {"not_lifted": 1}),)
    sent = EvaluatorMetrics(
        id="evaluator",
        time_s=1.5,
        refused=0,
        policies=scores,
        suites=(SuiteScore("unlearned", "sapien", 52, "", scores),),
        leases=1,
        damaged=0,
        paused=False,
        done=False,
    )
    wire = encode(sent)
    read = json.loads(wire.payload)
    assert read["role"] == "evaluator"
    assert read["policies"][0]["strict"] == {
        "successes": 3,
        "rate": 0.75,
        "wilson95": [0.3, 0.95],
    }
    assert decode(wire, *METRICS) == sent


def test_a_field_without_a_check_raises_type_error() -> None:
    @dataclass(frozen=True)
    class Careless:
        values: list[int]

    with pytest.raises(TypeError, match=r"Careless\.values"):
        record_of(Careless)


def test_arrays_and_numbers_keep_their_ranges() -> None:
    @message("test", 1)
    @dataclass(frozen=True)
    class Ranged:
        values: Annotated[Any, Array("float32", (2,), 0.0, 1.0)]
        share: Annotated[float, Number(0.0, 1.0)]
        name: Annotated[str, Text(3)]

    fine = Ranged(np.zeros(2, np.float32), 0.5, "abc")
    assert same(decode(encode(fine), Ranged), fine)
    for wrong in (
        replace(fine, values=np.array([0, 2], np.float32)),
        replace(fine, values=np.zeros(2)),
        replace(fine, share=1.5),
        replace(fine, name="abcd"),
    ):
        with pytest.raises(MessageError):
            encode(wrong)
