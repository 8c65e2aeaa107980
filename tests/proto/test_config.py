"""Every value of a config is checked, errors are explained, saved configs are read unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from proto.config import Config, RunConfig, load_config
from proto.errors import UserError
from services.cli import main


def written(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("learner: {ratee: 1}", "learner.ratee"),
        ("teacher: {rate: 1}", "teacher"),
        ("learner: {rate: fast}", "learner.rate"),
        ("learner: {rate: .nan}", "learner.rate"),
        ("learner: {epochs: 0}", "learner.epochs"),
        ("run: {name: ../elsewhere}", "run.name"),
        ("simulator: {control_period_s: 0.1, physics_period_s: 0.03}", "whole multiple"),
        ("done: {trials: 53}", "done.trials"),
        ("hub: {endpoint: 'localhost:7447'}", "hub.endpoint"),
        ("evaluator: {seed: 1073741824}", "evaluator.seed"),  # that may be practised, and corrected
        (
            "{actor: {practice: false}, learner: {corrections: {rounds: 1}}}",
            "failures needs actor.practice",
        ),
        ("- a list", "expected `section: ...` lines"),
        ("learner: {rate", "cannot be read"),
        ("learner: {epochs: yes}", "learner.epochs"),
        ("learner: {epochs: true}", "learner.epochs"),
        ("learner: {epochs: '5'}", "learner.epochs"),
        ("learner: {epochs: 5.0}", "learner.epochs"),
        ("learner: {rate: true}", "learner.rate"),
        ("actor: {practice: no}", "actor.practice"),
        ("learner: {rate: 1, rate: 2}", "the key 'rate' stands twice"),
        ("run: {seed: 1}\ntutor:\nrun: {seed: 2}", "in line 1 and in line 3"),
        ("{learner: {epoch: 1}}", "did you mean learner.epochs?"),
        ("tutor: {repeats: 1001}", "must not exceed 1000: each repeat needs one of the 1000 seeds"),
        ("learner: {pretraining: {repeats: 1001}}", "must not exceed 1000"),
        ("run: {folder: ~nobody-of-this-name/runs}", "~ cannot be expanded"),
    ],
)
def test_the_problem_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    path = written(tmp_path, text)
    assert main(["doctor", "--config", str(path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert str(path) in error


def test_a_missing_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = tmp_path / "none.yaml"
    assert main(["doctor", "--config", str(missing)]) == 2
    assert f"{missing} does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("override", ["learner.rate", "=1", "learner.rate.more=1", "run={"])
def test_an_override_that_cannot_be_applied_is_named(tmp_path: Path, override: str) -> None:
    with pytest.raises(UserError) as error:
        load_config(written(tmp_path, "learner: {rate: 0.1}"), [override])
    assert override in str(error.value)


def test_an_override_wins_over_the_file(tmp_path: Path) -> None:
    path = written(tmp_path, "learner: {rate: 0.1, threads: 2}")
    learner = load_config(path, ["learner.rate=0.2", "learner.rate=0.3"]).learner
    assert (learner.rate, learner.threads) == (0.3, 2)


@given(
    rate=st.floats(1e-9, 1e9),
    seed=st.integers(0, 2**32 - 1),
    cases=st.none() | st.lists(st.integers(0, 44), min_size=1).map(tuple),
)
def test_a_saved_config_is_read_back_unchanged(
    tmp_path_factory: pytest.TempPathFactory,
    rate: float,
    seed: int,
    cases: tuple[int, ...] | None,
) -> None:
    config = Config.model_validate(
        {"run": {"seed": seed}, "learner": {"rate": rate, "cases": cases}}
    )
    path = tmp_path_factory.mktemp("saved") / "config.yaml"
    config.save(path)
    again = load_config(path)
    assert again == config
    assert again.digest() == config.digest()


def test_the_digest_ignores_the_hub_and_the_folder() -> None:
    digest = Config().digest()
    assert Config(run=RunConfig(folder=Path("elsewhere"))).digest() == digest
    assert Config(run=RunConfig(seed=2)).digest() != digest


@pytest.mark.parametrize("name", ["2024", "007", "on", "1e3", "v1.10", "2024-01-01", "1_000"])
def test_a_name_is_kept_as_written(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, f"run: {{name: {name}}}")
    config = load_config(path)
    assert config.run.name == name
    assert load_config(None, [f"run.name={name}"]) == config
    config.save(path)
    assert load_config(path) == config


def test_numbers_are_read_as_in_yaml_1_2(tmp_path: Path) -> None:
    text = "learner: {rate: 1e-3, epochs: 010, warmup_epochs: 0x10}\nsimulator: {backend: 12:30:45}"
    config = load_config(written(tmp_path, text), ["learner.batch=010", "learner.clip_norm=2E-1"])
    learner = config.learner
    assert (learner.rate, learner.epochs, learner.warmup_epochs) == (1e-3, 10, 16)
    assert (learner.batch, learner.clip_norm) == (10, 0.2)
    assert config.simulator.backend == "12:30:45"


def test_an_empty_section_means_its_defaults(tmp_path: Path) -> None:
    text = "learner:\nnetwork:\n  pfc:\n  mtrnn_slow: {tau: 12}\nrun:\n"
    config = load_config(written(tmp_path, text), ["tutor=", "run.seed=3"])
    assert config.learner == Config().learner
    assert config.network.pfc == Config().network.pfc
    assert (config.network.mtrnn_slow.units, config.network.mtrnn_slow.tau) == (30, 12)
    assert config.run == RunConfig(seed=3)
    assert load_config(written(tmp_path, "")) == Config()


def test_a_folder_may_start_at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    assert load_config(None, ["run.folder=~/runs"]).run.folder == Path("/home/somebody/runs")


@pytest.mark.parametrize("seed", ["-1", "4294967296", "one", "1.0", "\u0663"])
@pytest.mark.parametrize("words", ["evaluate --policy=tutor --seed", "tutor --out=x --seed"])
def test_an_invalid_seed_is_refused(
    capsys: pytest.CaptureFixture[str], words: str, seed: str
) -> None:
    *command, option = words.split()
    with pytest.raises(SystemExit) as ended:
        main([*command, f"{option}={seed}"])
    assert ended.value.code == 2
    assert "is not an integer from 0 to 4294967295" in capsys.readouterr().err


def test_keys_that_earlier_versions_saved_are_ignored_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = (
        "network: {image: [64, 48]}\nlearner: {epochs: 7, pretraining: {labels: {object_y_m: 3}}}"
    )
    config = load_config(written(tmp_path, text))
    assert config.learner.epochs == 7
    assert "network.image has no effect any more" in caplog.text
    assert "learner.pretraining.labels has no effect any more" in caplog.text
