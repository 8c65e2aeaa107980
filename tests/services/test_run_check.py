"""`vmdnn check` finds what is damaged, missing or left over in a run, and changes nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fitting import make_policy

from learner.checkpoint import (
    Checkpoint,
    TrainingMetadata,
    checkpoint_from_bytes,
    policy_file,
    previous_training_file,
    save_checkpoint,
    training_file,
)
from learner.policy_digests import note_digest
from proto.codec import encode
from proto.config import load_config
from proto.episode import Episode, Kind
from proto.messages import Receipt, Rollout
from proto.outbox import Outbox
from proto.recordings.episodes import read_episode, write_episode
from services.cli import main
from services.run_check import check_run
from services.trials.trial_log import TrialLog

RUN_ID = "ab12"
VERSIONS = 3


@pytest.fixture
def run(tmp_path: Path, make_episode: Callable[..., Episode]) -> Path:
    """The folder of a run with three policies, one sequence, two trials and one of practice."""
    folder = tmp_path / "run"
    load_config(None, ["run.name=run", f"run.folder={tmp_path}"]).save(folder / "config.yaml")
    write_episode(folder / "tutoring" / "s1.mcap", make_episode(3, id="s1"))
    log = TrialLog(folder / "evaluation" / "trials.jsonl")
    for name, kind in (("t1", Kind.TRIAL), ("t2", Kind.TRIAL), ("p1", Kind.PRACTICE)):
        seed = 1000 + int(name[1])
        episode = make_episode(
            3,
            id=name,
            kind=kind,
            seed=seed,
            policy_version=VERSIONS,
            training=RUN_ID,
            actor="actor",
        )
        write_episode(folder / "rollouts" / f"{name}.mcap", episode)
        if kind is Kind.TRIAL:
            log.add(Rollout(episode, RUN_ID))
    for version in range(1, VERSIONS + 1):
        path = policy_file(folder, version)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(make_policy(version).weights)
        if version < VERSIONS:  # older runs have no digests
            note_digest(path, path.read_bytes())
    policy = checkpoint_from_bytes(make_policy(VERSIONS).weights, "it")
    training = TrainingMetadata(sequences=("s1",), asked={})
    metadata = policy.metadata.model_copy(update={"training": training})
    save_checkpoint(training_file(folder), Checkpoint(metadata, policy.tensors))
    (training_file(folder).with_name("run_id")).write_text(RUN_ID)
    return folder


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def append(path: Path, text: str) -> None:
    path.write_bytes(path.read_bytes() + text.encode())


def twice(path: Path) -> None:
    path.write_bytes(path.read_bytes() * 2)


def put(path: Path, content: bytes = b"x") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def listing(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_nothing_is_wrong_in_a_whole_run(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(run)
    assert main(["check", str(run)]) == 0
    told = capsys.readouterr().out
    assert "nothing is wrong" in told
    assert "3 recordings in rollouts, 2 counted trials, 3 policies" in told
    assert listing(run) == before


def test_names_with_the_time_and_trials_without_the_bus_are_fine(run: Path) -> None:
    for name in ("t1", "t2", "p1"):
        path = run / "rollouts" / f"{name}.mcap"
        path.rename(path.with_name(f"20260102-030405-500_{name}.mcap"))
    log = run / "evaluation" / "trials.jsonl"
    line = log.read_bytes().splitlines(keepends=True)[0]
    changed = (
        *((b'"seed": 1001', b'"seed": 1009'), (b'"episode": "t1"', b'"episode": "u1"')),
        (b'"actor": "actor"', b'"actor": "local"'),
    )
    for old, new in changed:
        assert old in line
        line = line.replace(old, new)
    put(log, log.read_bytes() + line)
    assert check_run(run).findings == []


def test_a_recording_that_waits_in_an_outbox_is_not_lost(run: Path) -> None:
    outbox = Outbox(run / "outbox" / "actor" / "rollouts", lambda _key, _wire: None)
    rollout = read_episode(run / "rollouts" / "t1.mcap")
    (run / "rollouts" / "t1.mcap").unlink()
    assert [found.problem for found in check_run(run).findings] != []
    outbox.add("t1", "vmdnn/run/rollout/actor", encode(Rollout(rollout, RUN_ID)))
    assert check_run(run).findings == []


@pytest.mark.parametrize(
    ("damage", "place", "problem"),
    [
        (lambda r: flip(r / "rollouts/t1.mcap", 3000), "rollouts/t1.mcap", "is cut off or damaged"),
        (lambda r: flip(r / "rollouts/t1.mcap", 3000), "rollouts/t1.mcap", "has no recording"),
        (lambda r: cut(r / "tutoring/s1.mcap"), "tutoring/s1.mcap", "is cut off or damaged"),
        (lambda r: (r / "rollouts/t2.mcap").unlink(), "rollouts/t2.mcap", "has no recording"),
        (
            lambda r: (r / "rollouts/t2.mcap").rename(r / "rollouts/t9.mcap"),
            "rollouts/t9.mcap",
            "it holds the episode t2",
        ),
        (
            lambda r: (r / "rollouts/p1.mcap").rename(r / "tutoring/p1.mcap"),
            "tutoring/p1.mcap",
            "of the kind practice",
        ),
        (
            lambda r: put(
                r / "evaluation/trials.jsonl",
                (r / "evaluation/trials.jsonl").read_bytes().splitlines(keepends=True)[0],
            ),
            "rollouts/t2.mcap",
            "a trial that is not counted",
        ),
        (
            lambda r: put(
                r / "evaluation/trials.jsonl",
                (r / "evaluation/trials.jsonl").read_bytes().replace(b'"imprecise"', b'"toppled"'),
            ),
            "rollouts/t1.mcap",
            "differs from what is counted",
        ),
        (
            lambda r: twice(r / "evaluation/trials.jsonl"),
            "evaluation/trials.jsonl",
            "stands there 2 times",
        ),
        (
            lambda r: append(r / "evaluation/trials.jsonl", '{"run_id": "ab'),
            "evaluation/trials.jsonl",
            "line 3 is not finished",
        ),
        (
            lambda r: append(r / "evaluation/trials.jsonl", "{}\n"),
            "evaluation/trials.jsonl",
            "line 3: payload",
        ),
        (lambda r: cut(policy_file(r, 3)), "policies/000003.safetensors", "damaged"),
        (lambda r: policy_file(r, 2).unlink(), "policies/000002.safetensors", "is gone"),
        (
            lambda r: policy_file(r, 1).rename(policy_file(r, 4)),
            "policies/000004.safetensors",
            "it holds policy 1",
        ),
        (
            lambda r: flip(policy_file(r, 3), -1000),
            "policies/000003.safetensors",
            "differs from the checkpoint",
        ),
        (
            lambda r: flip(policy_file(r, 2), -1000),
            "policies/000002.safetensors",
            "differs from its digest",
        ),
        (lambda r: cut(training_file(r)), "checkpoints/training.safetensors", "damaged"),
        (
            lambda r: put(previous_training_file(r)),
            "checkpoints/training-before.safetensors",
            "damaged",
        ),
        (lambda r: training_file(r).unlink(), "checkpoints", "no checkpoint can be read"),
        (
            lambda r: put(policy_file(r, 4), make_policy(4).weights),
            "checkpoints/training.safetensors",
            "older than policy 4",
        ),
        (lambda r: put(r / "checkpoints/run_id", b""), "checkpoints/run_id", "holds no id"),
        (lambda r: (r / "config.yaml").write_text("a: ["), "config.yaml", "cannot be read"),
        (lambda r: put(r / "rollouts/a.mcap.1f.part"), "rollouts/a.mcap.1f.part", "half written"),
        (
            lambda r: put(r / "tutoring/a.mcap.unfinished"),
            "tutoring/a.mcap.unfinished",
            "half written",
        ),
        (lambda r: put(r / "policies/000004.damaged"), "policies/000004.damaged", "set aside"),
        (lambda r: put(r / "rollouts/notes.txt"), "rollouts/notes.txt", "no run makes"),
        (lambda r: put(r / "more/a.mcap"), "more/a.mcap", "no run makes"),
        (
            lambda r: put(r / "outbox/a/rollouts/1-x.message", b"[" * 5000),
            "outbox/a/rollouts/1-x.message",
            "it is damaged",
        ),
    ],
)
def test_each_fault_is_found_with_what_to_do(
    run: Path, damage: Callable[[Path], object], place: str, problem: str
) -> None:
    damage(run)
    before = listing(run)
    findings = check_run(run).findings
    assert [f for f in findings if f.place == place and problem in f.problem], findings
    assert all(finding.advice for finding in findings)
    assert listing(run) == before


def test_findings_are_told_and_the_status_is_1(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put(run / "rollouts" / "no\nte.txt")
    assert main(["check", str(run)]) == 1
    told = capsys.readouterr().out
    assert "rollouts/no\\nte.txt: no run makes such a file\n    move it away" in told
    assert main(["check", str(run), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert [finding["advice"] for finding in report["findings"]] == ["move it away"]
    assert report["counts"]["counted trials"] == 2


def test_waiting_messages_are_no_fault(run: Path) -> None:
    outbox = Outbox(run / "outbox" / "a" / "rollouts", lambda _key, _wire: None)
    outbox.add("e1", "vmdnn/run/rollout/a", encode(Receipt("e1")))
    report = check_run(run)
    assert report.findings == []
    assert "1 messages wait in outboxes; the run sends them" in report.notes


def test_what_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path)]) == 2
    assert "is no folder of a run" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "none")]) == 2
    assert "there is no such folder" in capsys.readouterr().err


def test_a_trial_whose_simulation_failed_needs_no_recording(
    run: Path, failure: Callable[..., object]
) -> None:
    report = failure("e9", kind=Kind.TRIAL, seed=1009, training=RUN_ID, policy_version=VERSIONS)
    TrialLog(run / "evaluation" / "trials.jsonl").add_failure(replace(report))
    assert check_run(run).findings == []
