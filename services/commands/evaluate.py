"""`vmdnn evaluate`: test a policy in situations that were not tutored."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

from actors.policies.by_name import make_policy
from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from proto.storage import written_whole
from proto.suites import Suite
from proto.variables import parse_situation
from services.arguments.common import (
    INTERRUPTED,
    add_config,
    add_playing,
    playing_config,
    positive,
    seed,
)
from services.commands.evaluate_run import evaluate_run
from services.playing.video import write_video
from services.playing.video_file import video_argument
from services.playing.workers import Job, play_all
from services.terminal.console import make_console
from services.terminal.progress import progress_bar
from services.terminal.tables import success_table
from services.trials.evaluation import in_world_of, result_json, situation_jobs, trial_jobs
from services.trials.success import Tally
from services.trials.trial_log import CountedTrial

TRIALS: Final = range(1000, 1052)
"""Seeds of the trials without a suite."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    add_config(parser)
    add_playing(parser)
    tested = parser.add_mutually_exclusive_group(required=True)
    tested.add_argument(
        "--policy",
        help="tutor, a baseline of the task (`vmdnn inspect task` lists them), pretrained:NAME, a"
        " checkpoint's file, the folder of a run (its newest policy), or a class of your own as"
        " package.module:Class; a task may name blinded policies, such as blank-screen:POLICY",
    )
    tested.add_argument(
        "--run",
        dest="run_folder",
        type=Path,
        metavar="DIR",
        help="folder of a run: play what is missing of the trials of its policy versions, and add"
        " them to those that the run has counted",
    )
    parser.add_argument(
        "--policy-version",
        default="newest",
        metavar="all|best|newest|N",
        help="with --run: which versions",
    )
    parser.add_argument(
        "--suite",
        help="play the trials of a suite: one of evaluator.suites, or a built-in one such as"
        " beyond, disturbed or pushed; docs/generalization.md lists them",
    )
    parser.add_argument(
        "--trials",
        type=positive,
        help="number of situations; without it, those of the suite, or 52",
    )
    parser.add_argument(
        "--seed",
        type=seed,
        help="the same seed gives the same situations; without it, the first test seed of the"
        " suite, or 1000",
    )
    parser.add_argument(
        "--situation",
        action="append",
        metavar="NAME=VALUE,...",
        help="play this situation instead of those of the seed; `vmdnn inspect task` lists the"
        " variables; may be repeated",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--outcomes", type=Path, help="file to write, with one line of JSON for each trial"
    )
    parser.add_argument("--out", type=Path, help="folder in which the rollouts are recorded")
    parser.add_argument(
        "--states",
        action="store_true",
        help="record the activity of the network's subnets in the rollouts; a megabyte each",
    )
    parser.add_argument(
        "--video",
        type=video_argument,
        help="file for a video of all trials, one after the other, .mp4 or .gif; rendering takes"
        " some seconds a trial",
    )


def run(arguments: argparse.Namespace) -> int:
    """Play the trials and print the success rates; after Ctrl-C those of what was played."""
    if arguments.run_folder is not None:
        _check_run_arguments(arguments)
        return evaluate_run(arguments)
    config = playing_config(arguments)
    suite = None if arguments.suite is None else config.suite(arguments.suite)
    if suite is not None and arguments.backend is None:
        config = in_world_of(suite, config)
    jobs = _jobs(config, arguments, suite)
    make_policy(arguments.policy, make_task(config.task))  # a wrong name starts no worker
    started = time.monotonic()
    trials: list[CountedTrial] = []
    shown: dict[int, Episode] = {}
    status = 0
    try:
        played = play_all(config, arguments.policy, jobs, workers=arguments.workers)
        with progress_bar(f"evaluating {arguments.policy}", len(jobs)) as advance, closing(played):
            for job, episode in played:
                trials.append(CountedTrial.of(episode, run_id=episode.policy))
                if arguments.video is not None:
                    shown[job.seed] = episode
                advance()
    except KeyboardInterrupt:
        status = INTERRUPTED
        print(f"stopped after {len(trials)} of {len(jobs)} trials", file=sys.stderr)
    if arguments.outcomes is not None:
        _write_outcomes(arguments.outcomes, trials)
    tally = Tally.of(trial.outcome for trial in trials)
    result = result_json(config, arguments.policy, tally, time.monotonic() - started, suite)
    if arguments.json:
        print(json.dumps(result))
    else:
        named = "" if suite is None else f", suite {suite.name}"
        title = "{policy} on {task} in {backend}{named}, {trials} trials, {wall_s:.1f} s"
        title = title.format(**result, named=named)
        make_console().print(success_table(title, tally))
    if shown and status == 0:
        _write_video([shown[number] for number in sorted(shown)], arguments.video, config)
    return status


def _check_run_arguments(arguments: argparse.Namespace) -> None:
    """Refuse what --run has no use for: it plays the trials of the run itself."""
    named = {
        "--config": arguments.config,
        "--task": arguments.task,
        "--seed": arguments.seed,
        "--situation": arguments.situation,
        "--outcomes": arguments.outcomes,
        "--out": arguments.out,
        "--states": arguments.states or None,
        "--video": arguments.video,
    }
    given = [option for option, value in named.items() if value is not None]
    if given:
        raise UserError(
            f"--run plays the trials of the run's own configuration; {given[0]} goes with --policy:"
            f" --policy {arguments.run_folder} is the run's newest policy"
        )


def _write_video(episodes: list[Episode], out: Path, config: Config) -> None:
    frames = sum(episode.steps for episode in episodes)
    with progress_bar("rendering", frames) as advance:
        write_video(episodes, out, config, on_frame=advance)


def _jobs(config: Config, arguments: argparse.Namespace, suite: Suite | None) -> list[Job]:
    plain = TRIALS if suite is None else suite.test_seeds
    trials = len(plain) if arguments.trials is None else arguments.trials
    first = plain.start if arguments.seed is None else arguments.seed
    if arguments.states and arguments.out is None:
        raise UserError("--states are recorded in the rollouts; add --out DIR to record rollouts")
    if arguments.situation is None:
        jobs = trial_jobs(config, trials, first, arguments.out, suite)
    else:
        task = make_task(config.task)
        situations = [
            parse_situation(text, task.variables, task.name) for text in arguments.situation
        ]
        jobs = situation_jobs(situations, first, arguments.out, suite)
    return [replace(job, states=arguments.states) for job in jobs]


def _write_outcomes(path: Path, trials: Iterable[CountedTrial]) -> None:
    with written_whole(path) as stream:
        stream.writelines(trial.line() for trial in sorted(trials, key=lambda trial: trial.seed))
