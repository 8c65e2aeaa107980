"""The commands `vmdnn train` and `vmdnn inspect`."""

from __future__ import annotations

import json
import random
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from processes import PATIENCE_S, eventually, run_vmdnn, vmdnn
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from learner.checkpoint import load_checkpoint, policy_file, pretraining_file, training_file
from learner.training.trainer import Trainer
from learner.tutoring.store import TutoringStore
from proto.episode import Episode
from services.cli import main

CONFIG = {
    "network": {
        "mstnn_fast": {"maps": 2, "kernel": [14, 10], "stride": 2, "tau": 2},
        "mstnn_slow": {"maps": 3, "kernel": [8, 6], "stride": 2, "tau": 5},
        "pfc": {"units": 8, "tau": 20},
    },
    "learner": {
        "epochs": 6,
        "checkpoint_every_epochs": 4,
        "publish_every_epochs": 2,
        "pretraining": {"epochs": 2},
    },
}


@pytest.fixture
def data(tmp_path: Path, make_episode: Callable[..., Episode]) -> Path:
    store = TutoringStore(tmp_path / "data")
    for steps in (9, 10, 11):
        store.add(
            make_episode(
                steps,
                id=f"of-{steps}",
                situation={
                    "obstacle_x_m": -0.27,
                    "object_y_m": steps / 40,
                    "object_yaw_deg": 5.0 * steps,
                },
            )
        )
    return store.folder


@pytest.fixture
def train(tmp_path: Path, data: Path) -> Callable[..., int]:
    config = tmp_path / "small.yaml"
    config.write_text(yaml.safe_dump(CONFIG))

    def run(out: Path, *more: str) -> int:
        words = ["train", "--data", str(data), "--config", str(config), "--out", str(out)]
        return main([*words, *more])

    return run


def test_it_writes_policies_a_checkpoint_and_the_config(
    tmp_path: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out, "--set", "learner.batch=2") == 0
    versions = [load_checkpoint(policy_file(out, n)).metadata for n in (1, 2, 3)]
    assert [(m.version, m.epoch) for m in versions] == [(1, 2), (2, 4), (3, 6)]
    assert load_checkpoint(training_file(out)).metadata.epoch == 6
    assert yaml.safe_load((out / "config.yaml").read_text())["learner"]["batch"] == 2
    printed = capsys.readouterr().out
    assert "coupled epoch 6/6" in printed
    assert f"policy 3: {policy_file(out, 3)}" in printed

    assert train(out) == 0
    assert "is trained already" in capsys.readouterr().out


def test_it_keeps_a_history(
    tmp_path: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out) == 0
    capsys.readouterr()
    assert main(["figure", "training", str(out), "--json", "--out", str(tmp_path / "f.png")]) == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert [stage["loss"][-1][0] for stage in stages.values()] == [2, 6]  # the last epochs
    found = EventAccumulator(str(out / "tensorboard"), size_guidance={"histograms": 0})
    found.Reload()
    tags = found.Tags()
    assert {"loss/pretraining", "loss/coupled", "learning_rate/coupled"} <= set(tags["scalars"])
    assert len(tags["histograms"]) > 10
    for name in tags["histograms"]:
        assert [event.step for event in found.Histograms(name)] == [1, 2, 3], name


def test_the_representation_of_the_vision_can_be_inspected(
    tmp_path: Path, data: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out) == 0
    words = ["inspect", "vision", "--data", str(data), "--test", str(data)]
    assert main([*words, str(pretraining_file(out))]) == 0
    printed = capsys.readouterr().out
    assert "The classifier, 3 sequences" in printed
    assert "5 reach above object" in printed

    assert main([*words, str(policy_file(out, 3)), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["sequences"], found["classifier"]) == (3, [])
    assert {score["value"] for score in found["regression"]} == {"object_y_m", "object_yaw_deg"}


@pytest.mark.parametrize("pressed_at", [1, 5])
def test_ctrl_c_saves_and_the_same_command_continues_exactly(
    tmp_path: Path,
    train: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    pressed_at: int,
) -> None:
    """Pressed in the middle of pre-training, and of coupled training."""
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert train(undisturbed) == 0

    epoch, epochs = Trainer.epoch, iter(range(1, 100))

    def epoch_and_ctrl_c(trainer: Trainer) -> float:
        if next(epochs) == pressed_at:
            signal.raise_signal(signal.SIGINT)
        return epoch(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "epoch", epoch_and_ctrl_c)
        assert train(disturbed) == 130
    assert "the same command continues" in capsys.readouterr().out
    assert train(disturbed) == 0
    for path in (training_file, lambda run: policy_file(run, 3)):
        assert path(disturbed).read_bytes() == path(undisturbed).read_bytes()


KILLS = 10


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_training_that_is_killed_ten_times_ends_bit_for_bit_the_same(
    tmp_path: Path, data: Path
) -> None:
    config, chance = tmp_path / "long.yaml", random.Random(1)
    long = {"epochs": 3000, "publish_every_epochs": 250, "checkpoint_every_epochs": 20}
    config.write_text(yaml.safe_dump({**CONFIG, "learner": {**CONFIG["learner"], **long}}))
    disturbed, undisturbed = tmp_path / "disturbed", tmp_path / "undisturbed"
    words = ("train", "--data", data, "--config", config, "--out")

    def saved(since: int) -> bool:
        return training_file(disturbed).exists() and saved_at() > since

    def saved_at() -> int:
        return training_file(disturbed).stat().st_mtime_ns

    before = 0
    for _ in range(KILLS):
        with vmdnn(*words, disturbed) as process:
            eventually(partial(saved, before), "a new checkpoint")
            with suppress(subprocess.TimeoutExpired):
                process.wait(chance.uniform(0.0, 0.5))
            assert process.poll() is None, "it is killed before it has ended"
        before = saved_at()
    assert load_checkpoint(training_file(disturbed)).metadata.epoch < 3000
    for folder in (disturbed, undisturbed):
        with vmdnn(*words, folder) as process:
            assert process.wait(300) == 0
    policies = [partial(policy_file, version=version) for version in range(1, 13)]
    for path in (training_file, pretraining_file, *policies):
        assert path(disturbed).read_bytes() == path(undisturbed).read_bytes()
    assert not list(disturbed.rglob("*.part"))


def test_a_second_ctrl_c_ends_at_once(
    tmp_path: Path, train: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def press_twice(_trainer: Trainer) -> float:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("still here")

    monkeypatch.setattr(Trainer, "epoch", press_twice)
    assert train(tmp_path / "run") == 130


def test_a_second_training_in_the_same_folder_is_refused(tmp_path: Path, data: Path) -> None:
    config, out = tmp_path / "long.yaml", tmp_path / "run"
    long = {"epochs": 10**6, "publish_every_epochs": 10**6, "checkpoint_every_epochs": 1}
    config.write_text(yaml.safe_dump({**CONFIG, "learner": {**CONFIG["learner"], **long}}))
    words = ("train", "--data", data, "--config", config, "--out", out)
    with vmdnn(*words) as first:
        eventually(lambda: training_file(out).exists(), "a checkpoint")
        second = run_vmdnn(*words, "--set", "learner.rate=0.5")
        assert second.returncode == 2
        assert f"another process trains in {out} already" in second.stderr
        assert first.poll() is None
        first.send_signal(signal.SIGINT)
        assert first.wait(PATIENCE_S) == 130
    assert yaml.safe_load((out / "config.yaml").read_text())["learner"]["rate"] != 0.5
    assert load_checkpoint(training_file(out)).metadata.epoch > 0


def complaint_of(status: int, capsys: pytest.CaptureFixture[str]) -> str:
    assert status == 2
    return capsys.readouterr().err


def test_a_missing_or_empty_data_folder_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, empty, out = tmp_path / "missing", tmp_path / "empty", tmp_path / "run"
    empty.mkdir()
    status = main(["train", "--data", str(missing), "--out", str(out)])
    assert "missing is no folder; record one with `vmdnn tutor" in complaint_of(status, capsys)
    status = main(["train", "--data", str(empty), "--out", str(out)])
    assert "empty holds no sequence" in complaint_of(status, capsys)
    assert not out.exists()


def test_data_without_readable_sequences_are_refused(
    tmp_path: Path, data: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    for path in data.iterdir():
        path.write_bytes(path.read_bytes()[:300])
    complaint = complaint_of(train(tmp_path / "run"), capsys)
    assert "none of the 3 sequences" in complaint
    assert "vmdnn recover" in complaint


def test_the_run_of_another_network_is_not_changed(
    tmp_path: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    complaint = complaint_of(train(out, "--set", "network.pfc.tau=30"), capsys)
    assert "network.pfc.tau: 20.0 in the checkpoint, 30.0 in the config" in complaint
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_inspect_network_prints_the_sizes_of_the_paper(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "network", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["mstnn_fast"] == {
        "name": "mstnn_fast",
        "symbol": "V_F",
        "shape": [3, 22, 18],
        "tau": 2,
        "kernel": [22, 14],
        "stride": 2,
        "weights": 3 * 22 * 14,
        "biases": 3,
    }
    assert rows["pfc"]["weights"] == 20 * (6 * 8 * 7) + 20 * 20 + 20 * 30
    assert rows["outputs"]["shape"] == [11, 10]

    assert main(["inspect", "network", "--set", "network.mtrnn_slow.units=31"]) == 0
    assert "mtrnn_slow" in capsys.readouterr().out


def test_inspect_checkpoint_prints_its_metadata(
    tmp_path: Path, train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run") == 0
    capsys.readouterr()
    assert main(["inspect", "checkpoint", str(policy_file(tmp_path / "run", 2)), "--json"]) == 0
    metadata = json.loads(capsys.readouterr().out)
    assert (metadata["version"], metadata["stage"], metadata["epoch"]) == (2, "coupled", 4)
    assert np.isfinite(metadata["loss"])
    assert metadata["network"]["pfc"] == {"units": 8, "tau": 20}
    assert len(metadata["code"]["minima"]) == 11

    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(b"not a checkpoint")
    complaint = complaint_of(main(["inspect", "checkpoint", str(foreign)]), capsys)
    assert "foreign.safetensors is not a checkpoint, or is damaged" in complaint
