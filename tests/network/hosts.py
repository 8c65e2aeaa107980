"""Hosts on this machine: network namespaces at a switch, whose links can be disturbed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

RELAY = Path(__file__).with_name("relay.py")
STOP_WITHIN_S = 60.0


def run(*words: str | Path) -> None:
    """Run a command that must succeed."""
    subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True)


class Host:
    """A host with an address, a folder, and a link to the switch."""

    def __init__(self, name: str, switch: str, number: int, folder: Path) -> None:
        self.address = f"10.77.0.{number}"
        self.folder = folder
        self.folder.mkdir()
        self._name = name
        self._switch = switch
        self._port = f"port{number}"
        self._processes: list[subprocess.Popen[bytes]] = []

    def plug_in(self) -> None:
        """Connect the host to the switch."""
        run("ip", "netns", "add", self._name)
        run(
            *("ip", "-n", self._switch, "link", "add", self._port, "type", "veth"),
            *("peer", "name", "eth0", "netns", self._name),
        )
        run("ip", "-n", self._switch, "link", "set", self._port, "master", "bridge", "up")
        run("ip", "-n", self._name, "addr", "add", f"{self.address}/24", "dev", "eth0")
        for link in ("lo", "eth0"):
            run("ip", "-n", self._name, "link", "set", link, "up")

    def start(self, *words: str | Path, log: str) -> subprocess.Popen[bytes]:
        """Start `python -m WORDS` there; its output goes to a file in the host's folder."""
        python = (sys.executable, "-m", *map(str, words))
        with (self.folder / log).open("ab") as stream:
            process = subprocess.Popen(
                ("ip", "netns", "exec", self._name, *python),
                stdout=stream,
                stderr=stream,
                cwd=self.folder,
                env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
            )
        self._processes.append(process)
        return process

    def has_said_twice(self, text: str, log: str) -> bool:
        """Whether processes there have written a text twice."""
        return (self.folder / log).read_text().count(text) == 2

    def cut(self) -> None:
        """Cut the host's link."""
        run("ip", "-n", self._switch, "link", "set", self._port, "down")

    def heal(self) -> None:
        """Mend the host's link."""
        run("ip", "-n", self._switch, "link", "set", self._port, "up")

    def lose_packets(self, percent: int) -> None:
        """Lose packets at random that the host sends or receives."""
        table = f"""
        table inet lossy {{
            chain input {{
                type filter hook input priority 0
                iifname "eth0" numgen random mod 100 < {percent} drop
            }}
            chain output {{
                type filter hook output priority 0
                oifname "eth0" numgen random mod 100 < {percent} drop
            }}
        }}"""
        subprocess.run(
            ("ip", "netns", "exec", self._name, "nft", "-f", "-"),
            input=table.encode(),
            check=True,
        )

    def stop(self) -> list[int]:
        """Stop the processes started there, the last first; gives their exit statuses."""
        statuses = []
        for process in reversed(self._processes):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            statuses.append(process.wait(STOP_WITHIN_S))
        self._processes.clear()
        return statuses

    def close(self) -> None:
        """End what still runs, and remove the host."""
        for process in self._processes:
            process.kill()
            process.wait()
        subprocess.run(("ip", "netns", "del", self._name), check=False)


class Network:
    """Hosts at a switch."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack = stack
        self._folder = folder
        self._prefix = f"vmdnn-{os.getpid()}"
        self.switch = Host(f"{self._prefix}-switch", "", 254, folder / "switch")
        run("ip", "netns", "add", f"{self._prefix}-switch")
        stack.callback(self.switch.close)
        name = f"{self._prefix}-switch"
        run("ip", "-n", name, "link", "add", "bridge", "type", "bridge")
        run("ip", "-n", name, "addr", "add", f"{self.switch.address}/24", "dev", "bridge")
        for link in ("lo", "bridge"):
            run("ip", "-n", name, "link", "set", link, "up")

    def host(self, number: int) -> Host:
        """Make a host."""
        host = Host(
            f"{self._prefix}-{number}",
            f"{self._prefix}-switch",
            number,
            self._folder / f"host{number}",
        )
        self._stack.callback(host.close)
        host.plug_in()
        return host

    def relay(self, to: Host, port: int, delay_s: float) -> str:
        """Start a relay at the switch that delays what goes through it; gives its address."""
        with (self.switch.folder / "relay.log").open("ab") as stream:
            process = subprocess.Popen(
                (
                    *("ip", "netns", "exec", f"{self._prefix}-switch", sys.executable, RELAY),
                    *(self.switch.address, str(port), to.address, str(delay_s)),
                ),
                stdout=stream,
                stderr=stream,
            )

        def end() -> None:
            process.kill()
            process.wait()

        self._stack.callback(end)
        return self.switch.address


@contextmanager
def network(folder: Path) -> Iterator[Network]:
    """Make a network; skip the test where this user has no right to."""
    for tool in ("ip", "nft"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is missing: install iproute2 and nftables")
    name = f"vmdnn-{os.getpid()}-probe"
    made = subprocess.run(("ip", "netns", "add", name), capture_output=True, check=False)
    if made.returncode != 0:
        pytest.skip(f"no right to make network namespaces: {made.stderr.decode().strip()}")
    run("ip", "netns", "del", name)
    with ExitStack() as stack:
        yield Network(stack, folder)
