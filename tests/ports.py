"""Free ports for tests that open real sessions."""

from __future__ import annotations

import socket


def free_endpoint() -> str:
    """Return a TCP endpoint on this machine that is not in use."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
