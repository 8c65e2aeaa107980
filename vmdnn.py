"""The Python interface: simulators, tasks, policies, recordings, training and evaluation.

    import vmdnn

    task = vmdnn.make_task("experiment1")
    simulator = vmdnn.make_simulator("sapien")
    policy = vmdnn.make_policy("pretrained:experiment1", task)
    episode = vmdnn.play(simulator, task, policy, seed=7)
    print(episode.outcome)

`docs/python.md` shows an example of each function. Your own tasks, policies and simulators
implement `Task`, `Policy` and `Simulator`. Every function raises `UserError` for bad input.
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
"""Classes that are imported on first use, so that `vmdnn hub` does not import a simulator."""


def _check_packages() -> None:
    """Raise ImportError if another distribution has replaced one of our packages.

    The packages have common names. `proto`, for example, is also the module of proto-plus, which
    Google's cloud clients use. The distribution that is installed last overwrites the other.
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
        source: a YAML file, the name of a built-in configuration (such as `experiment2`),
            or None for all defaults.
        overrides: values to change, such as `learner.epochs=10`.

    Returns:
        The configuration; its sections are attributes, such as `config.learner.epochs`.

    Raises:
        UserError: there is no such file, or a value is wrong.
    """
    from proto.config import load_config as load  # noqa: PLC0415
    from services.arguments.common import config_file  # noqa: PLC0415

    return load(None if source is None else config_file(str(source)), overrides)


def make_task(name: str = "experiment1", **options: Any) -> Task:
    """Make a task.

    Args:
        name: name of a built-in task, or your own class as `package.module:Class`.
        options: the other keys of the section `task` of a configuration, such as
            attention="fixed".

    Returns:
        The task. `tutored()` gives its tutored situations, `variables` what a situation consists
        of, `phase_names` its phases.

    Raises:
        UserError: there is no such task, or it has no such option.
    """
    from actors.tasks.registry import make_task as make  # noqa: PLC0415
    from proto.config import TaskConfig  # noqa: PLC0415

    return make(TaskConfig.model_validate({"name": name, **options}))


def make_simulator(backend: str = "sapien", *, render: bool = True) -> Simulator:
    """Make a simulator.

    Args:
        backend: name of a built-in simulator, or your own class as `package.module:Class`.
        render: render pictures. Without it every picture is black, and no graphics driver is
            needed.

    Returns:
        The simulator. It can play any number of episodes, one after the other; `close()` ends it.

    Raises:
        UserError: there is no such simulator, or it cannot render on this machine.
    """
    from actors.simulator import make_simulator as make  # noqa: PLC0415
    from proto.config import SimulatorConfig  # noqa: PLC0415

    return make(SimulatorConfig(backend=backend, render=render))


def make_policy(name: str | Path, task: Task) -> Policy:
    """Make a policy that plays a task.

    Args:
        name: `tutor`, a baseline of the task, `pretrained:NAME`, the path of a checkpoint, or your
            own class as `package.module:Class`. Before it may stand the name of one of
            `task.blinded`, as in `blank-screen:pretrained:NAME`.
        task: the task.

    Returns:
        The policy, for `play`. A trained network also has `states(images)`: the activity
        (steps, units) of each subnet by name, for pictures (steps, 48, 64) uint8.

    Raises:
        UserError: there is no such policy, or it is damaged or of another task.
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
        simulator: simulator that plays the scene.
        task: the task.
        policy: policy that chooses the actions.
        situation: values of the task's variables by name; without it, a random situation.
        seed: seed of all random numbers in the episode, including the random situation.

    Returns:
        The episode: pictures, actions, joints, bodies and `outcome`; see `help(vmdnn.Episode)`.

    Raises:
        UserError: the situation is not one of the task.
    """
    from actors.player import play as play_episode  # noqa: PLC0415
    from proto.episode import Kind  # noqa: PLC0415

    where = task.sample(seed) if situation is None else situation
    return play_episode(simulator, task, policy, where, seed=seed, kind=Kind.TRIAL)


def read_episode(path: str | Path) -> Episode:
    """Read a recorded episode.

    Args:
        path: the MCAP file.

    Returns:
        The episode, equal to the one that was recorded.

    Raises:
        UserError: the file is missing, damaged or no episode.
    """
    from proto.recordings.episodes import read_episode as read  # noqa: PLC0415

    return read(Path(path))


def write_episode(path: str | Path, episode: Episode) -> None:
    """Record an episode as an MCAP file, which Foxglove opens.

    Args:
        path: the file. An existing one is replaced.
        episode: the episode.

    Raises:
        UserError: the file cannot be written.
    """
    from proto.recordings.episodes import write_episode as write  # noqa: PLC0415
    from services.robot_meshes import robot_meshes  # noqa: PLC0415

    write(Path(path), episode, robot=robot_meshes())


def tutor(
    folder: str | Path,
    config: Config | None = None,
    *,
    cases: str = "all",
    seed: int = 100_000,
    workers: int = 1,
) -> list[Path]:
    """Record tutored sequences into a folder, one MCAP file each.

    Args:
        folder: the folder. Sequences that it already has are kept and not played again.
        config: the configuration, which names task, simulator and repeats; without it, all
            defaults.
        cases: `all`, numbers and ranges of the tutored cases such as `0,3,7-9`, or `random:40`.
        seed: seed of the first random case.
        workers: number of processes.

    Returns:
        The files of the folder.

    Raises:
        UserError: there is no such case, or the folder cannot be written.
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
    """Train VMDNN on recorded sequences, or continue a training that was stopped.

    Args:
        data: folder of tutored sequences.
        out: folder of the run, for checkpoints and policies.
        config: the configuration; without it, all defaults.
        on_epoch: called with the loss after each epoch, of pre-training too.

    Returns:
        The file of the newest policy.

    Raises:
        UserError: there is no sequence to learn from, the folder holds a training of another
            network, or the training diverged.
    """
    from actors.tasks.registry import make_task as make  # noqa: PLC0415
    from learner.checkpoint import policy_file  # noqa: PLC0415
    from learner.training.training_run import open_training, run_training  # noqa: PLC0415
    from learner.training.vmdnn_recipe import VMDNNRecipe  # noqa: PLC0415
    from learner.tutoring.store import TutoringStore  # noqa: PLC0415
    from proto.config import Config as Default  # noqa: PLC0415
    from proto.run_locks import owned_training  # noqa: PLC0415
    from services.monitoring.training_monitor import monitored  # noqa: PLC0415

    config, folder = config or Default(), Path(out)
    task = make(config.task)
    recipe = VMDNNRecipe(config, task.questions, task.distractors)
    with owned_training(folder):
        trainer = open_training(recipe, folder, TutoringStore(Path(data)))
        with monitored(trainer, folder) as monitor:

            def go_on(loss: float) -> bool:
                monitor.note_epoch()
                on_epoch(loss)
                return True

            run_training(trainer, folder, go_on)
    return policy_file(folder, trainer.version)


def evaluate(
    policy: str | Path,
    config: Config | None = None,
    *,
    trials: int = 52,
    seed: int | None = None,
    workers: int = 1,
    suite: str | None = None,
) -> Tally:
    """Play trials in situations that were not tutored, and count the successes.

    Args:
        policy: the policy, see `make_policy`.
        config: the configuration, which names task and simulator; without it, all defaults.
        trials: number of trials.
        seed: seed of the first situation; the same seed gives the same situations. Without it, the
            first test seed of the suite, or 1000.
        workers: number of processes.
        suite: name of a suite of the configuration or of a built-in one, such as `disturbed`, in
            whose simulator and under whose conditions the trials are played.

    Returns:
        The counts. `tally.rate("strict")` gives successes, rate and 95 % Wilson interval in a
        reading of success (`lenient`, `strict`, `precise`), `tally.reasons` how often trials failed
        for which reason.

    Raises:
        UserError: there is no such policy or suite.
    """
    from proto.config import Config as Default  # noqa: PLC0415
    from services.playing.workers import play_all  # noqa: PLC0415
    from services.trials.evaluation import in_world_of, trial_jobs  # noqa: PLC0415
    from services.trials.success import Tally as Counts  # noqa: PLC0415

    config = config or Default()
    chosen = None if suite is None else config.suite(suite)
    if chosen is not None:
        config = in_world_of(chosen, config)
    first = 1000 if chosen is None else chosen.test_seeds.start
    jobs = trial_jobs(config, trials, first if seed is None else seed, suite=chosen)
    played = play_all(config, str(policy), jobs, workers=workers)
    return Counts.of(episode.outcome for _, episode in played)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the `vmdnn` command and return the exit status."""
    from services.cli import main as run  # noqa: PLC0415

    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
