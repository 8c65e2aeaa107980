"""The command line itself."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from proto.config import Config, load_config
from proto.config_keys import config_keys
from services.cli import COMMANDS, main
from services.commands.config import markdown

ROOT = Path(__file__).parents[2]


def test_it_prints_its_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"vmdnn {version('vmdnn')}\n"


def test_a_process_that_does_not_learn_starts_without_what_it_never_uses() -> None:
    """PyTorch alone takes two seconds to import, and a run starts many processes at once."""
    roles = ("hub", "actor", "evaluator", "recorder", "dashboard")
    script = (
        f"import sys, {', '.join(COMMANDS[role][0] for role in roles)}\n"
        "print(sorted({'torch', 'trimesh', 'sapien', 'mujoco'} & sys.modules.keys()))"
    )
    imported = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert imported.stdout == b"[]\n"


def test_a_folder_does_not_hide_a_built_in_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "smoke").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["inspect", "network", "--config", "smoke"]) == 0
    assert "mtrnn" in capsys.readouterr().out.lower()


def test_every_key_has_a_meaning_and_stands_in_the_document() -> None:
    keys = config_keys()
    assert [key.name for key in keys if not key.meaning] == []
    values = Config().model_dump(mode="json")
    named = {key.name for key in keys if not key.section and "[]" not in key.name}

    def leaves(values: dict[str, object], prefix: str = "") -> set[str]:
        found = set()
        for name, value in values.items():
            if f"{prefix}{name}" not in named and isinstance(value, dict):
                found |= leaves(value, f"{prefix}{name}.")
            else:
                found.add(f"{prefix}{name}")
        return found

    assert named == leaves(values)
    assert (ROOT / "docs" / "config.md").read_text() == markdown(), (
        "write it anew: vmdnn config --markdown > docs/config.md"
    )


def test_config_prints_values_defaults_and_units(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--config", "smoke", "--only", "learner."]) == 0
    printed = capsys.readouterr().out
    assert "learner.epochs: 60 epochs   (default 400)" in printed
    assert "learner.lease_s: 60.0 s\n    a case whose sequence" in printed
    assert "hub.endpoint" not in printed
    assert main(["config", "--config", "smoke", "--json"]) == 0
    listed = {each["name"]: each for each in json.loads(capsys.readouterr().out)}
    smoke = load_config(ROOT / "deploy" / "config" / "smoke.yaml")
    assert listed["tutor.repeats"]["value"] == smoke.tutor.repeats
    assert listed["tutor.repeats"]["default"] == Config().tutor.repeats


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("epochs", "learner.epochs"),
        ("learner.epoch", "learner.epochs"),
        ("network.pcf.tau", "network.pfc"),
        ("lerner.rate", "learner"),
    ],
)
def test_a_key_that_does_not_exist_is_answered_with_a_similar_one(
    capsys: pytest.CaptureFixture[str], key: str, meant: str
) -> None:
    assert main(["config", "--set", f"{key}=1"]) == 2
    assert f"did you mean {meant}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "meant"),
    [("rollout runs/smoke", "rollouts"), ("evalute", "evaluate"), ("inspect tsk", "task")],
)
def test_a_word_that_does_not_exist_is_answered_with_a_similar_one(
    capsys: pytest.CaptureFixture[str], words: str, meant: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_without_a_similar_word_all_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["xyzzy"])
    error = capsys.readouterr().err
    assert all(name in error for name in COMMANDS)
    assert "did you mean" not in error


def test_keys_that_do_not_exist_are_not_shown_as_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["config", "--only", "lerner."]) == 2
    assert "no key contains 'lerner.'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["watch", "control actor pause", "actor"])
def test_a_host_alone_is_no_endpoint(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--connect", "localhost"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert "write tcp/HOST:PORT, such as tcp/localhost:7447" in error


def test_completion_knows_every_command(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "vmdnn"
    script.write_text(capsys.readouterr().out)
    typed = "COMP_WORDS=(vmdnn eval); COMP_CWORD=1; _shtab_vmdnn; echo ${COMPREPLY[@]}"
    found = subprocess.run(
        ["bash", "-c", f"source {script}; {typed}"], capture_output=True, text=True, check=True
    )
    assert {"evaluate", "evaluator"} <= set(found.stdout.split())
    assert set(COMMANDS) <= set(re.findall(r"[\w-]+", script.read_text()))
