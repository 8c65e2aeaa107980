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
from proto.recordings.episodes import read_episode

FAULTS = int(os.environ.get("VMDNN_FAULTS", "300"))
UNFINISHED = "could_not_be_finished"
SEED = int(os.environ.get("VMDNN_FAULT_SEED", "1"))
TRIALS = 4
CASES = (0, 22, 44)
SETTINGS = {
    "run.name": "faults",
    "simulator.render": "false",
    "tutor.repeats": 1,
    "learner.cases": list(CASES),
    "learner.start_sequences": 3,
    "learner.pretraining.epochs": 2,
    "learner.epochs": 3000,
    "learner.publish_every_epochs": 300,
    "learner.checkpoint_every_epochs": 100,
    "learner.lease_s": 20.0,
    "evaluator.lease_s": 20.0,
    "evaluator.trials_per_policy": TRIALS,
    "learner.corrections.rounds": 0,
    "done": "{}",
}
VERSIONS = 10


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
        with self.output.open("wb") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "deploy.run_local", "--actors", "2", *words],
                stdout=stream,
                stderr=subprocess.STDOUT,
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
                self._frozen[pid] = time.monotonic() + self._chance.uniform(1.0, 15.0)

    def pause(self) -> None:
        """Give the processes a moment."""
        time.sleep(self._chance.uniform(0.5, 5.0))

    def calm(self) -> None:
        """Wake all."""
        self._wake(float("inf"))

    def _wake(self, now_s: float) -> None:
        for pid, until_s in list(self._frozen.items()):
            if until_s <= now_s:
                del self._frozen[pid]
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)

    def counted(self) -> list[dict[str, Any]]:
        log = self.folder / "evaluation" / "trials.jsonl"
        lines = log.read_text().splitlines() if log.exists() else []
        return [json.loads(line) for line in lines]

    def is_complete(self) -> bool:
        counted = self.counted()
        newest = Counter(trial["policy_version"] for trial in counted)[VERSIONS]
        return newest == TRIALS and all(map(self.is_recorded, counted))

    def is_recorded(self, trial: dict[str, Any]) -> bool:
        """Whether a trial has its recording; one whose actor was killed three times has none."""
        unfinished = trial["outcome"]["reason"] == UNFINISHED
        return unfinished or any((self.folder / "rollouts").glob(f"*{trial['episode']}.mcap"))


@pytest.mark.faults
@pytest.mark.timeout(60 * 60)
def test_nothing_is_lost_by_random_faults(tmp_path: Path) -> None:
    run = FaultyRun(tmp_path)
    try:
        while run.done.total() < FAULTS:
            run.fault()
            run.pause()
            assert run.process.poll() is None, run.output.read_text()
        run.calm()
        eventually(run.is_complete, "the run is complete", patience_s=900)
        run.process.send_signal(signal.SIGINT)
        assert run.process.wait(120) == 0
    finally:
        run.calm()
        run.process.kill()
    print(f"seed {SEED}, faults: {dict(run.done)}")

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
    shown = [read_episode(path).seed for path in (run.folder / "tutoring").glob("*.mcap")]
    assert sorted(shown) == [1000 * case for case in CASES], "each case is stored once"
    versions = [
        load_checkpoint(path).metadata.version
        for path in sorted((run.folder / "policies").iterdir())
    ]
    assert versions == list(range(1, VERSIONS + 1))
    log = "".join(path.read_text() for path in sorted((run.folder / "logs").glob("learner.log*")))
    published = [int(number) for number in re.findall(r"policy (\d+) is published", log)]
    assert published == sorted(published), "versions never go back"
    wrong = {".damaged", ".refused", ".part"}
    left = [path for path in run.folder.rglob("*") if path.suffix in wrong]
    assert left == []
