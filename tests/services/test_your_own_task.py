"""The task and all commands of docs/your-own-task.md work, from tutoring to the figure."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from learner.checkpoint import load_checkpoint
from proto.recordings.episodes import read_episode
from services.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "your-own-task.md").read_text()
QUICK = " --set learner.epochs=2 --set learner.warmup_epochs=1 --set learner.pretraining.epochs=1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the page's task, in which the page's commands are run."""
    folder = tmp_path_factory.mktemp("own")
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    (folder / "touch.py").write_text(code)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [entry for entry in sys.path if entry])
        yield folder
        sys.modules.pop("touch", None)


def run(command: str) -> None:
    program, *words = shlex.split(command)
    assert program == "vmdnn"
    assert main(words) == 0, command


def test_the_commands_of_the_page_work(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = re.findall(r"```sh\n(vmdnn inspect.*?)```", PAGE, flags=re.DOTALL)
    inspect, tutor, train, of_tutor, of_network, figure = block.strip().splitlines()
    run(inspect)
    described = capsys.readouterr().out
    assert all(word in described for word in ("box_y_m", "right, left", "reach", "right-only"))
    run(tutor.replace("--repeats 2", "--repeats 1 --workers 1"))
    assert len(list((folder / "tutored").glob("*.mcap"))) == 6
    run(train + QUICK)
    assert load_checkpoint(folder / "run/policies/000001.safetensors").metadata.task == (
        "touch:TouchBox"
    )
    capsys.readouterr()
    run(of_tutor.replace("--trials 10", "--trials 4 --workers 1 --json"))
    found = json.loads(capsys.readouterr().out)
    assert (found["task"], found["strict"]["successes"]) == ("touch:TouchBox", 4)
    run(of_network.replace("--trials 10", "--trials 2 --workers 1 --out rollouts"))
    run(figure)
    assert (folder / "failures.png").stat().st_size > 10_000


def test_its_recordings_contain_its_names(folder: Path) -> None:
    episode = read_episode(folder / "rollouts" / "trial0000.mcap")
    assert episode.task == "touch:TouchBox"
    assert episode.phase_names == ("look", "reach", "rest")
    assert episode.situation["place"] in {"right", "left"}
    assert set(episode.outcome.measures) == {"pushed_mm", "touched_at"}
    assert main(["replay", str(folder / "rollouts/trial0000.mcap"), "--out", "video.mp4"]) == 0


@pytest.mark.usefixtures("folder")
def test_a_choice_can_be_given_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = "evaluate --task touch:TouchBox --policy tutor --workers 1 --json --situation"
    assert main([*words.split(), "box_y_m=0.3,place=left"]) == 0
    assert json.loads(capsys.readouterr().out)["trials"] == 1
    assert main([*words.split(), "box_y_m=0.3,place=middle"]) == 2
    assert "place = 'middle' is none of right, left" in capsys.readouterr().err


def test_a_network_of_another_task_is_refused_with_both_names(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = str(folder / "run/policies/000001.safetensors")
    assert main(["evaluate", "--task", "experiment1", "--policy", policy, "--trials", "1"]) == 2
    error = capsys.readouterr().err
    assert "trained for the task 'touch:TouchBox' and cannot play 'experiment1'" in error


def test_sequences_of_another_task_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(shlex.split(f"train --data {folder}/tutored --out other {QUICK}")) == 2
    assert "shows the task 'touch:TouchBox', not 'experiment1'" in capsys.readouterr().err
