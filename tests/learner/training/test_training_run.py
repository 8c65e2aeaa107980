"""A training goes on from the checkpoint before if the newest is damaged or gone."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from actors.tasks.registry import make_task
from learner.checkpoint import load_checkpoint, policy_file, previous_training_file, training_file
from learner.policy_digests import DIGESTS
from learner.training.trainer import Trainer
from learner.training.training_run import open_training, run_training, save_training, write_policy
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.config import Config, TaskConfig
from proto.errors import UserError

QUESTIONS = make_task(TaskConfig()).questions


@pytest.fixture
def store(tmp_path: Path, bar_episodes: Callable[..., list]) -> TutoringStore:
    store = TutoringStore(tmp_path / "tutoring")
    for episode in bar_episodes():
        store.add(episode)
    return store


@pytest.fixture
def begin(
    tmp_path: Path, store: TutoringStore, small_config: Callable[..., Config]
) -> Callable[[], Trainer]:
    """Return a function that opens the training of a run of 6 epochs, with 3 policies."""
    config = small_config(
        0, epochs=6, publish_every_epochs=2, checkpoint_every_epochs=2, warmup_epochs=0
    )
    return lambda: open_training(VMDNNRecipe(config, QUESTIONS), tmp_path, store)


def train(trainer: Trainer, folder: Path, epochs: int) -> None:
    """Train for so many epochs, without the checkpoint at the end of a training that stops."""
    for _ in range(epochs):
        trainer.epoch()
        if trainer.epochs_done % 2 == 0:
            write_policy(trainer, folder)
            save_training(trainer, folder)


def policies(folder: Path) -> dict[str, bytes]:
    files = policy_file(folder, 0).parent.glob("*.safetensors")
    return {path.name: path.read_bytes() for path in files}


@pytest.mark.parametrize("fault", ["damaged", "empty", "gone"])
def test_the_checkpoint_before_is_used_and_policies_stay(
    tmp_path: Path,
    begin: Callable[[], Trainer],
    fault: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    train(begin(), tmp_path, 4)
    newest, before = training_file(tmp_path), policies(tmp_path)
    if fault == "gone":
        newest.unlink()
    else:
        newest.write_bytes(newest.read_bytes()[:1000] if fault == "damaged" else b"")
    trainer = begin()
    assert (trainer.epochs_done, trainer.version) == (2, 1)
    assert "The training goes on from the checkpoint before" in caplog.text
    assert newest.with_suffix(".damaged").exists() == (fault != "gone")
    run_training(trainer, tmp_path, lambda _: True)
    after = policies(tmp_path)
    assert before.items() <= after.items(), "what was published stays, bit for bit"
    assert sorted(after) == [f"{version:06d}.safetensors" for version in (1, 2, 3)]
    assert load_checkpoint(newest).metadata.version == 3
    folder = policy_file(tmp_path, 0).parent
    subprocess.run(("sha256sum", "--check", "--strict", DIGESTS), cwd=folder, check=True)
    assert (folder / DIGESTS).read_text().count("\n") == 3


def test_another_policy_of_the_same_version_is_not_overwritten(
    tmp_path: Path, begin: Callable[[], Trainer], caplog: pytest.LogCaptureFixture
) -> None:
    trainer = begin()
    train(trainer, tmp_path, 2)
    other = policy_file(tmp_path, 2)
    other.write_bytes(b"of another training")
    train(trainer, tmp_path, 2)
    assert other.read_bytes() == b"of another training"
    assert trainer.version == 3
    assert load_checkpoint(policy_file(tmp_path, 3)).metadata.version == 3
    assert "policy 2 exists already" in caplog.text


def test_without_any_good_checkpoint_the_message_names_the_way_out(
    tmp_path: Path, begin: Callable[[], Trainer]
) -> None:
    train(begin(), tmp_path, 4)
    for path in (training_file(tmp_path), previous_training_file(tmp_path)):
        path.write_bytes(b"")
    with pytest.raises(UserError, match=r"move the folder .*checkpoints away"):
        begin()
