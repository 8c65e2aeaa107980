"""Rollouts in a figure are told apart by what differs between them."""

from __future__ import annotations

from collections.abc import Callable

from proto.episode import Episode
from services.figures.rollouts import distinctions, wrapped

SITUATION = {"indicated_x_m": "-0.15", "indicated_kind": "laying", "indicated_yaw_deg": 2.5}


def test_values_that_differ_are_named(make_episode: Callable[..., Episode]) -> None:
    changed = {**SITUATION, "indicated_kind": "standing", "indicated_yaw_deg": -10.0}
    episodes = [make_episode(situation=each) for each in (SITUATION, changed)]
    assert distinctions(episodes) == [
        ["indicated kind laying", "indicated yaw 2.5°"],
        ["indicated kind standing", "indicated yaw -10°"],
    ]


def test_a_single_rollout_is_described_whole(make_episode: Callable[..., Episode]) -> None:
    (words,) = distinctions([make_episode(situation=SITUATION)])
    assert words == ["indicated X -0.15 m", "indicated kind laying", "indicated yaw 2.5°"]


def test_policies_are_named_if_they_differ(make_episode: Callable[..., Episode]) -> None:
    episodes = [make_episode(policy="run", policy_version=version) for version in (3, 12)]
    assert distinctions(episodes) == [["run version 3"], ["run version 12"]]


def test_a_long_list_is_broken_between_its_texts() -> None:
    words = ["indicated kind laying", "other kind laying", "take 3"]
    assert wrapped(words, 100) == "indicated kind laying, other kind laying, take 3"
    assert wrapped(words, 30) == "indicated kind laying,\nother kind laying, take 3"
    assert max(map(len, wrapped(words, 27).splitlines())) <= 27
