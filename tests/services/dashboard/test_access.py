"""Who may look at a dashboard, and who may control the run."""

from __future__ import annotations

from pathlib import Path

import pytest
from ports import free_endpoint

from proto.bus import open_hub
from proto.config import HubConfig
from proto.errors import UserError
from services.cli import main
from services.dashboard.access import Access, is_loopback
from services.dashboard.ports import PortTakenError, address_of, listening_socket


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.9.9.9"])
def test_addresses_of_this_machine_alone(host: str) -> None:
    assert is_loopback(host)
    assert Access.of(host, allow_control=True).control


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "example.org", "::", ""])
def test_nobody_else_gets_control(host: str) -> None:
    assert not is_loopback(host)
    with pytest.raises(UserError, match="--allow-control"):
        Access.of(host, allow_control=True)
    assert not Access.of(host, allow_control=False).control


@pytest.mark.parametrize(
    ("host", "is_ours"),
    [
        ("127.0.0.1:8080", True),
        ("localhost:8080", True),
        ("[::1]:8080", True),
        ("evil.example", False),
        ("127.0.0.1.evil.example:8080", False),
        ("", False),
        (None, False),
    ],
)
def test_a_name_that_was_made_to_lead_here_is_refused(host: str | None, is_ours: bool) -> None:
    assert Access("127.0.0.1").is_for_us(host) == is_ours


def test_pages_of_others_are_refused() -> None:
    access = Access("127.0.0.1")
    assert access.is_from_us("http://localhost:8080", "localhost:8080")
    assert access.is_from_us(None, "localhost:8080")
    assert not access.is_from_us("https://evil.example", "localhost:8080")
    assert not access.is_from_us("http://localhost:3000", "localhost:8080")
    assert not access.is_from_us("null", "localhost:8080")


def test_a_taken_port_is_refused_or_another_one_is_used() -> None:
    with listening_socket("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(PortTakenError, match=f"port {port} .* --port"):
            listening_socket("127.0.0.1", port)
        with listening_socket("127.0.0.1", port, or_another=True) as other:
            assert other.getsockname()[1] != port
            assert address_of(other) == f"http://127.0.0.1:{other.getsockname()[1]}"


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(UserError, match="--host"):
        listening_socket("192.0.2.1", 0)


def test_a_run_that_is_not_there_is_bad_input(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["dashboard", "--set", f"run.folder={tmp_path}", "--set", "run.name=nowhere"]
    assert main([*words, "--connect", free_endpoint()]) == 2
    assert "no hub answers" in capsys.readouterr().err
    hub = HubConfig(endpoint=free_endpoint())
    with open_hub(hub, "nowhere", "hub"):
        assert main([*words, "--connect", hub.endpoint]) == 2
    assert "there is nothing of run 'nowhere'" in capsys.readouterr().err


def test_a_taken_port_is_bad_input(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    words = ["dashboard", "--set", f"run.folder={tmp_path}", "--set", "run.name=mine"]
    with listening_socket("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert main([*words, "--port", str(port)]) == 2
    assert f"port {port} of 127.0.0.1 is taken" in capsys.readouterr().err
    assert main([*words, "--host", "0.0.0.0", "--allow-control"]) == 2
    assert "everybody who can open http://0.0.0.0" in capsys.readouterr().err
