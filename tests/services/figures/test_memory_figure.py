"""How long a network holds what it saw, measured on frozen pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.tasks.contract import Task
from actors.tasks.registry import make_task
from learner.checkpoint import (
    Checkpoint,
    CheckpointMetadata,
    CodeRanges,
    load_checkpoint,
    save_checkpoint,
)
from learner.network.subnets import parameter_shapes
from learner.network_policy import NetworkPolicy
from proto.body import ACTION_NAMES, ACTION_VALUES
from proto.config import NetworkConfig, TaskConfig
from proto.episode import Episode, Floats, Image
from proto.errors import UserError
from proto.metrics import Stage
from proto.recordings.episodes import write_episode
from proto.variables import Situation
from services.cli import main
from services.figures.memory import (
    MemoryTask,
    Network,
    draw,
    recall_of,
    retentions_of,
    table,
)

NECK_YAW = ACTION_NAMES.index("neck_yaw")
HELD = 58
"""Number of steps before the head turns to the object."""

MakeEpisode = Callable[..., Episode]


def experiment2(**options: object) -> Task:
    return make_task(TaskConfig.model_validate({"name": "experiment2", **options}))


TASK = experiment2()
MEMORY = MemoryTask.of(TASK)


def rollout_of(make_episode: MakeEpisode, task: Task, situation: Situation) -> Episode:
    """A rollout in a situation; what its pictures show does not matter."""
    episode = make_episode(
        len(task.phases),
        id=f"rollout{situation['indicated_x_m']}".replace(".", ""),
        task=task.name,
        situation=situation,
        phases=task.phases,
        phase_names=task.phase_names,
    )
    assert len(episode.images) == len(task.phases)
    return episode


@pytest.fixture
def rollouts(make_episode: MakeEpisode) -> list[Episode]:
    return [rollout_of(make_episode, TASK, situation) for situation in TASK.tutored()[:2]]


def random_checkpoint(path: Path, tau: float, task: str = "experiment2") -> Path:
    """A network with random weights that can act."""
    network = NetworkConfig.model_validate({"pfc": {"tau": tau}})
    random = np.random.default_rng(int(tau))
    tensors = {
        f"network.{name}": random.normal(0.0, 0.1, shape).astype(np.float32)
        for name, shape in parameter_shapes(network).items()
    }
    code = CodeRanges(
        minima=tuple(value.minimum for value in ACTION_VALUES),
        maxima=tuple(value.maximum for value in ACTION_VALUES),
    )
    metadata = CheckpointMetadata(
        run=f"tau{tau:g}",
        version=1,
        stage=Stage.COUPLED,
        epoch=1,
        loss=None,
        config_digest="",
        task=task,
        network=network,
        code=code,
    )
    save_checkpoint(path, Checkpoint(metadata, tensors))
    return path


@dataclass
class Forgetful:
    """A policy that tells the choice of a rollout until it has seen so many pictures."""

    forgets_after: int
    angle_deg: float
    name: str = "forgetful"
    version: int = 0
    looks: bool = True
    target: NDArray[np.float64] | None = None
    outputs: Floats | None = None
    seen: int = 0

    def begin(self, situation: Situation, seed: int) -> None:  # noqa: ARG002
        assert situation == {}, "a network must not be told the situation"
        self.seen = 0

    def step(self, image: Image) -> NDArray[np.float64]:  # noqa: ARG002
        self.seen += 1
        remembers = self.seen <= self.forgets_after
        action = np.zeros(len(ACTION_NAMES))
        action[NECK_YAW] = self.angle_deg if remembers else -self.angle_deg
        return action


def test_one_command_draws_a_line_for_each_time_constant(
    rollouts: list[Episode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / f"{number}.mcap" for number in range(len(rollouts))]
    for path, rollout in zip(files, rollouts, strict=True):
        write_episode(path, rollout)
    policies = [random_checkpoint(tmp_path / f"{tau}.safetensors", tau) for tau in (150, 30, 31)]
    save_checkpoint(tmp_path / "again.safetensors", load_checkpoint(policies[0]))
    policies.append(tmp_path / "again.safetensors")
    out = tmp_path / "memory.png"
    words = ["figure", "memory", "--out", str(out), "--steps", "12", "--json"]
    words += ["--policies", *map(str, policies), "--rollouts", *map(str, files)]
    assert main(words) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    found = json.loads(capsys.readouterr().out)
    assert (found["phase"], found["variable"]) == ("observe task space", "indicated_x_m")
    lines = found["time_constants"]
    assert [(line["tau"], line["trials"]) for line in lines] == [(30, 2), (31, 2), (150, 4)]
    assert {len(line[name]) for line in lines for name in ("right", "rate", "wilson95")} == {13}
    of_150 = lines[-1]["networks"]
    assert [each["run"] for each in of_150] == ["tau150", "tau150"]
    assert of_150[0]["right"] == of_150[1]["right"]
    assert lines[-1]["right"] == [2 * count for count in of_150[0]["right"]]


def test_without_frozen_steps_the_output_is_that_of_the_whole_episode(
    rollouts: list[Episode], tmp_path: Path
) -> None:
    policy = NetworkPolicy.from_file(random_checkpoint(tmp_path / "p.safetensors", 30))
    (cue, _), episode = map(MEMORY.cue_of, rollouts), rollouts[0]
    outputs = MEMORY.outputs(policy, cue, 7)
    frozen = np.concatenate(
        [episode.images[:HELD], np.repeat(episode.images[HELD - 1 : HELD], 7, 0)]
    )
    policy.begin(episode.situation, episode.seed)
    unfrozen = [policy.step(image)[NECK_YAW] for image in episode.images]
    policy.begin(episode.situation, episode.seed)
    wanted = [policy.step(image)[NECK_YAW] for image in frozen]
    assert outputs[0] == unfrozen[HELD - 1]
    assert outputs.tolist() == wanted[HELD - 1 :]
    assert outputs[1] != unfrozen[HELD]


@pytest.mark.parametrize("delay", [0, 40])
def test_a_cue_ends_before_the_head_turns_to_the_object(
    make_episode: MakeEpisode, delay: int
) -> None:
    """Whatever the delay of the rollouts, the task of the command may have none."""
    delayed = experiment2(delay_steps=delay)
    cue = MEMORY.cue_of(rollout_of(make_episode, delayed, TASK.tutored()[1]))
    assert (cue.choice, len(cue.pictures)) == ("0.07", HELD + delay)


def test_the_tutor_tells_the_choice_by_the_neck() -> None:
    """The values are those of the plans after the head has turned."""
    values: Mapping[str, float] = MEMORY.values
    for choice in ("-0.15", "0.07"):
        plans = [TASK.plan(each) for each in TASK.tutored() if each["indicated_x_m"] == choice]
        assert values[choice] == pytest.approx(np.mean([plan[67, NECK_YAW] for plan in plans]))
        turned = np.concatenate([plan[70:, NECK_YAW] for plan in plans])
        assert MEMORY.tells(turned, choice).all()
    assert MEMORY.turned_after == 10
    middle = sum(values.values()) / 2
    near = np.array([middle - 0.01, middle + 0.01])
    assert sorted(MEMORY.tells(near, "0.07").tolist()) == [False, True]
    assert (MEMORY.tells(near, "0.07") != MEMORY.tells(near, "-0.15")).all()


def test_the_share_falls_where_a_network_forgets(rollouts: list[Episode]) -> None:
    cues = [MEMORY.cue_of(rollout) for rollout in rollouts]
    away_deg = MEMORY.values["-0.15"]
    networks = [
        Network(Forgetful(HELD + steps, away_deg), "file", tau)
        for steps, tau in ((3, 30.0), (8, 150.0), (4, 30.0))
    ]
    recalls = [recall_of(MEMORY, network, cues[:1], 10) for network in networks]
    short, long = retentions_of(recalls)
    assert (short.tau, long.tau) == (30.0, 150.0)
    assert [rate.successes for rate in short.rates] == [2] * 4 + [1] + [0] * 6
    assert [rate.rate for rate in long.rates] == [1.0] * 9 + [0.0] * 2
    lines = draw(MEMORY, [short, long]).axes[0].lines
    assert lines[0].get_ydata().tolist() == [100] * 4 + [50] + [0] * 6
    shown = table(MEMORY, [short, long])
    assert [str(cell) for cell in shown.columns[0].cells] == ["networks", "trials", "0", "10"]
    assert [str(cell) for cell in shown.columns[1].cells][:2] == ["2", "2"]


def test_what_cannot_be_tested_is_explained(
    rollouts: list[Episode], make_episode: MakeEpisode
) -> None:
    with pytest.raises(UserError, match="experiment1 does not say what must be remembered"):
        MemoryTask.of(make_task(TaskConfig(name="experiment1")))
    with pytest.raises(UserError, match="shows the task 'experiment1', not 'experiment2'"):
        MEMORY.cue_of(make_episode())
    other = {**rollouts[0].situation, "indicated_x_m": "0.2"}
    with pytest.raises(UserError, match="tutored are"):
        MEMORY.cue_of(rollout_of(make_episode, TASK, other))
    short = make_episode(30, task="experiment2", situation=rollouts[0].situation)
    with pytest.raises(UserError, match="has no phase 'observe task space'"):
        MEMORY.cue_of(short)


def test_a_network_of_another_task_is_refused(
    rollouts: list[Episode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_episode(tmp_path / "r.mcap", rollouts[0])
    policy = random_checkpoint(tmp_path / "p.safetensors", 30, task="experiment1")
    command = f"figure memory --policies {policy} --rollouts {tmp_path / 'r.mcap'}"
    assert main(f"{command} --out {tmp_path / 'm.png'}".split()) == 2
    assert "was trained for the task 'experiment1'" in capsys.readouterr().err
