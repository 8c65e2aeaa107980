"""Where a hub may listen, and which certificates processes accept as theirs."""

from __future__ import annotations

import logging
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually, listening_hub, run_vmdnn

from deploy.certificates import Authority, make_certificates
from proto.bus import open_bus, open_hub
from proto.config import HubConfig
from proto.errors import UserError
from proto.keys import Role
from proto.metrics import METRICS, Metrics
from proto.permissions import Holder
from proto.security import (
    actor_name,
    certificate_for,
    certificate_of,
    check_link,
    hub_access_control,
    is_loopback,
    reachable,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("certificates")
    make_certificates(made, actors=["vm1"])
    return made


def secure(folder: Path, endpoint: str = "tls/127.0.0.1:7447") -> HubConfig:
    return HubConfig(endpoint=endpoint, security="mutual-tls", certificates=folder)


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.1.2.3:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/10.0.0.1:7447", False),
        ("tcp/hub.example:7447", False),
        ("tcp/localhost.example:7447", False),
    ],
)
def test_without_security_only_this_machine_is_let_in(endpoint: str, local: bool) -> None:
    assert is_loopback(endpoint) is local
    config = HubConfig(endpoint=endpoint)
    if local:
        check_link(config)
        return
    with pytest.raises(UserError, match="can be reached from other machines"):
        check_link(config)
    for connect in (
        lambda: open_hub(config, "test", "hub"),
        lambda: open_bus(config, "test", Role.ACTOR, "actor"),
    ):
        with pytest.raises(UserError, match=r"hub\.insecure=true"):
            connect()


def test_a_hub_that_everyone_can_reach_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    config = HubConfig(endpoint=endpoint, insecure=True)
    with (
        caplog.at_level(logging.WARNING),
        open_hub(config, "test", "hub"),
        open_bus(config, "test", Role.ACTOR, "actor"),
        open_bus(config, "test", Role.ACTOR, "another"),
    ):
        pass
    (said,) = (record.getMessage() for record in caplog.records)
    assert f"everyone who can reach {endpoint} may stop this run" in said


def test_a_process_that_is_not_protected_does_not_start(tmp_path: Path) -> None:
    ended = run_vmdnn("hub", "--connect", "tcp/0.0.0.0:7447")
    assert ended.returncode == 2
    assert "tcp/0.0.0.0:7447 can be reached from other machines" in ended.stderr
    ended = run_vmdnn("watch", "--connect", "tls/hub:7447", "--set", f"hub.certificates={tmp_path}")
    assert ended.returncode == 2
    assert f"{tmp_path}/watcher.crt does not exist: deploy/certificates.sh makes" in ended.stderr


@pytest.mark.parametrize(
    ("endpoint", "security"), [("tcp/127.0.0.1:1", "mutual-tls"), ("tls/127.0.0.1:1", "none")]
)
def test_endpoint_and_security_must_fit(endpoint: str, security: str) -> None:
    config = HubConfig.model_validate({"endpoint": endpoint, "security": security})
    with pytest.raises(UserError, match="mutual-tls needs an endpoint such as tls/HOST:7447"):
        check_link(config)


def test_processes_of_the_hubs_machine_reach_it_on_loopback() -> None:
    assert reachable("tls/0.0.0.0:7447") == "tls/127.0.0.1:7447"
    assert reachable("tls/[::]:7447") == "tls/[::1]:7447"
    assert reachable("tls/10.0.0.0:7447") == "tls/10.0.0.0:7447"


def test_a_key_that_others_can_read_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    assert certificate_for(secure(tmp_path), Holder.LEARNER) is not None
    (tmp_path / "learner.key").chmod(0o644)
    with pytest.raises(UserError, match=f"others can read or replace: chmod 600 {tmp_path}"):
        certificate_for(secure(tmp_path), Holder.LEARNER)


def test_what_is_no_certificate_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "learner.crt").write_bytes(b"\x00nothing")
    with pytest.raises(UserError, match=r"learner\.crt cannot be read as a certificate"):
        certificate_for(secure(tmp_path), Holder.LEARNER)


def test_expiry_is_told_before_and_refused_after(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    authority, now = Authority.at(tmp_path), datetime.now(UTC)
    assert not certificate_of(tmp_path, "hub").expires_soon
    last = now + timedelta(days=12, hours=1)
    authority.issue(tmp_path, "hub", ["127.0.0.1"], now - timedelta(days=1), last)
    soon = certificate_of(tmp_path, "hub")
    assert (soon.days_left, soon.expires_soon) == (12, True)
    authority.issue(tmp_path, "learner", [], now - timedelta(days=2), now - timedelta(days=1))
    with pytest.raises(UserError, match=r"learner\.crt expired on .* --renew makes new ones"):
        certificate_for(secure(tmp_path), Holder.LEARNER)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    words = ("--set", f"hub.certificates={tmp_path}", "--set", "run.name=test")
    with (
        listening_hub(endpoint, *words),
        open_bus(secure(tmp_path, endpoint), "test", Role.WATCH, "watcher") as bus,
    ):
        heard: list[Metrics] = []
        bus.subscribe(bus.keys.metrics(Role.HUB), heard.append, *METRICS)
        eventually(lambda: bool(heard), "the hub tells its metrics")
        assert heard[0].certificate_days == 12


def test_a_machine_shows_the_certificate_of_its_own_actors(folder: Path, tmp_path: Path) -> None:
    assert actor_name(secure(folder)) is None  # actor.crt is there: the shared one
    for name in ("authority.crt", "actor-vm1.crt", "actor-vm1.key"):
        shutil.copy(folder / name, tmp_path)
    assert actor_name(secure(tmp_path)) == "vm1"
    own = certificate_for(secure(tmp_path), Holder.ACTOR)
    assert own is not None
    assert own.name == "actor-vm1"
    shutil.copy(folder / "actor-vm1.crt", tmp_path / "actor-vm2.crt")
    with pytest.raises(UserError, match=r"several actors \(actor-vm1, actor-vm2\)"):
        certificate_for(secure(tmp_path), Holder.ACTOR)


def test_the_name_of_one_actor_cannot_begin_like_that_of_another() -> None:
    with pytest.raises(UserError, match="there cannot be an actor vm1-2 besides it"):
        hub_access_control(HubConfig(actors=("vm1", "vm1-2")))
    hub_access_control(HubConfig(actors=("vm1", "vm12")))
