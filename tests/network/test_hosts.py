"""A run on four hosts with bad links: it ends, nothing is lost, nothing is counted twice.

Run with `pytest -m network` as root; it takes some minutes.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from network.hosts import Host, Network, network
from processes import eventually

from deploy.certificates import make_certificates
from proto.config import load_config
from proto.recordings.episodes import read_episode
from services.arguments.common import config_file

PORT = 7447
CUT_S = 20.0
PATIENCE_S = 1500.0
RUN = "smoke"


class Run:
    """The smoke run on hosts: hub and learner, evaluator and recorder, and twice actors."""

    def __init__(self, net: Network, folder: Path) -> None:
        self.net = net
        self.center, self.counting, self.bad, self.good = (net.host(n) for n in (1, 2, 3, 4))
        self._certificates = folder / "certificates"
        make_certificates(
            self._certificates,
            hosts=[self.center.address, net.switch.address],
            actors=["vm4"],
        )
        config = load_config(config_file(RUN))
        assert config.done.policy_versions is not None
        self.versions, self.trials = config.done.policy_versions, config.done.trials

    def certificates(self, host: Host, *names: str) -> Path:
        """Give a host its certificates."""
        folder = host.folder / "certificates"
        folder.mkdir(exist_ok=True)
        for file in ("authority.crt", *(f"{n}.{end}" for n in names for end in ("crt", "key"))):
            shutil.copy(self._certificates / file, folder)
        return folder

    def start_services(self) -> None:
        center, counting = self.center, self.counting
        words = (
            *("--config", RUN, "--connect", f"tls/0.0.0.0:{PORT}", "--set", "hub.actors=[vm4]"),
            *("--set", f"hub.certificates={self.certificates(center, 'hub', 'learner')}"),
        )
        for role in ("hub", "learner"):
            center.start("services.cli", role, *words, log=f"{role}.log")
        words = (
            *("--run", RUN, "--connect", f"tls/{center.address}:{PORT}"),
            *("--set", f"hub.certificates={self.certificates(counting, 'evaluator', 'recorder')}"),
        )
        for role in ("evaluator", "recorder"):
            counting.start("services.cli", role, *words, log=f"{role}.log")

    def join(self, host: Host, address: str, certificate: str) -> None:
        host.start(
            *("deploy.join", "--hub", f"tls/{address}:{PORT}", "--run", RUN, "--actors", "1"),
            *("--certificates", self.certificates(host, certificate)),
            log="join.log",
        )

    def stored(self) -> int:
        """Sequences that the learner has on disk."""
        folder = self.center.folder / "runs" / RUN
        return sum(
            len(list((folder / each).glob("*.mcap"))) for each in ("tutoring", "pretraining")
        )

    def counted(self) -> list[dict[str, object]]:
        """Trials that the evaluator has counted."""
        log = self.counting.folder / "runs" / RUN / "evaluation" / "trials.jsonl"
        lines = log.read_bytes().splitlines() if log.exists() else []
        return [json.loads(line) for line in lines]

    def is_done(self) -> bool:
        newest = [trial for trial in self.counted() if trial["policy_version"] == self.versions]
        return len(newest) >= (self.trials or 0)

    def waiting(self, host: Host) -> list[Path]:
        """Episodes in the outboxes of a host."""
        return list((host.folder / "runs" / RUN / "outbox").glob("*/*/*.message"))


@pytest.fixture
def played(tmp_path: Path) -> Iterator[Run]:
    with network(tmp_path) as net:
        yield Run(net, tmp_path)


@pytest.mark.network
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("trouble", [("cut",), ("loss",), ("delay",), ("cut", "loss", "delay")])
def test_a_run_on_four_hosts_survives_a_bad_link(played: Run, trouble: tuple[str, ...]) -> None:
    address = played.center.address
    if "loss" in trouble:
        played.bad.lose_packets(5)
    if "delay" in trouble:
        address = played.net.relay(played.center, PORT, 0.1)
    played.join(played.bad, address, "actor")  # before there is a hub
    played.start_services()
    eventually(lambda: played.stored() > 0, "a sequence is stored", PATIENCE_S)
    played.join(played.good, played.center.address, "actor-vm4")
    if "cut" in trouble:
        played.bad.cut()
        time.sleep(CUT_S)
        played.bad.heal()
    eventually(played.is_done, "the newest policy has its trials", PATIENCE_S)

    actors = (played.bad, played.good)
    for host in actors:
        assert host.stop() == [0]
    left = [message for host in actors for message in played.waiting(host)]
    # What they had not sent when they were stopped is sent by the next process.
    for host, certificate, at in zip(
        actors, ("actor", "actor-vm4"), (address, played.center.address), strict=True
    ):
        played.join(host, at, certificate)
    for host in actors:
        again = partial(host.has_said_twice, "1 actor for the run", "join.log")
        eventually(again, "it joins again", PATIENCE_S)
    eventually(
        lambda: not any(message.exists() for message in left),
        "everything has its receipts",
        PATIENCE_S,
    )
    for host in (*actors, played.counting, played.center):
        assert set(host.stop()) == {0}

    trials = played.counted()
    keys = Counter((trial["policy_version"], trial["seed"]) for trial in trials)
    assert set(keys.values()) == {1}
    assert len({trial["episode"] for trial in trials}) == len(trials)
    recorded = {
        file.stem.rpartition("_")[2]
        for file in (played.counting.folder / "runs" / RUN).glob("rollouts/*.mcap")
    }
    assert {trial["episode"] for trial in trials} <= recorded
    tutored = [
        read_episode(file)
        for each in ("tutoring", "pretraining")
        for file in (played.center.folder / "runs" / RUN / each).glob("*.mcap")
    ]
    shown = Counter((episode.task, episode.kind, episode.seed) for episode in tutored)
    assert set(shown.values()) == {1}
    for host in actors:
        assert not list((host.folder / "runs" / RUN / "outbox").glob("*/*/*.damaged"))
    log = "".join(
        file.read_text() for file in (played.bad.folder / "runs" / RUN / "logs").glob("actor*.log*")
    )
    assert "lost the hub" in log or "cut" not in trouble
    ids = {path.name for path in (played.good.folder / "runs" / RUN / "outbox").iterdir()}
    assert ids == {"vm4-1"}
