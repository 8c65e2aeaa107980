"""Who may look at a dashboard, and who may control the run through it.

A page of another site can make a browser send requests to this machine. So a request must be for
the address at which the dashboard listens, and a connection that reads the run must come from one
of the dashboard's own pages.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit

from proto.errors import UserError

HEADERS: Final[Mapping[str, str]] = {
    # `data:` is for pictures that the page makes itself.
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none';"
        " frame-ancestors 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Headers of every answer: the page loads nothing from elsewhere, and is shown in no other page."""


@dataclass(frozen=True)
class Access:
    """Who may do what.

    Attributes:
        host: the address at which the dashboard listens.
        control: whether a viewer may pause, resume and stop the processes of the run.
    """

    host: str
    control: bool = False

    @classmethod
    def of(cls, host: str, *, allow_control: bool) -> Access:
        """Decide who may do what.

        Control is given to whoever opens the page. So it is given only where no other machine can
        open it; a page that knows who opens it could give it to an operator.

        Raises:
            UserError: control is wanted on an address that other machines can reach.
        """
        if allow_control and not is_loopback(host):
            raise UserError(
                f"--allow-control: everybody who can open http://{host} could stop the run; leave "
                "out --host, so that the page is only for this machine, or leave out "
                "--allow-control"
            )
        return cls(host, allow_control)

    def is_for_us(self, host: str | None) -> bool:
        """Whether a request with the header `Host` is for this dashboard.

        On an address that only this machine reaches, another name means that a page elsewhere has
        made its name lead here.
        """
        if not is_loopback(self.host):
            return True
        name = urlsplit(f"//{host or ''}").hostname or ""
        return name == "localhost" or is_loopback(name)

    def is_from_us(self, origin: str | None, host: str | None) -> bool:
        """Whether a connection with the header `Origin` comes from a page of this dashboard.

        Programs other than browsers send no `Origin`; they could as well listen to the bus.
        """
        return origin is None or urlsplit(origin).netloc == host


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
