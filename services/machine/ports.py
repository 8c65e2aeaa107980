"""Checks whether the hub can listen on its endpoint."""

from __future__ import annotations

import errno
import socket


def port_trouble(endpoint: str) -> str | None:
    """Check whether a process can listen on an endpoint such as `tcp/127.0.0.1:7447`.

    Returns:
        The problem and what to do; None if there is no problem.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    kind = socket.SOCK_DGRAM if protocol in {"udp", "quic"} else socket.SOCK_STREAM
    try:
        family, _, _, _, place = socket.getaddrinfo(host.strip("[]"), port, type=kind)[0]
        with socket.socket(family, kind) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return (
                f"hub.endpoint: {endpoint} is in use, perhaps by another run. Stop that run, or "
                f"choose another port with --set hub.endpoint={protocol}/{host}:PORT"
            )
        return (
            f"hub.endpoint: nothing can listen at {endpoint} on this machine ({error}). Set "
            f"hub.endpoint to an address of this machine, such as {protocol}/127.0.0.1:7447"
        )
    return None
