"""Every built-in configuration is valid, and the sequences it waits for can be tutored."""

from __future__ import annotations

from pathlib import Path

import pytest

from actors.tasks.registry import make_pretraining_task, make_task
from proto.config import Config, load_config

CONFIGURATIONS = sorted((Path(__file__).parents[2] / "deploy" / "config").glob("*.yaml"))

each_configuration = pytest.mark.parametrize("path", CONFIGURATIONS, ids=lambda path: path.stem)


def policy_versions(config: Config) -> int:
    """Number of policy versions that a whole training publishes."""
    learner = config.learner
    return -(-learner.epochs // learner.publish_every_epochs) + learner.corrections.rounds


@each_configuration
def test_its_run_has_its_name(path: Path) -> None:
    assert load_config(path).run.name == path.stem


@each_configuration
def test_its_tasks_can_be_made_and_accept_their_situations(path: Path) -> None:
    config = load_config(path)
    for task in (make_task(config.task), make_pretraining_task(config)):
        for situation in (*task.tutored(), *(task.sample(seed) for seed in range(20))):
            task.check(situation)


@each_configuration
def test_training_starts_with_all_clean_and_noisy_sequences(path: Path) -> None:
    config = load_config(path)
    cases = config.learner.cases or range(len(make_task(config.task).tutored()))
    assert config.learner.start_sequences == len(cases) * config.tutor.repeats


@each_configuration
def test_its_run_can_be_done(path: Path) -> None:
    config = load_config(path)
    assert config.done.policy_versions == policy_versions(config)
    assert (config.done.trials or 0) <= config.evaluator.trials_per_policy


def test_the_papers_recipe_for_experiment_2_is_that_of_experiment_1() -> None:
    """Only task, number of epochs and number of sequences differ; section 4.3 of the paper."""
    first, second = (load_config(path) for path in CONFIGURATIONS if "paper" in path.stem)
    same = ("rate", "schedule", "warmup_epochs", "clip_norm", "vision_noise", "interpolation")
    for name in (*same, "initial_range", "initial_range_pfc_input"):
        assert getattr(second.learner, name) == getattr(first.learner, name), name
    assert second.learner.epochs == 37000
    assert second.learner.batch == second.learner.start_sequences == 8
    assert second.network == first.network
