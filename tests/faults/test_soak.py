"""Actors come and go for half an hour, and no process grows.

`pytest -m soak tests/faults` plays it; VMDNN_SOAK_MINUTES sets its length, VMDNN_FAULT_SEED what
comes and goes when.
"""

from __future__ import annotations

import os
import random
import signal
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually

from proto.bus import open_bus
from proto.config import HubConfig
from proto.keys import Role
from proto.metrics import ActorMetrics
from services.board import FORGET_AFTER_S, Board

MINUTES = float(os.environ.get("VMDNN_SOAK_MINUTES", "30"))
SEED = int(os.environ.get("VMDNN_FAULT_SEED", "1"))
MOST_ACTORS = 12
LOOK_EVERY_S = 2.0
STAY_S = 20.0
"""How long the number of actors stays the same, once all are there."""
STARTING = 3
"""So many actors start at the same time, at most: each needs some seconds of a processor."""
GROWTH_MIB = 16.0
"""Growth of a process from the second third to the last third that is no leak."""
GROWTH = 0.05
SETTINGS = {
    "run.name": "soak",
    "simulator.render": "false",
    "tutor.repeats": 1,
    "learner.cases": [0, 22, 44],
    "learner.start_sequences": 3,
    "learner.pretraining.epochs": 2,
    "learner.epochs": 10**6,
    "learner.publish_every_epochs": 500,
    "learner.checkpoint_every_epochs": 500,
    "learner.corrections.rounds": 0,
    "evaluator.trials_per_policy": 4,
    "recorder.keep": "{gib: 1, practice: 100}",
    "done": "{}",
}


class Soak:
    """A run under run_local, and actors that come and go beside it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "soak"
        self.endpoint = free_endpoint()
        self._chance = random.Random(SEED)
        self._guests: list[subprocess.Popen[bytes]] = []
        self._numbers: list[int] = []
        self._wanted = 0
        self._there_since_s: float | None = None
        self.came = 0
        self.numbers: list[int] = []
        self.mib: dict[str, list[tuple[float, float]]] = defaultdict(list)
        settings = {**SETTINGS, "run.folder": folder, "hub.endpoint": self.endpoint}
        self._words = [
            word for key, value in settings.items() for word in ("--set", f"{key}={value}")
        ]

    @contextmanager
    def played(self) -> Iterator[subprocess.Popen[bytes]]:
        command = (sys.executable, "-m", "deploy.run_local", "--actors", "1", *self._words)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            for guest in self._guests:
                guest.kill()
            process.send_signal(signal.SIGINT)
            process.wait(180)

    def come_or_go(self, at_s: float, there: int) -> None:
        """Start an actor, or stop or kill one: from one to twelve, with the run's own.

        Args:
            at_s: time since the beginning (s).
            there: number of actors that take part in the run.
        """
        self._guests = [guest for guest in self._guests if guest.poll() is None]
        if there != 1 + self._wanted:
            self._there_since_s = None
        elif self._there_since_s is None:
            self._there_since_s = at_s
            self.numbers.append(there)
        elif at_s - self._there_since_s >= STAY_S:
            self._numbers = self._numbers or self._chance.sample(range(MOST_ACTORS), MOST_ACTORS)
            self._wanted = self._numbers.pop()
        starting = 1 + len(self._guests) - there
        if len(self._guests) < self._wanted and starting < STARTING:
            self.came += 1
            name = f"guest-{self.came}"
            command = (sys.executable, "-m", "services.cli", "actor", "--id", name, *self._words)
            with (self.folder / "logs" / "guests.log").open("ab") as log:
                self._guests.append(subprocess.Popen(command, stdout=log, stderr=log))
        elif len(self._guests) > self._wanted:
            leaving = self._chance.choice(self._guests)
            leaving.send_signal(self._chance.choice((signal.SIGTERM, signal.SIGKILL)))

    def measure(self, now_s: float) -> None:
        """Note the resident memory of each process of the run that lives long."""
        config = str(self.folder / "logs" / "config.yaml")
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError, StopIteration):
                words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
                if config not in words or "setpriv" in words[0]:
                    continue
                status = (process / "status").read_text().splitlines()
                kib = next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))
                self.mib[f"{words[2]} {process.name}"].append((now_s, kib / 1024))


def thirds(measured: list[tuple[float, float]], until_s: float) -> tuple[float, float]:
    """Median memory (MiB) in the second and in the last third of the time."""
    second = [mib for at_s, mib in measured if until_s / 3 <= at_s < 2 * until_s / 3]
    last = [mib for at_s, mib in measured if at_s >= 2 * until_s / 3]
    return statistics.median(second), statistics.median(last)


@pytest.mark.soak
@pytest.mark.timeout(round(MINUTES * 60) + 900)
def test_memory_stays_flat_while_actors_come_and_go(tmp_path: Path) -> None:
    soak = Soak(tmp_path)
    with soak.played() as process:
        eventually(lambda: any(soak.folder.glob("policies/*")), "a policy", 300)
        with open_bus(HubConfig(endpoint=soak.endpoint), "soak", Role.WATCH, "soak") as bus:
            now_s = time.monotonic
            ahead_s = 0.0
            board = Board(bus, clock=lambda: now_s() + ahead_s)
            began_s = now_s()
            shown = 0
            while (at_s := now_s() - began_s) < MINUTES * 60:
                view = board.view()
                soak.come_or_go(at_s, len(view.living(ActorMetrics)))
                soak.measure(at_s)
                shown = max(shown, len(view.vanished_s))
                time.sleep(LOOK_EVERY_S)
            assert process.poll() is None
            now, gone = time.time(), board.view().vanished_s.values()
            assert all(now - each < FORGET_AFTER_S + 60 for each in gone)
            ahead_s = 2 * FORGET_AFTER_S
            assert len(board.view().vanished_s) == 0, "who is gone for good leaves the view"
    print(f"{MINUTES:g} min, seed {SEED}: {soak.came} actors came; there were {soak.numbers}")
    print(f"{len(gone)} that are gone were shown at the end, {shown} at most")
    assert max(soak.numbers) > min(soak.numbers)
    lasting = {
        name: measured
        for name, measured in soak.mib.items()
        if measured[0][0] < at_s / 3 and measured[-1][0] > at_s - 3 * LOOK_EVERY_S - 10
    }
    assert {name.split()[0] for name in lasting} >= {"hub", "learner", "evaluator", "recorder"}
    for name, measured in sorted(lasting.items()):
        before, after = thirds(measured, at_s)
        print(f"{name}: {before:.0f} MiB, then {after:.0f} MiB")
        assert after - before < max(GROWTH_MIB, GROWTH * before), name
