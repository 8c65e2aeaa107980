"""A person tutors through the page; somebody else, a lost connection and bad requests are told."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ports import free_endpoint
from processes import eventually, listening_hub, stop, vmdnn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from proto.episode import Kind
from proto.recordings.episodes import read_episode
from services.cli import main

MINUTES_S = 600.0
REPLAYED = 72
"""Control steps after which the hand is above the object."""


@contextmanager
def tutoring(folder: Path, *words: str) -> Iterator[str]:
    """Run `vmdnn tutor --by-hand`; its address."""
    log = folder.with_suffix(".log")
    options = ("--by-hand", "--backend", "mujoco", "--out", str(folder), "--port", "0")
    with vmdnn("tutor", *options, *words, log=log) as process:
        eventually(lambda: "(Ctrl-C ends)" in log.read_text(), "its address")
        (address,) = re.findall(r"http://\S+", log.read_text())
        yield address
        assert stop(process) == 0, log.read_text()


def told(browser: ClientConnection, reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Wait until something is told."""
    while True:
        content: dict[str, Any] = json.loads(browser.recv(timeout=MINUTES_S))
        if reached(content):
            return content


def is_done(number: int) -> Callable[[dict[str, Any]], bool]:
    return lambda told: (
        told["topic"] == "robot"
        and told["done"] == number
        and not told.get("busy")
        and "waiting" not in told
    )


def ask(browser: ClientConnection, number: int, what: str, **given: Any) -> None:
    browser.send(json.dumps({"id": number, "do": what, **given}))


def test_one_person_at_a_time_and_nothing_is_lost(tmp_path: Path) -> None:
    with tutoring(tmp_path / "shown", "--cases", "0") as address:
        url = address.replace("http", "ws") + "/robot"
        with connect(url) as browser:
            told(browser, lambda told: told["topic"] == "pictures")
            ask(browser, 0, "pace", factor=0)
            for wrong in ("{", "[]", '{"id": 1, "do": "fly"}', '{"id": 1, "do": ["move"]}'):
                browser.send(wrong)
                told(browser, lambda told: told["topic"] == "refused")
            ask(browser, 1, "move", x=1e6)
            problem = told(browser, lambda told: told["topic"] == "refused")["problem"]
            assert "must be from" in problem
            ask(browser, 1, "move", z=0.02)
            steps = told(browser, is_done(1))["steps"]
            assert steps > 0
            with connect(url) as other, pytest.raises(ConnectionClosed, match="in another window"):
                other.recv(timeout=60)
            ask(browser, 2, "keep")
            assert "finish" in told(browser, is_done(2))["problem"]
            ask(browser, 0, "pace", factor=0.1)
            ask(browser, 3, "move", z=0.05)
            told(browser, lambda told: told["topic"] == "robot" and told["steps"] > steps)
        # The person has left while the robot moved: it stands still where it was.

        def is_free() -> bool:
            with connect(url) as again:
                try:
                    again.recv(timeout=60)
                except ConnectionClosed:
                    return False
                return True

        eventually(is_free, "the robot is free for the next person")
        with connect(url) as again:
            stopped = told(again, is_done(3))
            assert steps < stopped["steps"] <= steps + 2
            ask(again, 0, "pace", factor=0)
            ask(again, 4, "undo")
            assert told(again, is_done(4))["steps"] == steps
            ask(again, 5, "move", z=0.02)
            told(again, is_done(5))
            ask(again, 6, "restart")
            assert told(again, is_done(6))["steps"] == 0
            ask(again, 7, "next")
            told(again, is_done(7))
            ask(again, 8, "discard")
            forgotten = told(again, is_done(8))
            assert (forgotten["phase"], forgotten["undo"], forgotten["kept"]) == (0, False, 0)


def test_a_correction_is_recorded(tmp_path: Path) -> None:
    folder = tmp_path / "shown"
    with (
        tutoring(folder, "--cases", "23", "--policy", "replay") as address,
        connect(address.replace("http", "ws") + "/robot") as browser,
    ):
        ask(browser, 0, "pace", factor=0)
        begun = told(browser, is_done(0))
        assert (begun["kind"], begun["policy"]) == ("correction", "replay, version 0")
        ask(browser, 1, "act")
        told(browser, lambda told: told["topic"] == "robot" and told["steps"] >= REPLAYED)
        ask(browser, 2, "move", turn=-20)  # it takes over from the policy
        taken = told(browser, is_done(2))
        assert taken["corrected"]
        assert taken["can_act"]
        ask(browser, 3, "act")
        told(browser, is_done(3))
        ask(browser, 4, "finish")
        assert told(browser, is_done(4))["outcome"] is not None
        ask(browser, 5, "keep")
        assert told(browser, is_done(5))["kept"] == 1
    (recorded,) = folder.glob("*.mcap")
    episode = read_episode(recorded)
    assert (episode.kind, episode.policy) == (Kind.CORRECTION, "by-hand")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_learner_keeps_what_it_asked_for(tmp_path: Path) -> None:
    """A case, and a correction of the policy that was trained on it."""
    settings = {
        "run.name": "asked",
        "run.folder": tmp_path,
        "simulator.backend": "mujoco",
        "tutor.repeats": 1,
        "learner.cases": [23],
        "learner.start_sequences": 1,
        "learner.pretraining.epochs": 0,
        "learner.epochs": 2,
        "learner.publish_every_epochs": 2,
        "learner.corrections": {"rounds": 1, "choose": "random", "sequences": 1, "epochs": 1},
    }
    endpoint, log = free_endpoint(), tmp_path / "tutor.log"
    words = ["--connect", endpoint]
    for key, value in settings.items():
        words += ["--set", f"{key}={value}"]
    with (
        listening_hub(endpoint, "--set", "run.name=asked"),
        vmdnn("learner", *words, log=tmp_path / "learner.log") as learner,
        vmdnn("tutor", "--by-hand", "--port", "0", *words, log=log) as tutor,
    ):
        eventually(lambda: "(Ctrl-C ends)" in log.read_text(), "its address", MINUTES_S)
        (address,) = re.findall(r"http://\S+", log.read_text())
        with connect(address.replace("http", "ws") + "/robot") as browser:
            ask(browser, 0, "pace", factor=0)
            assert told(browser, is_done(0))["kind"] == "tutoring"
            for number in range(1, 8):
                ask(browser, number, "next")
                told(browser, is_done(number))
            ask(browser, 8, "move", z=0.02)
            told(browser, is_done(8))
            ask(browser, 9, "finish")
            told(browser, is_done(9))
            ask(browser, 10, "keep")
            asked = told(browser, lambda told: told.get("kind") == "correction")
            assert (asked["can_act"], asked["kept"]) == (True, 1)
            ask(browser, 11, "act")
            told(browser, lambda told: told.get("steps", 0) >= REPLAYED)
            ask(browser, 12, "move", z=0.02)
            told(browser, is_done(12))
            ask(browser, 13, "act")
            told(browser, is_done(13))
            ask(browser, 14, "finish")
            assert told(browser, is_done(14))["problem"] == ""
            ask(browser, 15, "keep")
            folder = tmp_path / "asked"
            eventually(
                (folder / "policies" / "000002.safetensors").exists,
                "a policy that has learned from the correction",
                MINUTES_S,
            )
        assert stop(tutor) == 0, log.read_text()
        assert stop(learner) == 0
    kept = [read_episode(file) for file in (folder / "tutoring").glob("*.mcap")]
    assert {(each.kind, each.policy, each.policy_version) for each in kept} == {
        (Kind.TUTORING, "by-hand", 0),
        (Kind.CORRECTION, "by-hand", 1),
    }
    assert not list((folder / "outbox").glob("*/*/*"))


def test_a_taken_port_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["tutor", "--by-hand", "--backend", "mujoco", "--out", str(tmp_path / "out")]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main([*words, "--port", port]) == 2
    assert f"port {port} of 127.0.0.1 is taken" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--by-hand", "--out", "out", "--json"], "--json"),
        (["--by-hand"], "--out"),
        ([], "--out"),
        (["--out", "out", "--policy", "replay"], "--policy"),
        (["--by-hand", "--connect", "tcp/127.0.0.1:7", "--out", "out"], "--out"),
        (["--by-hand", "--out", "out", "--policy", "nobody"], "nobody"),
    ],
)
def test_options_that_do_not_fit_are_bad_input(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tutor", "--backend", "mujoco", *words]) == 2
    assert named in capsys.readouterr().err
