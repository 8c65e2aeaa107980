"""The socket on which a dashboard listens."""

from __future__ import annotations

import errno
import socket
from typing import Final

from proto.errors import UserError

TRIES: Final = 50
"""So many ports after the wanted one are tried."""


class PortTakenError(UserError):
    """Another program listens on the port, now."""


def listening_socket(host: str, port: int, *, or_another: bool = False) -> socket.socket:
    """Open a socket that listens.

    Args:
        host: address of this machine.
        port: the port; 0 for any free one.
        or_another: take the next free port if this one is taken.

    Raises:
        PortTakenError: the port is taken, and so are those after it, if they were tried.
        UserError: nothing can listen at this address.
    """
    last = min(port + TRIES, 2**16 - 1) if or_another and port else port
    for number in range(port, last + 1):
        try:
            return _listen(host, number)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise UserError(
                    f"the dashboard cannot listen at {host}, port {number} ({error.strerror}):"
                    " choose another --port, or as --host an address of this machine"
                ) from error
    raise PortTakenError(
        f"port {port} of {host} is taken, perhaps by the dashboard of another run: choose another"
        " with --port, such as --port 0 for any free one"
    )


def address_of(listening: socket.socket) -> str:
    """The address of the page that a socket serves, such as `http://127.0.0.1:8080`."""
    host, port = listening.getsockname()[:2]
    return page_address(host, port)


def page_address(host: str, port: int) -> str:
    """The address of a page; for all addresses of this machine, with the machine's name."""
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _listen(host: str, port: int) -> socket.socket:
    family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(place)
        listening.listen(64)
    except OSError:
        listening.close()
        raise
    return listening
