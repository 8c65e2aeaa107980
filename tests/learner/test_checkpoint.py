from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    CheckpointMetadata,
    CodeRanges,
    check_same_network,
    checkpoint_bytes,
    checkpoint_from_bytes,
    load_checkpoint,
    save_checkpoint,
)
from learner.network.subnets import parameter_shapes
from learner.network_policy import NetworkPolicy
from proto.config import NetworkConfig, SubnetConfig
from proto.errors import UserError
from proto.metrics import Stage


@pytest.fixture
def checkpoint() -> Checkpoint:
    network = NetworkConfig()
    random = np.random.default_rng(1)
    metadata = CheckpointMetadata(
        run="test",
        version=3,
        stage=Stage.COUPLED,
        epoch=70,
        loss=0.125,
        config_digest="c0ffee",
        network=network,
        code=CodeRanges(minima=tuple(np.arange(11) / 3), maxima=tuple(np.arange(11) + 0.1)),
    )
    tensors = {
        NETWORK_PREFIX + name: random.normal(size=shape).astype(np.float32)
        for name, shape in parameter_shapes(network).items()
    }
    return Checkpoint(metadata, tensors)


def test_a_saved_checkpoint_is_read_back_unchanged(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "deep" / "a.safetensors"
    save_checkpoint(path, checkpoint)
    loaded = load_checkpoint(path)
    assert loaded.metadata == checkpoint.metadata
    assert loaded.tensors.keys() == checkpoint.tensors.keys()
    for name, tensor in checkpoint.tensors.items():
        np.testing.assert_array_equal(loaded.tensors[name], tensor)
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_write_keeps_the_old_checkpoint(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, checkpoint)
    before = path.read_bytes()
    unsaveable = Checkpoint(checkpoint.metadata, {"x": np.array(["text"])})
    with pytest.raises(Exception, match=r"(?i)type|dtype|str"):
        save_checkpoint(path, unsaveable)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.safetensors cannot be read: No such file"):
        load_checkpoint(tmp_path / "none.safetensors")


@pytest.mark.parametrize("cut", [0, 5, 100, -1000])
def test_damaged_bytes(checkpoint: Checkpoint, cut: int) -> None:
    blob = checkpoint_bytes(checkpoint)[:cut]
    with pytest.raises(UserError, match=r"the policy is not a checkpoint, or is damaged"):
        checkpoint_from_bytes(blob, "the policy")


def test_foreign_safetensors() -> None:
    blob = save({"x": np.zeros(3)})
    with pytest.raises(UserError, match=r"not of vmdnn"):
        checkpoint_from_bytes(blob, "it")


def test_metadata_of_another_format(checkpoint: Checkpoint) -> None:
    values = json.loads(checkpoint.metadata.model_dump_json()) | {"format": 3}
    blob = save(dict(checkpoint.tensors), {"vmdnn": json.dumps(values)})
    with pytest.raises(UserError, match=r"another version of vmdnn"):
        checkpoint_from_bytes(blob, "it")


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("network.pfc.bias", np.zeros(7, np.float32), r"pfc.bias has shape \(7,\), not \(20,\)"),
        ("network.more", np.zeros(7, np.float32), r"more has shape \(7,\), not None"),
        ("network.pfc.bias", np.zeros(20), r"pfc.bias is not all finite float32"),
        ("network.pfc.bias", np.full(20, np.nan, np.float32), r"not all finite float32"),
    ],
)
def test_tensors_that_do_not_fit(
    checkpoint: Checkpoint, name: str, tensor: np.ndarray, message: str
) -> None:
    wrong = Checkpoint(checkpoint.metadata, {**checkpoint.tensors, name: tensor})
    with pytest.raises(UserError, match=message):
        checkpoint_from_bytes(checkpoint_bytes(wrong), "it")


def with_image_size(checkpoint: Checkpoint, size: object) -> bytes:
    """The checkpoint as earlier versions wrote it, with an image size among the network's sizes."""
    metadata = checkpoint.metadata.model_dump(mode="json")
    metadata["format"] = 1
    metadata["network"]["image"] = size
    return save(dict(checkpoint.tensors), {"vmdnn": json.dumps(metadata)})


def test_an_image_size_in_older_checkpoints_must_be_the_robots(checkpoint: Checkpoint) -> None:
    older = checkpoint_from_bytes(with_image_size(checkpoint, [64, 48]), "it")
    assert older.metadata.network == checkpoint.metadata.network
    for size in ([48, 64], [32, 24], None, "64x48"):
        with pytest.raises(
            UserError, match=r"it is of a network for images of the size .* 64 x 48"
        ):
            checkpoint_from_bytes(with_image_size(checkpoint, size), "it")


def test_checkpoint_of_another_network_names_the_fields(checkpoint: Checkpoint) -> None:
    check_same_network(NetworkConfig(), checkpoint, "it")
    other = NetworkConfig(pfc=SubnetConfig(units=20, tau=30), code_margin=0.3)
    with pytest.raises(UserError) as caught:
        check_same_network(other, checkpoint, "checkpoint a.safetensors")
    message = str(caught.value)
    assert "network.pfc.tau: 150.0 in the checkpoint, 30.0 in the config" in message
    assert "network.code_margin: 0.2 in the checkpoint, 0.3 in the config" in message
    assert "mstnn" not in message
    assert "units" not in message


def test_a_policy_of_format_1_can_be_read() -> None:
    path = Path(__file__).parents[1] / "data" / "format1" / "policy.safetensors"
    metadata = load_checkpoint(path).metadata
    assert (metadata.format, metadata.version, metadata.task) == (1, 1, None)
    assert NetworkPolicy.from_file(path).step(np.zeros((48, 64), np.uint8)).shape == (11,)
