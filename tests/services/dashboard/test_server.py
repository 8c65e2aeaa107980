"""A dashboard tells over its WebSocket what happens in a run, and lets nobody else listen."""

from __future__ import annotations

import json
import math
import shutil
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ports import free_endpoint
from processes import PATIENCE_S, eventually
from run_metrics import ACTOR, EVALUATOR, LEARNER, score
from staged_run import StagedRun, Told, dashboard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from deploy.certificates import make_certificates
from proto.bus import open_hub
from proto.config import Config, HubConfig, RunConfig
from proto.episode import Episode, Measure, Outcome
from proto.messages import Command
from proto.metrics import EpochMetrics
from proto.periodic import every
from proto.recordings.episodes import write_episode
from services.cli import main
from services.monitoring.history import History, history_file
from services.monitoring.sample import LearnerSample, Sample


class Browser:
    """What a page hears, by topic."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.newest: dict[str, dict[str, Any]] = {}
        self.episodes: list[dict[str, Any]] = []

    def hear(self, until: Callable[[], bool]) -> None:
        over_s = time.monotonic() + PATIENCE_S
        while not until():
            told = json.loads(self.connection.recv(timeout=over_s - time.monotonic()))
            self.newest[told["topic"]] = told
            if told["topic"] == "episodes":
                self.episodes += told["episodes"]

    def ask(self, request: object) -> None:
        self.connection.send(json.dumps(request))

    def process(self, name: str) -> dict[str, Any]:
        found = self.newest.get("processes", {}).get("processes", [])
        return next((each for each in found if each["id"] == name), {})


def browsing(address: str, **given: Any) -> ClientConnection:
    return connect(f"{address.replace('http', 'ws')}/live", **given)


def get(url: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


def test_a_browser_is_told_what_happens(staged: StagedRun, episodes: list[Episode]) -> None:
    told = Told(staged, episodes[1])
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        with every(0.1, told.once):
            browser.hear(lambda: len(browser.episodes) == 3)
            assert {each["id"]: each["reason"] for each in browser.episodes} == {
                "tutored": "imprecise", "failed": "not_lifted", "succeeded": "",
            }  # fmt: skip
            browser.hear(lambda: browser.process("l").get("epoch", 0) > LEARNER.epoch + 3)
            browser.hear(lambda: bool(browser.newest.get("suites", {}).get("suites")))
            (suite,) = browser.newest["suites"]["suites"]
            assert [each["version"] for each in suite["versions"]] == [2, 3]
            assert suite["versions"][1]["strict"][0] == pytest.approx(44 / 52, abs=1e-4)
            browser.hear(lambda: len(browser.newest.get("losses", {}).get("losses", [])) > 2)
            assert not staged.watched("a-1"), "nobody looks at it yet"
            browser.ask({"watch": ["a-1"], "film": ["a-1"]})
            browser.hear(lambda: "actors" in browser.newest and "pictures" in browser.newest)
            actor = browser.newest["actors"]["actors"]["a-1"]
            assert actor["kind"] == "trial"
            assert len(actor["joints"]) == 18
            browser.ask({"watch": [], "film": []})
            eventually(lambda: not staged.watched("a-1"), "nobody looks at it any more")
        staged.leave("a-1")
        browser.hear(lambda: browser.process("a-1").get("gone_s") is not None)


def test_a_page_that_is_opened_late_shows_the_loss_from_the_beginning(
    staged: StagedRun, episodes: list[Episode]
) -> None:
    history = History(history_file(staged.config.run_folder), period_s=1.0)
    stage = LEARNER.stage
    for epoch in range(1, LEARNER.epoch + 3):  # the learner told the last ones again, live
        told = EpochMetrics(stage=stage, epoch=epoch, loss=1.0, learning_rate=0.1)
        learner = LearnerSample(
            **{"training": LEARNER.training, "stage": stage, "round": 0, "epochs": (told,)},
            **{"epochs_per_s": 1.0, "sequences": 3, "policy_version": 0},
        )
        history.add(Sample(time_s=float(epoch), learner=learner))
    history.flush()
    told_now = Told(staged, episodes[1])
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)

        def epochs() -> list[int]:
            losses = browser.newest.get("losses", {}).get("losses", [])
            return [epoch for _, epoch, _ in losses]

        with every(0.1, told_now.once):
            browser.hear(lambda: epochs()[-1:] > [LEARNER.epoch + 4])
        assert epochs()[: LEARNER.epoch] == list(range(1, LEARNER.epoch + 1))
        assert epochs() == sorted(set(epochs())), "none twice"


def test_texts_from_outside_arrive_as_texts(staged: StagedRun) -> None:
    hostile = "<img src=x onerror=alert(1)> </script>"
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        with every(0.1, lambda: staged.tell(replace(ACTOR, waiting_for=hostile))):
            browser.hear(lambda: bool(browser.process("a-1").get("waiting_for")))
        assert browser.process("a-1")["waiting_for"] == hostile


def test_a_run_is_controlled_only_where_that_is_allowed(staged: StagedRun) -> None:
    pause = {"command": "pause", "role": "learner"}
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.ask(pause)
        browser.hear(lambda: "told" in browser.newest)
        assert "--allow-control" in browser.newest["told"]["problem"]
    assert not staged.commands
    with dashboard(staged.config, control=True) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.hear(lambda: bool(browser.newest.get("run", {}).get("connected")))
        browser.ask({"command": "dance", "role": "learner"})
        browser.hear(lambda: "told" in browser.newest)
        assert "there is no dance" in browser.newest.pop("told")["problem"]
        browser.ask(pause)
        browser.hear(lambda: "told" in browser.newest)
        assert browser.newest["told"]["replies"] == ["learner l: done"]
    assert staged.commands == [Command.PAUSE]


@pytest.fixture
def secure(tmp_path: Path) -> Iterator[StagedRun]:
    """A run whose hub asks for certificates; a dashboard of it has that of a watcher only."""
    made, own = tmp_path / "made", tmp_path / "own"
    make_certificates(made)
    own.mkdir(mode=0o700)
    for name in ("authority.crt", "watcher.crt", "watcher.key"):
        shutil.copy(made / name, own)
    hub = HubConfig(
        endpoint=free_endpoint().replace("tcp/", "tls/"), security="mutual-tls", certificates=made
    )
    config = Config(run=RunConfig(name="secure", folder=tmp_path), hub=hub)
    with open_hub(hub, "secure", "hub"):
        run = StagedRun(config)
        try:
            run.join(LEARNER)
            looks = hub.model_copy(update={"certificates": own})
            run.config = config.model_copy(update={"hub": looks})
            yield run
        finally:
            run.close()


def test_with_certificates_only_an_operator_controls_a_run(
    secure: StagedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, own = secure.config, tmp_path / "own"
    with dashboard(config, control=True) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.hear(lambda: bool(browser.newest.get("run", {}).get("connected")))
        browser.ask({"command": "stop", "role": "learner"})
        browser.hear(lambda: "told" in browser.newest)
        (reply,) = browser.newest.pop("told")["replies"]
        assert f"{own}/operator.crt does not exist" in reply
        assert secure.commands == []

        for name in ("operator.crt", "operator.key"):
            shutil.copy(tmp_path / "made" / name, own)
        for command in Command:
            browser.ask({"command": command.value, "role": "learner"})
            browser.hear(lambda: "told" in browser.newest)
            assert browser.newest.pop("told")["replies"] == ["learner l: done"]
        assert secure.commands == list(Command)

    (own / "operator.crt").unlink()
    where = ["--connect", config.hub.endpoint, "--set", f"hub.certificates={own}"]
    assert main(["dashboard", "--allow-control", *where]) == 2
    assert f"{own}/operator.crt does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("request_text", ["{", "[]", "7", '{"watch": 3}', "[" * 3000, "x" * 5000])
def test_a_request_that_makes_no_sense_is_refused(staged: StagedRun, request_text: str) -> None:
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        connection.send(request_text)
        browser.hear(lambda: "told" in browser.newest)
        assert browser.newest["told"]["problem"]


def test_pages_of_others_hear_nothing(staged: StagedRun) -> None:
    with dashboard(staged.config) as address:
        with browsing(address, origin="https://evil.example") as connection:
            with pytest.raises(ConnectionClosed) as refused:
                connection.recv(timeout=PATIENCE_S)
            assert refused.value.rcvd is not None
            assert "not one of this dashboard" in refused.value.rcvd.reason
        status, body, _ = get(address, Host="evil.example")
        assert status == 421
        assert b"another address" in body
        status, _, headers = get(address)
        assert status == 200
        assert "default-src 'self'" in headers["content-security-policy"]


def test_a_browser_that_takes_nothing_holds_up_nobody(staged: StagedRun) -> None:
    versions = tuple(score(number, number % 52, 52) for number in range(1, 201))
    count = 0

    def tell() -> None:
        nonlocal count
        count += 1
        counted = (*versions[:-1], replace(versions[-1], version=1000 + count))
        suite = replace(EVALUATOR.suites[0], policies=counted)
        staged.tell(replace(EVALUATOR, suites=(suite,)))

    def newest() -> int:
        (suite,) = browser.newest.get("suites", {}).get("suites") or [{"versions": []}]
        return suite["versions"][-1]["version"] if suite["versions"] else 0

    with (
        dashboard(staged.config, sends_at_most=8192) as address,
        browsing(address, sock=client_with_small_buffer(address), max_queue=1) as slow,
        browsing(address) as connection,
    ):
        browser = Browser(connection)
        with every(0.1, tell):
            for _ in range(3):  # each is more than all buffers of a connection hold
                before = newest()
                browser.hear(lambda before=before: newest() > max(before, 1000))
        assert slow.recv(timeout=PATIENCE_S), "it is told when it takes something"


def client_with_small_buffer(address: str) -> socket.socket:
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    host, _, port = address.removeprefix("http://").rpartition(":")
    made.connect((host, int(port)))
    return made


def test_a_recording_is_told_step_by_step(staged: StagedRun, episodes: list[Episode]) -> None:
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.hear(lambda: len(browser.episodes) == 3)
        status, body, _ = get(f"{address}/episodes/failed")
        assert status == 200
        told = json.loads(body)
        assert told["steps"] == episodes[1].steps
        assert told["phases"] == episodes[1].phases.tolist()
        assert told["outcome"]["reason"] == "not_lifted"
        for name in ("nothing", "..%2f..%2fconfig", "%2e%2e"):
            assert get(f"{address}/episodes/{name}")[0] == 404
        (staged.config.run_folder / "rollouts" / "failed.mcap").unlink()
        status, body, _ = get(f"{address}/episodes/failed")
        assert status == 404
        assert "recorder.keep" in json.loads(body)["detail"]


def test_what_is_wrong_in_a_recording_keeps_nobody_from_the_others(
    staged: StagedRun, make_episode: Callable[..., Episode]
) -> None:
    measures = {"moved_mm": Measure(math.nan, "mm")}
    odd = make_episode(
        3,
        id="odd",
        situation={"object_y_m": math.inf, "other": ["<b>"]},
        outcome=Outcome(False, False, False, "<i>", measures),
    )
    write_episode(staged.config.run_folder / "rollouts" / "odd.mcap", odd)
    with dashboard(staged.config) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.hear(lambda: len(browser.episodes) == 4)
        (told,) = (each for each in browser.episodes if each["id"] == "odd")
        assert told["situation"] == {"object_y_m": None, "other": "['<b>']"}
        assert json.loads(get(f"{address}/episodes/odd")[1])["outcome"]["reason"] == "<i>"


def test_a_run_without_a_hub_shows_its_recordings(tmp_path: Path, staged: StagedRun) -> None:
    config = staged.config.model_copy(
        update={"hub": staged.config.hub.model_copy(update={"endpoint": "tcp/127.0.0.1:9"})}
    )
    assert config.run_folder.parent == tmp_path
    with dashboard(config) as address, browsing(address) as connection:
        browser = Browser(connection)
        browser.hear(lambda: len(browser.episodes) == 3)
        assert browser.newest["run"]["connected"] is False


def test_replay_needs_something_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["replay", "episode.mcap"])
    assert "--open" in capsys.readouterr().err
