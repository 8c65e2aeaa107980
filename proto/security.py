"""How the links to the hub are protected: certificates, and where a hub may listen.

With `hub.security: mutual-tls` both ends of every link show a certificate of the run's authority,
made by deploy/certificates.sh. docs/security.md says what this protects.
"""

from __future__ import annotations

import functools
import ipaddress
import logging
import re
import stat
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from cryptography import x509

from proto.config import HubConfig
from proto.errors import UserError
from proto.permissions import Holder, access_control

LOG = logging.getLogger(__name__)

WARN_BEFORE_DAYS: Final = 30
"""So long before a certificate expires, doctor, metrics and log say so."""
AUTHORITY: Final = "authority"
"""Name of the authority's files in the folder of certificates."""
_MAKE: Final = "deploy/certificates.sh makes certificates"
_RENEW: Final = "deploy/certificates.sh --renew makes new ones"


@dataclass(frozen=True)
class Certificate:
    """The files with which a process shows who it is.

    Attributes:
        authority: certificate of the authority that both ends trust.
        file: certificate of this process.
        key: its private key.
        name: its common name, which the hub's access control goes by.
        expires: when it, or the authority's, expires.
    """

    authority: Path
    file: Path
    key: Path
    name: str
    expires: datetime

    @property
    def days_left(self) -> int:
        """Whole days until it expires; 0 if it has expired."""
        return max(0, (self.expires - datetime.now(UTC)).days)

    @property
    def expires_soon(self) -> bool:
        """Whether it expires within WARN_BEFORE_DAYS, or has expired."""
        return self.days_left < WARN_BEFORE_DAYS

    @property
    def expiry_words(self) -> str:
        """When it expires, and what to do."""
        return f"{self.file} expires on {self.expires:%Y-%m-%d}: {_RENEW}"


def is_loopback(endpoint: str) -> bool:
    """Whether only processes of this machine can reach an endpoint."""
    host = _host(endpoint).strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def reachable(endpoint: str) -> str:
    """The endpoint at which processes of the hub's machine reach a hub that listens everywhere."""
    for everywhere, loopback in (("/0.0.0.0:", "/127.0.0.1:"), ("/[::]:", "/[::1]:")):
        endpoint = endpoint.replace(everywhere, loopback)
    return endpoint


def check_link(config: HubConfig) -> None:
    """Check that the hub's endpoint and its security fit each other.

    Raises:
        UserError: they do not.
    """
    secure = config.security == "mutual-tls"
    if secure != config.endpoint.startswith("tls/"):
        raise UserError(
            f"hub.security is {config.security}, but hub.endpoint is {config.endpoint}: mutual-tls"
            " needs an endpoint such as tls/HOST:7447, and only mutual-tls can use one"
        )
    if not secure and not config.insecure and not is_loopback(config.endpoint):
        raise UserError(
            f"hub.endpoint: {config.endpoint} can be reached from other machines, and nothing"
            " protects it. Use certificates (hub.security=mutual-tls, docs/security.md), or an"
            " endpoint on this machine such as tcp/127.0.0.1:7447, or say hub.insecure=true if"
            " everyone who can reach it may stop the run and replace its policies"
        )


@functools.cache
def warn_if_insecure(config: HubConfig) -> None:
    """Log that anyone can take part, if the configuration allows it; once in a process."""
    if config.security == "none" and config.insecure and not is_loopback(config.endpoint):
        LOG.warning(
            "hub.insecure: everyone who can reach %s may stop this run, replace its policies and"
            " fill its disk; docs/security.md says how to protect it",
            config.endpoint,
        )


def certificate_for(config: HubConfig, holder: Holder) -> Certificate | None:
    """Find and check the certificate of a process; None without security.

    Raises:
        UserError: endpoint and security do not fit, or the certificate is missing, expired,
            unreadable, or its key can be read by others.
    """
    check_link(config)
    if config.security == "none":
        return None
    folder = certificate_folder(config)
    name = actor_certificate(folder) if holder is Holder.ACTOR else holder.value
    found = certificate_of(folder, name)
    if found.expires <= datetime.now(UTC):
        raise UserError(f"{found.file} expired on {found.expires:%Y-%m-%d}: {_RENEW}")
    return found


def certificate_of(folder: Path, name: str) -> Certificate:
    """Read a certificate, whether it has expired or not.

    Args:
        folder: where it is, with its key and the authority's certificate.
        name: name of its files.

    Raises:
        UserError: a file is missing or unreadable, or others can read the key.
    """
    file, key = folder / f"{name}.crt", folder / f"{name}.key"
    authority = folder / f"{AUTHORITY}.crt"
    certificates = [read_certificate(each) for each in (file, authority)]
    _check_private(key)
    expires = min(each.not_valid_after_utc for each in certificates)
    return Certificate(authority, file, key, common_name(certificates[0]), expires)


def certificate_files(folder: Path) -> list[Path]:
    """The certificates in a folder, without the authority's."""
    return sorted(file for file in folder.glob("*.crt") if file.stem != AUTHORITY)


def certificate_folder(config: HubConfig) -> Path:
    """Folder of this machine's certificates.

    Raises:
        UserError: it is in the home folder, and there is none.
    """
    try:
        return config.certificates.expanduser()
    except RuntimeError as error:
        raise UserError(f"hub.certificates: {config.certificates}: {error}") from error


def actor_certificate(folder: Path) -> str:
    """Name of the certificate that actors on this machine show: `actor`, or `actor-NAME`.

    Raises:
        UserError: the folder holds several certificates `actor-NAME`.
    """
    own = sorted(file.stem for file in folder.glob(f"{Holder.ACTOR}-*.crt"))
    if (folder / f"{Holder.ACTOR}.crt").exists() or not own:
        return Holder.ACTOR.value
    if len(own) > 1:
        raise UserError(
            f"{folder} holds the certificates of several actors ({', '.join(own)}): give each"
            " machine a folder with its own"
        )
    return own[0]


def actor_name(config: HubConfig) -> str | None:
    """Name to which this machine's actors are bound by a certificate `actor-NAME`, if any."""
    if config.security == "none":
        return None
    return actor_certificate(certificate_folder(config)).partition("-")[2] or None


def read_certificate(file: Path) -> x509.Certificate:
    """Read a certificate.

    Raises:
        UserError: the file is missing or holds none.
    """
    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except FileNotFoundError as error:
        raise UserError(
            f"{file} does not exist: {_MAKE}, and hub.certificates names their folder"
        ) from error
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read as a certificate: {error}") from error


def common_name(certificate: x509.Certificate) -> str:
    """The common name of a certificate, empty if it has none."""
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def link_settings(certificate: Certificate | None, *, listens: bool) -> dict[str, Any]:
    """Settings of Zenoh's links, for the section `transport/link`.

    Args:
        certificate: what this process shows; None without security.
        listens: whether this process is the hub.
    """
    if certificate is None:
        return {}
    end = "listen" if listens else "connect"
    return {
        "protocols": ["tls"],
        "tls": {
            "root_ca_certificate": str(certificate.authority),
            f"{end}_certificate": str(certificate.file),
            f"{end}_private_key": str(certificate.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def hub_access_control(config: HubConfig) -> dict[str, Any]:
    """The hub's access control.

    Raises:
        UserError: `hub.actors` has names of which one begins like another.
    """
    for name in config.actors:
        for other in config.actors:
            if other.startswith(f"{name}-") or (name == other and config.actors.count(name) > 1):
                raise UserError(
                    f"hub.actors: {name} may act as {name}-1, {name}-2 and so on, so there cannot"
                    f" be an actor {other} besides it: rename one"
                )
    return access_control(config.actors)


def _host(endpoint: str) -> str:
    return re.sub(r"^\w+/(.*):\d+$", r"\1", endpoint)


def _check_private(key: Path) -> None:
    try:
        mode = key.stat().st_mode
        key.open("rb").close()
    except FileNotFoundError as error:
        raise UserError(f"{key} does not exist: {_MAKE}") from error
    except OSError as error:
        raise UserError(f"{key} cannot be read: {error.strerror}") from error
    # The group may read it, because secrets in containers are often mounted so.
    if mode & (stat.S_IWGRP | stat.S_IRWXO):
        raise UserError(f"{key} is a private key that others can read or replace: chmod 600 {key}")
