from __future__ import annotations

import pytest

from learner.checkpoint import load_checkpoint
from learner.network_policy import NetworkPolicy
from learner.pretrained import PREFIX, checkpoint_path, pretrained_names
from proto.errors import UserError


def test_the_pretrained_networks_can_act() -> None:
    assert f"{PREFIX}experiment1" in pretrained_names()
    for name in pretrained_names():
        checkpoint = load_checkpoint(name)
        NetworkPolicy(checkpoint, name).begin({}, 0)
        assert checkpoint.metadata.training is None  # nothing but the network
        assert checkpoint_path(name).stat().st_size < 200_000


def test_a_wrong_name_is_refused_with_a_list_of_names() -> None:
    with pytest.raises(UserError, match=r"no policy pretrained:dance.*pretrained:experiment1"):
        load_checkpoint(f"{PREFIX}dance")


@pytest.mark.parametrize("name", pretrained_names())
def test_each_says_what_it_was_trained_for(name: str) -> None:
    metadata = load_checkpoint(name).metadata
    assert metadata.format == 2
    assert metadata.task == name.removeprefix("pretrained:").partition("-")[0]
    assert metadata.backend == "sapien"
