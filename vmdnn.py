"""vmdnn in Python: simulators, tasks, policies, recordings, training and evaluation.

    import vmdnn

    task = vmdnn.make_task("experiment1")
    simulator = vmdnn.make_simulator("sapien")
    policy = vmdnn.make_policy("pretrained:experiment1", task)
    episode = vmdnn.play(simulator, task, policy, seed=7)
    print(episode.outcome)

`docs/python.md` shows each function at work. `Task`, `Policy` and `Simulator` are what a class of
one's own has to be; `UserError` is what every function raises on bad input.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from actors.policies.contract import Policy
    from actors.simulator import Simulator
    from actors.tasks.contract import Task
    from proto.config import Config
    from proto.episode import Episode, Outcome
    from proto.errors import UserError
    from proto.variables import Situation
    from services.trials.success import Tally

__all__ = [
    "Config",
    "Episode",
    "Outcome",
    "Policy",
    "Simulator",
    "Task",
    "UserError",
    "__version__",
    "evaluate",
    "load_config",
    "make_policy",
    "make_simulator",
    "make_task",
    "play",
    "read_episode",
    "train",
    "tutor",
    "write_episode",
]

_PACKAGES: Final = ("proto", "sim_assets", "learner", "actors", "services")
_CLASSES: Final = {
    "Config": "proto.config",
    "Episode": "proto.episode",
    "Outcome": "proto.episode",
    "Policy": "actors.policies.contract",
    "Simulator": "actors.simulator",
    "Task": "actors.tasks.contract",
    "UserError": "proto.errors",
}
"""Classes that are imported when they are first used: `vmdnn hub` needs no simulator."""


def _check_packages() -> None:
    """Refuse to start where another distribution has replaced one of our packages.

    The packages have common names: `proto` is also the module of proto-plus, which Google's cloud
    clients use. Whichever is installed last overwrites the other.
    """
    for name in _PACKAGES:
        file = Path(__file__).parent / name / "__init__.py"
        if file.is_file() and 'DISTRIBUTION = "vmdnn"' in file.read_text():
            continue
        others = sorted({*packages_distributions().get(name, [])} - {"vmdnn"})
        raise ImportError(
            f"the package {name!r} is not that of vmdnn;"
            f" {' and '.join(others) or 'another package'} has replaced it. Install vmdnn into an"
            " environment of its own: python -m venv ENV && ENV/bin/pip install vmdnn"
        )


_check_packages()

__version__ = version("vmdnn")


def __getattr__(name: str) -> Any:
    if name in _CLASSES:
        return getattr(importlib.import_module(_CLASSES[name]), name)
    raise AttributeError(f"module 'vmdnn' has no attribute {name!r}")


def load_config(source: str | Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """Read a configuration.

    Args:
        source: a YAML file, the name of a built-in configuration (`experiment1`, `smoke`, `paper`),
            or None for all defaults.
        overrides: values to change, such as `learner.epochs=10`.

    Raises:
        UserError: there is no such file, or a value is wrong.
    """
    from proto.config import load_config as load  # noqa: PLC0415
    from services.arguments.common import config_file  # noqa: PLC0415

    return load(None if source is None else config_file(str(source)), overrides)


def make_task(name: str = "experiment1", **options: Any) -> Task:
    """Make a task: a built-in one by name, or one of your own as `package.module:Class`.

    Args:
        name: the task.
        options: what else stands in the section `task` of a configuration, such as
            attention="fixed".
    """
    from actors.tasks.registry import make_task as make  # noqa: PLC0415
    from proto.config import TaskConfig  # noqa: PLC0415

    return make(TaskConfig.model_validate({"name": name, **options}))


def make_simulator(backend: str = "sapien", *, render: bool = True) -> Simulator:
    """Make a simulator: a built-in one by name, or one of your own as `package.module:Class`.

    Without `render` no graphics driver is needed and every picture is black.
    """
    from actors.simulator import make_simulator as make  # noqa: PLC0415
    from proto.config import SimulatorConfig  # noqa: PLC0415

    return make(SimulatorConfig(backend=backend, render=render))


def make_policy(name: str | Path, task: Task) -> Policy:
    """Load a policy that plays a task.

    Args:
        name: `tutor`, a baseline of the task, `pretrained:NAME`, the path of a checkpoint, or a
            class of your own as `package.module:Class`.
        task: the task.
    """
    from actors.policies.by_name import make_policy as make  # noqa: PLC0415

    return make(str(name), task)


def play(
    simulator: Simulator,
    task: Task,
    policy: Policy,
    situation: Situation | None = None,
    *,
    seed: int = 0,
) -> Episode:
    """Play one episode.

    Args:
        simulator: where it is played.
        task: what is played.
        policy: who acts.
        situation: the value of each of the task's variables; without it, drawn with the seed.
        seed: seed of everything random in the episode.
    """
    from actors.player import play as play_episode  # noqa: PLC0415
    from proto.episode import Kind  # noqa: PLC0415

    where = task.sample(seed) if situation is None else situation
    return play_episode(simulator, task, policy, where, seed=seed, kind=Kind.TRIAL)


def read_episode(path: str | Path) -> Episode:
    """Read a recorded episode, an MCAP file."""
    from proto.recordings.episodes import read_episode as read  # noqa: PLC0415

    return read(Path(path))


def write_episode(path: str | Path, episode: Episode) -> None:
    """Record an episode as an MCAP file."""
    from proto.recordings.episodes import write_episode as write  # noqa: PLC0415

    write(Path(path), episode)


def tutor(
    folder: str | Path,
    config: Config | None = None,
    *,
    cases: str = "all",
    seed: int = 100_000,
    workers: int = 1,
) -> list[Path]:
    """Record tutored sequences into a folder, one MCAP file each; what is there is kept.

    Args:
        folder: where they go.
        config: names the task, the simulator and how often each case is tutored; without it, all
            defaults.
        cases: `all`, numbers and ranges of the tutored cases such as `0,3,7-9`, or `random:40`.
        seed: seed of the first random case.
        workers: processes to play in.

    Returns:
        The files of the folder.
    """
    from actors.tasks.registry import make_task as make  # noqa: PLC0415
    from proto.config import Config as Default  # noqa: PLC0415
    from services.playing.tutoring import parse_cases, record, tutoring_jobs  # noqa: PLC0415

    config, out = config or Default(), Path(folder)
    jobs = tutoring_jobs(config, parse_cases(cases, make(config.task), seed), out)
    for _ in record(config, jobs, out, workers=workers):
        pass
    return sorted(out.glob("*.mcap"))


def train(
    data: str | Path,
    out: str | Path,
    config: Config | None = None,
    on_epoch: Callable[[float], None] = lambda _: None,
) -> Path:
    """Train VMDNN on recorded sequences; a training that was stopped goes on where it was.

    Args:
        data: folder of tutored sequences.
        out: folder of the run; gets checkpoints and policies.
        config: everything the training depends on; without it, all defaults.
        on_epoch: called with the loss after each epoch.

    Returns:
        The file of the newest policy.
    """
    from actors.tasks.registry import make_task as make  # noqa: PLC0415
    from learner.checkpoint import policy_file  # noqa: PLC0415
    from learner.training.training_run import open_training, run_training  # noqa: PLC0415
    from learner.training.vmdnn_recipe import VMDNNRecipe  # noqa: PLC0415
    from learner.tutoring.store import TutoringStore  # noqa: PLC0415
    from proto.config import Config as Default  # noqa: PLC0415

    config, folder = config or Default(), Path(out)
    task = make(config.task)
    recipe = VMDNNRecipe(config, task.questions, task.distractors)
    trainer = open_training(recipe, folder, TutoringStore(Path(data)))

    def go_on(loss: float) -> bool:
        on_epoch(loss)
        return True

    run_training(trainer, folder, go_on)
    return policy_file(folder, trainer.version)


def evaluate(
    policy: str | Path,
    config: Config | None = None,
    *,
    trials: int = 52,
    seed: int = 1000,
    workers: int = 1,
) -> Tally:
    """Play trials in situations that were not tutored, and count what succeeds.

    Args:
        policy: see `make_policy`.
        config: names the task and the simulator; without it, all defaults.
        trials: how many.
        seed: seed of the first situation; the same seed gives the same situations.
        workers: processes to play in.
    """
    from proto.config import Config as Default  # noqa: PLC0415
    from services.playing.workers import play_all  # noqa: PLC0415
    from services.trials.evaluation import trial_jobs  # noqa: PLC0415
    from services.trials.success import Tally as Counts  # noqa: PLC0415

    config = config or Default()
    jobs = trial_jobs(config, trials, seed)
    played = play_all(config, str(policy), jobs, workers=workers)
    return Counts.of(episode.outcome for _, episode in played)


def main(argv: Sequence[str] | None = None) -> int:
    """The `vmdnn` command."""
    from services.cli import main as run  # noqa: PLC0415

    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
