"""A run whose processes are killed, frozen and stopped at random moments loses nothing.

`pytest -m faults tests/faults` plays it; VMDNN_FAULTS and VMDNN_FAULT_SEED set number and seed.
"""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from ports import free_endpoint
from processes import eventually

from learner.checkpoint import load_checkpoint
from proto.episode import Kind
from proto.outbox import messages_of_run
from proto.recordings.episodes import read_episode
from services.run_check import check_run

FAULTS = int(os.environ.get("VMDNN_FAULTS", "300"))
SEED = int(os.environ.get("VMDNN_FAULT_SEED", "1"))
BETWEEN_S = (1.0, 10.0)
"""Time between two faults: each process is hit every 40 s or so, often while it starts."""
FROZEN_S = (1.0, 15.0)
UNFINISHED = "could_not_be_finished"
TRIALS = 6
CASES = (0, 22, 44)
ROUNDS = max(2, FAULTS // 15)
"""So many that the run goes on as long as the faults do."""
VERSIONS = 2 + ROUNDS
SETTINGS = {
    "run.name": "faults",
    "simulator.render": "false",
    "tutor.repeats": 1,
    "learner.cases": list(CASES),
    "learner.start_sequences": 3,
    "learner.pretraining.epochs": 2,
    "learner.epochs": 600,
    "learner.publish_every_epochs": 300,
    "learner.checkpoint_every_epochs": 100,
    "learner.lease_s": 20.0,
    "learner.corrections": f"{{rounds: {ROUNDS}, sequences: 3, tries: 6, epochs: 20}}",
    "evaluator.lease_s": 20.0,
    "evaluator.trials_per_policy": TRIALS,
    "evaluator.first_trials": 2,
    "done": "{}",
}


class FaultyRun:
    """A run under run_local, and what is done to its processes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "faults"
        self._chance = random.Random(SEED)
        self._frozen: dict[int, float] = {}
        self.done: Counter[str] = Counter()
        settings = {**SETTINGS, "run.folder": folder, "hub.endpoint": free_endpoint()}
        words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        self.output = folder / "output"
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        with self.output.open("wb") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deploy.run_local", "--actors", "2", *words],
                stdout=stream,
                stderr=subprocess.STDOUT,
                env={**os.environ, "TMPDIR": str(self.temporary)},
            )

    def pids(self) -> dict[int, str]:
        """Role by process id."""
        config = str(self.folder / "logs" / "config.yaml")
        found = {}
        for process in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                words = process.read_bytes().decode(errors="replace").split("\0")
                if config in words and "setpriv" not in words[0]:
                    found[int(process.parent.name)] = words[2]
        return found

    def fault(self) -> None:
        """Kill, freeze or stop one process; wake those that were frozen long enough."""
        self._wake(time.monotonic())
        if not (pids := self.pids()):
            return
        pid = self._chance.choice(sorted(pids))
        number = self._chance.choice((signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM))
        with suppress(ProcessLookupError):
            os.kill(pid, number)
            self.done[f"{number.name} {pids[pid]}"] += 1
            if number is signal.SIGSTOP:
                self._frozen[pid] = time.monotonic() + self._chance.uniform(*FROZEN_S)

    def pause(self) -> None:
        """Give the processes a moment."""
        time.sleep(self._chance.uniform(*BETWEEN_S))

    def calm(self) -> None:
        """Wake all."""
        self._wake(float("inf"))

    def _wake(self, now_s: float) -> None:
        for pid, until_s in list(self._frozen.items()):
            if until_s <= now_s:
                del self._frozen[pid]
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    def held(self) -> tuple[float, int]:
        """Memory (MiB) and number of open files of run_local itself, which lives all the time."""
        process = Path("/proc") / str(self.process.pid)
        status = (process / "status").read_text().splitlines()
        kib = next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))
        return kib / 1024, len(list((process / "fd").iterdir()))

    def stop(self) -> None:
        """Stop it as Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(120) == 0

    def counted(self) -> list[dict[str, Any]]:
        log = self.folder / "evaluation" / "trials.jsonl"
        lines = log.read_text().splitlines() if log.exists() else []
        return [json.loads(line) for line in lines]

    def recorded(self) -> list[Path]:
        return list((self.folder / "rollouts").glob("*.mcap"))

    def shown(self) -> list[Path]:
        return list((self.folder / "tutoring").glob("*.mcap"))

    def versions(self) -> int:
        return len(list((self.folder / "policies").glob("*.safetensors")))

    def log(self, process: str) -> str:
        """Its log, in which the older part is in another file."""
        logs = sorted((self.folder / "logs").glob(f"{process}.log*"), reverse=True)
        return "".join(path.read_text(errors="replace") for path in logs)

    def is_complete(self) -> bool:
        counted = self.counted()
        newest = Counter(trial["policy_version"] for trial in counted)[VERSIONS]
        return newest == TRIALS and all(map(self.is_recorded, counted))

    def is_recorded(self, trial: dict[str, Any]) -> bool:
        """Whether a trial has its recording; one whose actor was killed three times has none."""
        unfinished = trial["outcome"]["reason"] == UNFINISHED
        return unfinished or any((self.folder / "rollouts").glob(f"*{trial['episode']}.mcap"))


@pytest.mark.faults
@pytest.mark.timeout(60 * 60 + 30 * FAULTS)
def test_nothing_is_lost_by_random_faults(tmp_path: Path) -> None:
    run = FaultyRun(tmp_path)
    began_s = time.monotonic()
    held = [(0.0, 0)]
    try:
        while run.done.total() < FAULTS:
            run.fault()
            run.pause()
            assert run.process.poll() is None, run.output.read_text()
            if run.done.total() in (FAULTS // 3, FAULTS):
                held.append(run.held())
        under_faults = len(run.counted()), len(run.recorded()), run.versions()
        run.calm()
        eventually(run.is_complete, "the run is complete", patience_s=1800)
        run.stop()
    finally:
        run.calm()
        run.process.kill()
    print(f"seed {SEED}, {run.done.total()} faults in {time.monotonic() - began_s:.0f} s", run.done)
    counted, recorded, versions = under_faults
    print(f"while they came: {counted} trials counted, {recorded} recorded, policies {versions}")
    print(f"in all: {len(run.counted())} trials counted, {len(run.recorded())} rollouts recorded,")
    print(f"{len(run.shown())} sequences stored; run_local held (MiB, open files): {held[1:]}")
    assert held[-1][0] < held[1][0] + 16, "its memory stays flat"
    assert held[-1][1] < held[1][1] + 8, "it leaks no file"

    check_trials(run)
    check_sequences(run)
    check_policies(run)
    assert not run.pids(), "no process is left"
    assert not list(run.temporary.iterdir()), "no temporary file is left"
    report = check_run(run.folder)
    print(report.counts, report.notes)
    assert report.findings == []
    assert not messages_of_run(run.folder), "all episodes that were finished are stored"


def check_trials(run: FaultyRun) -> None:
    """Each trial is counted once, and a recount from the recordings gives the same."""
    counted = run.counted()
    each = Counter((trial["policy_version"], trial["seed"]) for trial in counted)
    assert set(each.values()) == {1}, "each trial is counted once"
    assert len({trial["run_id"] for trial in counted}) == 1
    for trial in counted:
        if trial["outcome"]["reason"] == UNFINISHED:
            continue
        (file,) = (run.folder / "rollouts").glob(f"*{trial['episode']}.mcap")
        recorded = read_episode(file)
        assert (recorded.policy_version, recorded.seed) == (trial["policy_version"], trial["seed"])
        assert recorded.outcome.precise == trial["outcome"]["precise"]
    episodes = Counter(path.stem.rpartition("_")[2] for path in run.recorded())
    assert set(episodes.values()) == {1}, "each rollout is recorded once"


def check_sequences(run: FaultyRun) -> None:
    """Each case is stored once, and each correction, unless it killed its actors three times."""
    stored = [read_episode(path) for path in run.shown()]
    shown = [each.seed for each in stored if each.kind is Kind.TUTORING]
    given_up = re.findall(
        r"the tutoring of \S+ with the seed (\d+) is given up", run.log("learner")
    )
    assert sorted([*shown, *map(int, given_up)]) == [1000 * case for case in CASES]
    corrected = [each for each in stored if each.kind is Kind.CORRECTION]
    once = Counter((each.policy_version, each.seed) for each in corrected)
    assert set(once.values()) == {1}, "each correction is stored once"
    assert set(Counter(version for version, _ in once).values()) <= {1, 2, 3}


def check_policies(run: FaultyRun) -> None:
    """All versions are there, and none was published after a newer one."""
    versions = [
        load_checkpoint(path).metadata.version
        for path in sorted((run.folder / "policies").glob("*.safetensors"))
    ]
    assert versions == list(range(1, VERSIONS + 1))
    published = re.findall(r"policy (\d+) is published", run.log("learner"))
    numbers = list(map(int, published))
    assert numbers == sorted(numbers), "versions never go back"
