"""A policy that does not fit the run is refused with a reason, and nothing else happens."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from fitting import make_policy
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from learner.checkpoint import checkpoint_from_bytes
from learner.network.subnets import LARGEST_NETWORK
from learner.network_policy import NetworkPolicy
from learner.policy_message import policy_limit, policy_of
from proto.bus import LARGEST_MESSAGE
from proto.codec import MessageError, Wire, decode, encode
from proto.config import load_config
from proto.errors import UserError
from proto.messages import POLICY_LIMIT, PolicyVersion

CONFIG = load_config(None, ["run.name=test"])
GOOD = make_policy(3)
PICTURE = np.zeros((48, 64), np.uint8)


def text_of(blob: bytes) -> str:
    header = json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])
    return str(header["__metadata__"]["vmdnn"])


def changed(change: Callable[[dict[str, Any]], Any], policy: PolicyVersion = GOOD) -> PolicyVersion:
    """The policy with its metadata changed as JSON, past all checks."""
    values = json.loads(text_of(policy.weights))
    change(values)
    return replace(policy, weights=save(load(policy.weights), {"vmdnn": json.dumps(values)}))


def with_weight(value: float) -> PolicyVersion:
    tensors = load(GOOD.weights)
    tensors["network.pfc.input"][0, 0] = value
    return replace(GOOD, weights=save(tensors, {"vmdnn": text_of(GOOD.weights)}))


def test_a_policy_of_the_run_is_taken() -> None:
    policy = NetworkPolicy(policy_of(GOOD, CONFIG), "the policy")
    assert (policy.name, policy.version) == ("test", 3)
    assert np.isfinite(policy.step(PICTURE)).all()


@pytest.mark.parametrize(
    ("policy", "problem"),
    [
        (replace(GOOD, weights=b"weights"), "is not a checkpoint"),
        (replace(GOOD, version=4), "contradicts its message"),
        (replace(GOOD, epoch=31), "contradicts its message"),
        (replace(GOOD, loss=0.4), "contradicts its message"),
        (replace(GOOD, config_digest="other"), "contradicts its message"),
        (changed(lambda v: v.update(run="a\nb")), "run"),
        (make_policy(3, task="reaching"), "was trained for the task reaching"),
        (make_policy(3, task=None), "was trained for the task None"),
        (make_policy(3, code=None), "not a policy of VMDNN that can act"),
        (
            make_policy(3, network=load_config(None, ["network.pfc.units=7"]).network),
            "network.pfc.units: 7 in the checkpoint, 20 in the config",
        ),
        (changed(lambda v: v["network"]["mstnn_fast"].update(stride=2**32)), "stride"),
        (
            changed(lambda v: v["network"]["mstnn_fast"].update(kernel=[64, 48])),
            "mstnn_slow",
        ),
        (changed(lambda v: v["network"]["pfc"].update(units=2**31)), "units"),
        (changed(lambda v: v["network"].update(softmax_units=10**9)), "softmax_units"),
        (changed(lambda v: v["network"].update(image=[48, 64])), "image"),
        (changed(lambda v: v.update(format=1, network={"image": [48, 64]})), "[48, 64]"),
        (changed(lambda v: v.update(format=1, network=[1])), "another version"),
        (changed(lambda v: v["network"].update(code_margin=1e308)), "code_margin"),
        (changed(lambda v: v["code"]["minima"].__setitem__(0, float("nan"))), "finite"),
        (changed(lambda v: v["code"]["maxima"].__setitem__(0, float("inf"))), "code.maxima"),
        (changed(lambda v: v["code"]["minima"].__setitem__(0, -1e308)), "code.minima"),
        (changed(lambda v: v["code"]["minima"].__setitem__(0, 40.0)), "range that is empty"),
        (changed(lambda v: v["code"]["minima"].pop()), "11 action values"),
        (changed(lambda v: v.update(version=2**31)), "version"),
        (changed(lambda v: v.update(epoch=-1)), "epoch"),
        (with_weight(float("nan")), "not all finite"),
        (with_weight(1e38), "exceed"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(policy: PolicyVersion, problem: str) -> None:
    with pytest.raises(UserError) as raised:
        policy_of(policy, CONFIG)
    assert problem in str(raised.value)


@pytest.mark.parametrize("version", [0, 10**6 + 1, 2**31, 2**40])
def test_versions_have_a_bound(version: int) -> None:
    wire = encode(GOOD)
    payload = msgpack.packb({**msgpack.unpackb(wire.payload), "version": version})
    with pytest.raises(MessageError, match="version"):
        decode(Wire(wire.encoding, payload), PolicyVersion)


def test_a_version_takes_an_epoch() -> None:
    with pytest.raises(ValueError, match="version 31 cannot come after 30 epochs"):
        replace(GOOD, version=31)


def test_the_network_of_the_run_limits_the_size_of_a_policy() -> None:
    """A larger message is refused before it is decoded; the limit is near the real size."""
    wire, limit = encode(GOOD), policy_limit(CONFIG.network)
    assert decode(wire, PolicyVersion, limit=limit) == GOOD
    assert len(wire.payload) < limit < len(wire.payload) + 2**18
    large = encode(replace(GOOD, weights=bytes(limit)))
    with pytest.raises(MessageError, match=f"expected at most {limit} bytes"):
        decode(large, PolicyVersion, limit=limit)


def test_the_largest_possible_network_fits_into_a_message() -> None:
    assert 4 * LARGEST_NETWORK + 2**18 < POLICY_LIMIT < LARGEST_MESSAGE


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from([0, 1, 2, 10, 64, 2**16, 2**31, 2**32, 1e308, -1.0]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner),
    max_leaves=6,
)


def paths(values: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [at] if at else []
    if isinstance(values, dict):
        return found + [p for key, value in values.items() for p in paths(value, (*at, key))]
    if isinstance(values, list):
        return found + [p for i, value in enumerate(values[:2]) for p in paths(value, (*at, i))]
    return found


PATHS = paths(json.loads(text_of(GOOD.weights)))


@given(place=st.sampled_from(PATHS), value=JSON)
@settings(max_examples=150)
def test_whatever_its_metadata_say_it_is_taken_or_refused(
    place: tuple[Any, ...], value: Any
) -> None:
    def change(values: Any) -> None:
        for key in place[:-1]:
            values = values[key]
        values[place[-1]] = value

    try:
        checkpoint = policy_of(changed(change), CONFIG)
    except UserError:
        return
    assert np.isfinite(NetworkPolicy(checkpoint, "the policy").step(PICTURE)).all()


@given(st.data())
@settings(max_examples=80)
def test_whatever_is_damaged_it_is_taken_or_refused(data: Any) -> None:
    blob = bytearray(GOOD.weights)
    header = 8 + int.from_bytes(blob[:8], "little")
    place = st.integers(0, header - 1) | st.integers(0, len(blob) - 1)
    for at in data.draw(st.lists(place, min_size=1, max_size=4)):
        blob[at] = data.draw(st.integers(0, 255))
    cut = data.draw(st.none() | st.integers(0, len(blob)))
    try:
        checkpoint = policy_of(replace(GOOD, weights=bytes(blob[:cut]) or b"-"), CONFIG)
    except UserError:
        return
    assert np.isfinite(NetworkPolicy(checkpoint, "the policy").step(PICTURE)).all()


@given(st.binary(max_size=200), st.sampled_from([b"", b"[" * 100_000, b'{"a":' * 50_000]))
def test_random_bytes_are_refused(content: bytes, nested: bytes) -> None:
    for blob in (content, len(nested + content).to_bytes(8, "little") + nested + content):
        with pytest.raises(UserError):
            checkpoint_from_bytes(blob, "it")
