"""A person tutors through the page; somebody else, a lost connection and bad requests are told."""

from __future__ import annotations

import json
import re
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from processes import eventually, stop, vmdnn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from actors.tasks.registry import make_task
from proto.config import Config, SimulatorConfig
from services.by_hand.robot import Robot
from services.by_hand.server import make_app
from services.cli import main
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.server import serving
from services.playing.tutoring import Case

CHROMIUM = shutil.which("chromium")
SITUATIONS = 20
FIRST_SEED = 100_000


@contextmanager
def tutoring(folder: Path, *words: str) -> Iterator[str]:
    """Run `vmdnn tutor --by-hand`; its address."""
    log = folder.with_suffix(".log")
    options = ("--by-hand", "--backend", "mujoco", "--out", str(folder), "--port", "0")
    with vmdnn("tutor", *options, *words, log=log) as process:
        eventually(lambda: "(Ctrl-C ends)" in log.read_text(), "its address")
        (address,) = re.findall(r"http://\S+", log.read_text())
        yield address
        assert stop(process) == 0


def told(browser: ClientConnection, reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Wait until something is told."""
    while True:
        content: dict[str, Any] = json.loads(browser.recv(timeout=60))
        if reached(content):
            return content


def is_done(number: int) -> Callable[[dict[str, Any]], bool]:
    return lambda told: told["topic"] == "robot" and told["done"] == number and not told["busy"]


def test_one_person_at_a_time_and_nothing_is_lost(tmp_path: Path) -> None:
    config = Config(simulator=SimulatorConfig(backend="mujoco"))
    cases = [Case.tutored(make_task(config.task), 0)]
    robot, listening = Robot(config, cases, tmp_path / "shown"), listening_socket("127.0.0.1", 0)
    with robot.working(), serving(make_app(robot, Access("127.0.0.1")), listening):
        url = address_of(listening).replace("http", "ws") + "/robot"
        with connect(url) as browser:
            told(browser, lambda told: told["topic"] == "pictures")
            browser.send(json.dumps({"id": 0, "do": "pace", "factor": 0}))
            for wrong in ("{", "[]", '{"id": 1, "do": "fly"}', '{"id": 1, "do": ["move"]}'):
                browser.send(wrong)
                told(browser, lambda told: told["topic"] == "refused")
            browser.send(json.dumps({"id": 1, "do": "move", "x": 1e6}))
            problem = told(browser, lambda told: told["topic"] == "refused")["problem"]
            assert "must be from" in problem
            browser.send(json.dumps({"id": 1, "do": "move", "z": 0.02}))
            steps = told(browser, is_done(1))["steps"]
            assert steps > 0
            with connect(url) as other, pytest.raises(ConnectionClosed, match="in another window"):
                other.recv(timeout=60)
            browser.send(json.dumps({"id": 2, "do": "keep"}))
            assert "finish" in told(browser, is_done(2))["problem"]

        def is_free() -> bool:
            with connect(url) as again:
                try:
                    again.recv(timeout=60)
                except ConnectionClosed:
                    return False
                return True

        eventually(is_free, "the robot is free for the next person")
        with connect(url) as again:
            assert told(again, is_done(2))["steps"] == steps
            again.send(json.dumps({"id": 3, "do": "undo"}))
            assert told(again, is_done(3))["steps"] == 0


def test_a_taken_port_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["tutor", "--by-hand", "--backend", "mujoco", "--out", str(tmp_path / "out")]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main([*words, "--port", port]) == 2
    assert f"port {port} of 127.0.0.1 is taken" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*words, "--json"]) == 2
    assert "--json" in capsys.readouterr().err
