"""The policies at the end of each round are tested and drawn; each trial is played once."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.tasks.registry import make_pretraining_task
from learner.checkpoint import policy_file
from learner.training.trainer import Trainer
from learner.training.training_run import policy_is_due, write_policy
from learner.training.vmdnn_recipe import VMDNNRecipe
from learner.tutoring.store import TutoringStore
from proto.config import Config
from proto.episode import Kind
from services.cli import main
from services.trials.round_trials import open_run


@pytest.fixture
def run(recordings: Path, tmp_path: Path) -> Path:
    """A run with two rounds of corrections, which hardly learned anything."""
    folder = tmp_path / "run"
    corrections = {"rounds": 2, "choose": "random", "epochs": 1}
    learner = {
        "epochs": 3, "warmup_epochs": 1, "publish_every_epochs": 2,
        "pretraining": {"epochs": 0}, "corrections": corrections,
    }  # fmt: skip
    config = Config.model_validate({"learner": learner, "simulator": {"render": False}})
    shutil.copytree(recordings, folder / "tutoring")
    config.save(folder / "config.yaml")
    store = TutoringStore(folder / "tutoring")
    shown = store.load(store.ids[0])
    assert shown is not None
    trainer = Trainer(VMDNNRecipe(config, make_pretraining_task(config).questions), store, rounds=2)
    while not trainer.finished:
        if trainer.round_begins:
            situation = {**shown.situation, "object_y_m": 0.2 + 0.01 * trainer.round}
            given = {"id": f"corrected-{trainer.round}", "situation": situation}
            store.add(replace(shown, kind=Kind.CORRECTION, **given))  # type: ignore[arg-type]
        trainer.epoch()
        if policy_is_due(trainer):
            write_policy(trainer, folder)
    return folder


def test_the_policy_at_the_end_of_each_round_is_tested_once(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "corrections.png"
    command = f"figure corrections {run} --workers 1 --seed 7 --json --out {out}"
    assert main([*command.split(), "--trials", "1"]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    (only,) = result["runs"]
    assert (only["run"], only["choose"]) == (str(run), "random")
    policies = [
        (each["round"], each["policy_version"], each["cases"], each["sequences"], each["trials"])
        for each in only["policies"]
    ]
    assert policies == [(0, 2, 2, 4, 1), (1, 3, 3, 5, 1), (2, 4, 4, 6, 1)]

    book = run / "evaluation" / "round_trials.jsonl"
    first = book.read_bytes()
    assert main([*command.split(), "--trials", "1"]) == 0
    assert json.loads(capsys.readouterr().out) == result
    assert book.read_bytes() == first
    assert main([*command.split(), "--trials", "2"]) == 0
    assert book.read_bytes().startswith(first)
    assert len(book.read_bytes().splitlines()) == 6

    # another training of the same name has trials of its own
    before = open_run(run).policies[0].logged()
    shutil.copy(policy_file(run, 3), policy_file(run, 2))
    assert open_run(run).policies[0].logged() != before


def test_a_run_that_cannot_be_drawn_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"figure corrections {run} --out {tmp_path / 'f.png'}"
    assert main([*command.split(), "--seed", str(2**30)]) == 2
    assert f"--seed {2**30}" in capsys.readouterr().err
    shutil.rmtree(run / "policies")
    assert main(command.split()) == 2
    assert f"{run} has no policy that was published at epoch 3" in capsys.readouterr().err
