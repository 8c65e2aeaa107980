"""Checks the folder of a run: what is damaged, missing, left over or foreign, and what to do.

Nothing is changed. Each check yields findings; see `Finding`.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from learner.checkpoint import (
    NETWORK_PREFIX,
    Checkpoint,
    check_same_network,
    load_checkpoint,
    policy_file,
    pretraining_file,
    previous_training_file,
    training_file,
)
from learner.policy_digests import DIGESTS, digest_problem
from proto.codec import MessageError
from proto.config import Config, load_config
from proto.episode import LOCAL, NOT_FINISHED, SIMULATION_FAILED, Kind
from proto.errors import UserError
from proto.outbox import PREPARED, PUT_ASIDE, message_name, message_problem, messages_of_run
from proto.recordings.episodes import EpisodeSummary, read_summary
from services.trials.trial_log import CountedTrial, parse_line

RECORDINGS: Final[Mapping[str, tuple[Kind, ...]]] = {
    "tutoring": (Kind.TUTORING, Kind.CORRECTION),
    "pretraining": (Kind.TUTORING, Kind.CORRECTION),
    "rollouts": (Kind.TRIAL, Kind.PRACTICE),
}
"""Folders of recordings, and the kinds of episodes that belong there."""
_FREE: Final = ("logs", "locks", "tensorboard")
"""Folders whose content is not checked."""
_FILES: Final[Mapping[str, tuple[str, ...]]] = {
    "": (r"config\.yaml", r"metrics[\w-]*\.jsonl"),
    "checkpoints": (r"(training|training-before|pretraining)\.safetensors", "run_id"),
    "policies": (r"[0-9]{6}\.safetensors", DIGESTS),
    "evaluation": (r"(trials|round_trials|lap_trials)\.jsonl",),
    **dict.fromkeys(RECORDINGS, (r".+\.mcap",)),
}
"""Names of the files that belong into each folder."""


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes:
        place: path in the run's folder.
        problem: what is wrong.
        advice: what to do.
    """

    place: str
    problem: str
    advice: str


@dataclass
class Report:
    """What was found in a run's folder.

    Attributes:
        findings: what is not as it should be.
        notes: what is worth knowing, but nothing needs to be done about it.
        counts: how many files and trials were looked at, by what they are.
    """

    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class _Recorded:
    """What is kept of a recording: enough to compare it with the trial log."""

    place: str
    kind: Kind
    training: str
    trial: tuple[int, str, int]
    readings: tuple[bool, bool, bool, str]


def recordings_of(folder: Path) -> list[Path]:
    """Return all recordings of a run."""
    return [path for name in RECORDINGS for path in sorted((folder / name).glob("*.mcap"))]


def check_run(folder: Path, advance: Callable[[], None] = lambda: None) -> Report:
    """Check a run's folder.

    Args:
        folder: the folder.
        advance: called after each of `recordings_of`.

    Raises:
        UserError: it is no folder of a run.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder")
    if not (folder / "config.yaml").exists() and not training_file(folder).exists():
        raise UserError(
            f"{folder} is no folder of a run: it has neither config.yaml nor"
            " checkpoints/training.safetensors"
        )
    report = Report()
    config = _check_config(folder, report)
    recorded = _check_recordings(folder, report, advance)
    _check_trials(folder, config, recorded, report)
    _check_training(folder, config, report)
    _check_outboxes(folder, report)
    _check_names(folder, report)
    if _is_played(folder):
        report.notes.append(
            "the run is being played: files that are being written now may be reported too"
        )
    return report


def _check_config(folder: Path, report: Report) -> Config | None:
    try:
        return load_config(folder / "config.yaml")
    except UserError as error:
        advice = "continue the run with its configuration (--config): it writes the file anew"
        report.findings.append(Finding("config.yaml", str(error), advice))
        return None


def _check_recordings(
    folder: Path, report: Report, advance: Callable[[], None]
) -> dict[str, _Recorded]:
    """Read all recordings; what is compared with the trial log, by id, for those in `rollouts`."""
    rollouts: dict[str, _Recorded] = {}
    for path in recordings_of(folder):
        where = str(path.relative_to(folder))
        advance()
        try:
            shown = read_summary(path)
        except UserError as error:
            report.findings.append(Finding(where, _short(error, path), _advice(path)))
            continue
        report.counts[f"recordings in {path.parent.name}"] = (
            report.counts.get(f"recordings in {path.parent.name}", 0) + 1
        )
        if problem := _misplaced(path, shown):
            report.findings.append(Finding(where, problem, "move it out of the run's folder"))
        elif path.parent.name == "rollouts":
            rollouts[shown.id] = _Recorded(
                where,
                shown.kind,
                shown.training,
                (shown.policy_version, _suite(shown), shown.seed),
                _readings(shown.outcome),
            )
    return rollouts


def _advice(path: Path) -> str:
    if path.parent.name == "rollouts":
        return (
            f"vmdnn recover {path} saves what is whole of it; trials that are counted stay counted"
        )
    return "continue the run: the learner sets it aside and has its case demonstrated again"


def _misplaced(path: Path, shown: EpisodeSummary) -> str:
    if path.stem != shown.id and not path.stem.endswith(f"_{shown.id}"):  # see `Recordings.path`
        return f"it holds the episode {shown.id}"
    if shown.kind not in RECORDINGS[path.parent.name]:
        return f"it is an episode of the kind {shown.kind}"
    return ""


def _suite(shown: EpisodeSummary) -> str:
    return "unlearned" if shown.conditions is None else shown.conditions.suite


def _readings(outcome: object) -> tuple[bool, bool, bool, str]:
    names = ("lenient", "strict", "precise", "reason")
    lenient, strict, precise, reason = (getattr(outcome, name) for name in names)
    return lenient, strict, precise, reason


def _check_trials(
    folder: Path, config: Config | None, recorded: Mapping[str, _Recorded], report: Report
) -> None:
    """Compare the trial log with a recount of the recordings."""
    path = folder / "evaluation" / "trials.jsonl"
    where = str(path.relative_to(folder))
    trials = _counted_trials(path, where, report)
    report.counts["counted trials"] = len(trials)
    again = Counter(
        (trial.run_id, trial.policy_version, trial.suite, trial.seed) for trial in trials
    )
    for (_, version, suite, seed), times in again.items():
        if times > 1:
            report.findings.append(
                Finding(
                    where,
                    f"the trial of policy {version} in {suite} with the seed {seed} stands there"
                    f" {times} times",
                    "nothing: only the first one counts; report how it came to be",
                )
            )
    messages = (folder / "outbox").glob("*/rollouts/*.message")
    sent_later = set(map(message_name, messages))
    for trial in trials:
        required = _is_recorded(trial, config) and trial.episode not in sent_later
        _check_recorded(trial, recorded.get(trial.episode), required, report)
    counted = {trial.episode for trial in trials}
    counted_as = {(trial.run_id, trial.policy_version, trial.suite, trial.seed) for trial in trials}
    for episode, each in recorded.items():
        known = episode in counted or (each.training, *each.trial) in counted_as
        if each.kind is Kind.TRIAL and not known:
            report.findings.append(
                Finding(
                    each.place,
                    "it is a trial that is not counted",
                    "continue the run: the trial is sent again from an outbox, or played again",
                )
            )


def _counted_trials(path: Path, where: str, report: Report) -> list[CountedTrial]:
    if not path.exists():
        return []
    trials = []
    with path.open("rb") as stream:
        for number, line in enumerate(stream, 1):
            if not line.endswith(b"\n"):
                advice = "continue the run: the evaluator drops it and plays the trial again"
                report.findings.append(Finding(where, f"line {number} is not finished", advice))
                continue
            try:
                trials.append(parse_line(line.rstrip(b"\n")))
            except MessageError as error:
                advice = "continue the run: its trial is played again; the line may be deleted"
                report.findings.append(Finding(where, f"line {number}: {error}", advice))
    return trials


def _is_recorded(trial: CountedTrial, config: Config | None) -> bool:
    """Whether a counted trial must have a recording: it was played to its end, and on the bus."""
    never_ended = trial.outcome.reason in (SIMULATION_FAILED.reason, NOT_FINISHED.reason)
    if never_ended or trial.actor == LOCAL:
        return False
    if config is None:
        return True
    recorder, precise = config.recorder, trial.outcome.precise
    return recorder.required and recorder.records(trial.episode, practice=False, precise=precise)


def _check_recorded(
    trial: CountedTrial, recorded: _Recorded | None, required: bool, report: Report
) -> None:
    place = f"rollouts/{trial.episode}.mcap" if recorded is None else recorded.place
    if recorded is None:
        if required:
            advice = "nothing can be done: the trial stays counted; its recording is lost"
            report.findings.append(
                Finding(place, "a counted trial has no recording that can be read", advice)
            )
    elif (
        recorded.readings != _readings(trial.outcome)
        or recorded.trial != (trial.policy_version, trial.suite, trial.seed)
        or recorded.training != trial.run_id
    ):
        advice = "one of both was changed: compare with a backup"
        report.findings.append(Finding(place, "it differs from what is counted of it", advice))


def _check_training(folder: Path, config: Config | None, report: Report) -> None:
    """Check checkpoints, the id of the training, and policies."""
    newest = _checkpoint(training_file(folder), folder, report)
    before = _checkpoint(previous_training_file(folder), folder, report)
    _checkpoint(pretraining_file(folder), folder, report)
    policies = _policies(folder, config, report)
    report.counts["policies"] = len(policies)
    training = newest or before
    if training is None:
        if policies:
            advice = "the next start trains anew and moves the policies to another folder"
            report.findings.append(
                Finding("checkpoints", "there are policies, but no checkpoint can be read", advice)
            )
        return
    _check_run_id(folder, report)
    if policies and max(policies) > training.metadata.version:
        advice = "continue the run: what was trained since is trained again, under the same version"
        report.findings.append(
            Finding(
                "checkpoints/training.safetensors",
                f"it is of policy {training.metadata.version}, older than policy {max(policies)}",
                advice,
            )
        )
    same = policies.get(training.metadata.version)
    if same is not None and same.metadata.epoch == training.metadata.epoch:
        _compare(same, training, report)


def _checkpoint(path: Path, folder: Path, report: Report) -> Checkpoint | None:
    if not path.exists():
        return None
    try:
        return load_checkpoint(path)
    except UserError as error:
        advice = {
            training_file(folder): "continue the run: the checkpoint before is used",
            previous_training_file(folder): "nothing: the next checkpoint replaces it",
        }.get(path, "nothing: only `vmdnn inspect vision` uses it")
        place = str(path.relative_to(folder))
        report.findings.append(Finding(place, _short(error, path), advice))
        return None


def _check_run_id(folder: Path, report: Report) -> None:
    path = training_file(folder).with_name("run_id")
    try:
        held = path.read_text()[:100].strip() if path.exists() else ""
    except (OSError, UnicodeDecodeError):
        held = "?"
    if re.fullmatch("[0-9a-f]{1,64}", held) is None:
        runs = "the run_id of its trials is in evaluation/trials.jsonl: write it into the file"
        advice = f"{runs}, or continue: the training gets a new id, and trials are counted anew"
        report.findings.append(Finding("checkpoints/run_id", "it holds no id", advice))


def _policies(folder: Path, config: Config | None, report: Report) -> dict[int, Checkpoint]:
    """The policies that can be read, by version."""
    found: dict[int, Checkpoint] = {}
    versions = []
    for path in sorted(policy_file(folder, 0).parent.glob("[0-9]*.safetensors")):
        if not path.stem.isdecimal():
            continue
        versions.append(int(path.stem))
        place = str(path.relative_to(folder))
        advice = "continue the run: the learner sets it aside and uses the one before"
        try:
            policy = load_checkpoint(path)
            if config is not None:
                check_same_network(config.network, policy, place)
            if problem := digest_problem(path, path.read_bytes()):
                raise UserError(problem)
        except UserError as error:
            report.findings.append(Finding(place, _short(error, path), advice))
            continue
        if policy.metadata.version != int(path.stem):
            problem = f"it holds policy {policy.metadata.version}"
            report.findings.append(Finding(place, problem, "move it out of the run's folder"))
            continue
        found[policy.metadata.version] = policy
    missing = sorted(set(range(1, max(versions, default=0))) - set(versions))
    aside = {p.stem for p in policy_file(folder, 0).parent.glob("*.damaged")}
    for version in missing:
        if f"{version:06d}" not in aside:
            advice = "nothing can be done: the version is not used again; its trials stay counted"
            report.findings.append(
                Finding(f"policies/{version:06d}.safetensors", "the policy is gone", advice)
            )
    _note_digests(found, config, report)
    return found


def _note_digests(
    policies: Mapping[int, Checkpoint], config: Config | None, report: Report
) -> None:
    if config is None:
        return
    others = [v for v, each in policies.items() if each.metadata.config_digest != config.digest()]
    if others:
        listed = ", ".join(map(str, others[:10])) + (" ..." if len(others) > 10 else "")
        report.notes.append(
            f"policies {listed} were trained with another configuration than config.yaml"
        )


def _compare(policy: Checkpoint, training: Checkpoint, report: Report) -> None:
    """Compare the newest policy with the checkpoint of the same epoch, bit by bit."""
    ours, theirs = policy.part(NETWORK_PREFIX), training.part(NETWORK_PREFIX)
    differing = [n for n in ours if n not in theirs or not np.array_equal(ours[n], theirs[n])]
    if differing:
        advice = "one of both was changed: compare with a backup"
        place = f"policies/{policy.metadata.version:06d}.safetensors"
        report.findings.append(
            Finding(place, f"{differing[0]} differs from the checkpoint of its epoch", advice)
        )


def _check_outboxes(folder: Path, report: Report) -> None:
    waiting = sorted(messages_of_run(folder))
    for path in waiting:
        if problem := message_problem(path):
            advice = "continue the run: the actor sets it aside and does not send it"
            report.findings.append(Finding(str(path.relative_to(folder)), problem, advice))
    if waiting:
        report.notes.append(f"{len(waiting)} messages wait in outboxes; the run sends them")


def _check_names(folder: Path, report: Report) -> None:
    """Report leftovers, what was set aside, and files that no run makes."""
    for path in _walk(folder):
        relative = path.relative_to(folder)
        place = str(relative)
        if path.suffix == ".part":
            advice = "continue the run, which deletes it; `vmdnn recover` saves a recording"
            report.findings.append(Finding(place, "a killed process left it half written", advice))
        elif path.suffix == ".unfinished":
            advice = "it is of an older vmdnn: delete it, or save a recording with `vmdnn recover`"
            report.findings.append(Finding(place, "a killed process left it half written", advice))
        elif path.suffix in PUT_ASIDE:
            advice = "look at it, then delete it; the run does without"
            report.findings.append(Finding(place, f"it was set aside ({path.suffix})", advice))
        elif not _belongs(relative):
            advice = "move it away"
            report.findings.append(Finding(place, "no run makes such a file", advice))


def _walk(folder: Path) -> Iterator[Path]:
    """All files, except those in folders whose content is not checked; links are not followed."""
    for place, folders, files in os.walk(folder):
        if Path(place) == folder:
            folders[:] = sorted(set(folders) - set(_FREE))
        yield from (Path(place, name) for name in sorted(files))


def _belongs(relative: Path) -> bool:
    parts: Sequence[str] = relative.parts
    if parts[0] == "outbox":
        return len(parts) == 4 and relative.suffix in (".message", PREPARED)
    if len(parts) > 2:
        return False
    folder = parts[0] if len(parts) == 2 else ""
    folder = "policies" if re.fullmatch("policies-[0-9a-f]{8}", folder) else folder
    return any(re.fullmatch(pattern, parts[-1]) for pattern in _FILES.get(folder, ()))


def _is_played(folder: Path) -> bool:
    """Whether a process on this machine holds a lock of the run."""
    try:
        held = Path("/proc/locks").read_text()
    except OSError:
        return False
    numbers = {int(number) for number in re.findall(r":(\d+) \d+ \S+$", held, re.MULTILINE)}
    return any(path.stat().st_ino in numbers for path in (folder / "locks").glob("*"))


def _short(error: UserError, path: Path) -> str:
    """An error without the path, which the finding has already."""
    first = str(error).splitlines()[0]
    return re.sub(rf"^(checkpoint )?{re.escape(str(path))}:? ", "", first)
