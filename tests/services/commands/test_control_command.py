"""`vmdnn control` reaches real processes and prints their replies, or that there are none."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually, listening_hub, run_vmdnn, vmdnn

from proto.bus import open_bus
from proto.config import HubConfig
from proto.keys import Role
from proto.metrics import EvaluatorMetrics


class Processes:
    """A hub and an evaluator of the run `controlled`."""

    def __init__(self, endpoint: str, evaluator: Popen[bytes]) -> None:
        self.evaluator = evaluator
        self._endpoint = endpoint

    def control(self, *words: str) -> tuple[int, str, str]:
        where = ("--connect", self._endpoint, "--set", "run.name=controlled")
        ended = run_vmdnn("control", *words, *where)
        return ended.returncode, ended.stdout, ended.stderr


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    endpoint = free_endpoint()
    words = ("--connect", endpoint, "--set", "run.name=controlled")
    metrics: list[EvaluatorMetrics] = []
    with (
        listening_hub(endpoint, "--set", "run.name=controlled"),
        vmdnn("evaluator", *words, "--set", f"run.folder={tmp_path}") as evaluator,
        open_bus(HubConfig(endpoint=endpoint), "controlled", Role.WATCH, "w") as bus,
    ):
        bus.subscribe(bus.keys.metrics(Role.EVALUATOR), metrics.append, EvaluatorMetrics)
        eventually(lambda: bool(metrics), "the evaluator is ready")
        yield Processes(endpoint, evaluator)


def test_each_process_of_the_role_replies(processes: Processes) -> None:
    assert processes.control("evaluator", "pause") == (0, "evaluator evaluator: paused\n", "")
    assert processes.control("evaluator", "resume") == (0, "evaluator evaluator: resumed\n", "")
    status, output, _ = processes.control("hub", "checkpoint", "--json")
    assert status == 0
    assert json.loads(output) == [{"role": "hub", "id": "hub", "note": "a hub stores nothing"}]
    assert processes.control("evaluator", "stop") == (0, "evaluator evaluator: stopping\n", "")
    assert processes.evaluator.wait(PATIENCE_S) == 0


def test_a_role_without_processes_is_an_error_with_advice(processes: Processes) -> None:
    status, output, errors = processes.control("recorder", "stop")
    assert (status, output) == (1, "")
    assert "no recorder of run 'controlled' replies" in errors
    assert "vmdnn watch --once" in errors
    assert processes.evaluator.poll() is None


def test_an_unknown_command_is_bad_input(processes: Processes) -> None:
    status, _, errors = processes.control("evaluator", "restart")
    assert status == 2
    assert "invalid choice: 'restart'" in errors
