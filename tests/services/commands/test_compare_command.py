"""`vmdnn compare` trains and tests VMDNN and other networks, and prints their results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from learner.checkpoint import policy_file
from learner.tutoring.store import TutoringStore
from proto.body import ARM, FOCUS, NECK
from proto.config import load_config
from services.cli import main
from services.trials.comparison import CONTENDERS

QUICK = (
    "--set learner.pretraining.epochs=1 --set learner.epochs=2 --set learner.warmup_epochs=1"
    " --set comparison.cnn_lstm.together_epochs=1 --set comparison.cnn_lstm.epochs=1"
    " --set comparison.feed_forward.together_epochs=1 --set comparison.feed_forward.epochs=1"
    " --seeds 1 --trials 1 --workers 1"
)


def compare(recordings: Path, work: Path, words: str = "") -> int:
    return main(f"compare --data {recordings} --work {work} {QUICK} {words}".split())


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_networks_are_trained_tested_and_compared_and_nothing_is_repeated(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(recordings, tmp_path, "--json") == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    found = {each["name"]: each for each in result["contenders"]}
    assert list(found) == list(CONTENDERS)
    for name, each in found.items():
        assert each["trials"] == 1
        assert each["weights"] == pytest.approx(found["vmdnn"]["weights"], rel=0.05)
        assert each["training_s"] > 0
        assert len(each["against_vmdnn"]) == (0 if name == "vmdnn" else 3)
    kept = everything(tmp_path)

    assert compare(recordings, tmp_path) == 0
    table = capsys.readouterr().out
    assert all(name in table for name in CONTENDERS)
    assert everything(tmp_path) == kept

    network = load_config(tmp_path / "one-time-constant_seed1" / "config.yaml").network
    assert {network.mstnn_fast.tau, network.pfc.tau, network.mtrnn_fast.tau} == {10.0}

    rival = policy_file(tmp_path / "cnn-lstm_seed1", 1)
    assert main(f"evaluate --policy {rival} --trials 1 --json --workers 1".split()) == 0
    assert json.loads(capsys.readouterr().out)["trials"] == 1

    theirs, ours = TutoringStore(recordings), TutoringStore(tmp_path / "fixed-gaze_tutoring")
    assert ours.ids == theirs.ids
    for name in ours.ids:
        still, moving = ours.load(name), theirs.load(name)
        assert still is not None
        assert moving is not None
        np.testing.assert_array_equal(still.actions[:, ARM], moving.actions[:, ARM])
        assert not np.ptp(still.targets[:, np.r_[NECK, FOCUS]], axis=0).any()


def test_sequences_that_cannot_be_repeated_are_refused(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = "--only fixed-gaze --set tutor.noise_deg=2"
    assert compare(recordings, tmp_path, other) == 2
    assert "tutor.noise_deg = 1.0, not 2.0" in capsys.readouterr().err
