"""Makes an authority, and certificates by which the processes of a run know each other."""

from __future__ import annotations

import argparse
import ipaddress
import re
import socket
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, Self

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from deploy.exit_status import exit_status
from proto.config import HubConfig
from proto.errors import UserError
from proto.permissions import Holder
from proto.security import AUTHORITY, certificate_files, certificate_folder, read_certificate
from proto.storage import storage_errors, written_whole
from services.arguments.common import integer

AUTHORITY_DAYS: Final = 3650
LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
"""The hub's certificate always names these, for processes on the hub's machine."""
_CLOCKS_DIFFER: Final = timedelta(hours=1)


def main(argv: Sequence[str] | None = None) -> int:
    """Make what is missing, or new certificates for all.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status.
    """
    arguments = _parser().parse_args(argv)
    return exit_status("certificates", lambda: _main(arguments))


def _main(arguments: argparse.Namespace) -> None:
    made = make_certificates(
        arguments.out or certificate_folder(HubConfig()),
        hosts=arguments.hosts,
        actors=arguments.actors,
        days=arguments.days,
        renew=arguments.renew,
    )
    for file in made:
        print(file)
    if not made:
        print("all certificates are there; --renew makes new ones", file=sys.stderr)


def make_certificates(
    folder: Path,
    *,
    hosts: Sequence[str] = (),
    actors: Sequence[str] = (),
    days: int = 365,
    renew: bool = False,
) -> list[Path]:
    """Make an authority and a certificate for each holder, as far as they are missing.

    Args:
        folder: where; it is made if it is missing, and others cannot read it.
        hosts: names and addresses of the hub, besides those of this machine.
        actors: names of actors that get certificates of their own, `actor-NAME`.
        days: how long the certificates are valid, at most as long as the authority.
        renew: make all certificates again; the authority stays.

    Returns:
        The certificates that were made.

    Raises:
        UserError: the authority is incomplete or has expired, or a file cannot be written.
    """
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    known = {file.stem for file in certificate_files(folder)}
    names = [*Holder, *sorted(f"{Holder.ACTOR}-{name}" for name in actors)]
    names += sorted(known - {*names})
    new_hosts = bool(hosts)
    if not renew:
        names = [name for name in names if name not in known or (name == Holder.HUB and new_hosts)]
    if not names:
        return []
    authority = Authority.at(folder)
    now = datetime.now(UTC)
    last = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    if last <= now:
        raise UserError(
            f"the authority in {folder} expired on {last:%Y-%m-%d}: make a new one in another"
            " folder with --out, and give its certificates to all machines"
        )
    made = []
    for name in names:
        named: Iterable[str] = ()
        if name == Holder.HUB:
            before = () if new_hosts or name not in known else _hosts_of(folder / f"{name}.crt")
            named = dict.fromkeys([*LOOPBACK, *(hosts or before or [socket.gethostname()])])
        made.append(authority.issue(folder, name, named, now - _CLOCKS_DIFFER, last))
    return made


@dataclass(frozen=True)
class Authority:
    """The authority that all processes of a run trust."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def at(cls, folder: Path) -> Self:
        """Read the authority of a folder; make one if there is none.

        Raises:
            UserError: only one of its two files is there, or one cannot be read or written.
        """
        certificate, key = folder / f"{AUTHORITY}.crt", folder / f"{AUTHORITY}.key"
        if not certificate.exists() and not key.exists():
            made = cls.make()
            _write_key(key, made.key)
            _write_certificate(certificate, made.certificate)
            return made
        try:
            private = load_pem_private_key(key.read_bytes(), None)
        except FileNotFoundError as error:
            raise UserError(
                f"{key} does not exist: certificates are made where the authority is kept"
            ) from error
        except (OSError, ValueError, TypeError) as error:
            raise UserError(f"{key} cannot be read as a private key: {error}") from error
        found = read_certificate(certificate)
        if not isinstance(private, ec.EllipticCurvePrivateKey) or (
            private.public_key() != found.public_key()
        ):
            raise UserError(f"{key} is not the key of {certificate}")
        return cls(found, private)

    @classmethod
    def make(cls) -> Self:
        """Make an authority."""
        key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "vmdnn authority")])
        certificate = (
            _builder(name, name, key, now - _CLOCKS_DIFFER, now + timedelta(days=AUTHORITY_DAYS))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs_certificates=True), critical=True)
            .sign(key, SHA256())
        )
        return cls(certificate, key)

    def issue(
        self, folder: Path, name: str, hosts: Iterable[str], first: datetime, last: datetime
    ) -> Path:
        """Write a new key and a certificate for it.

        Args:
            folder: where.
            name: common name, and name of the files.
            hosts: names and addresses at which its holder listens; none: it only connects.
            first: from when it is valid.
            last: until when it is valid.

        Returns:
            The certificate's file.

        Raises:
            UserError: a file cannot be written.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        hosts = list(hosts)
        use = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        names = [_general_name(host) for host in hosts] or [x509.DNSName(name)]
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate = (
            _builder(subject, self.certificate.subject, key, first, last)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage([use]), critical=False)
            .add_extension(x509.SubjectAlternativeName(names), critical=False)
            .sign(self.key, SHA256())
        )
        _write_key(folder / f"{name}.key", key)
        file = folder / f"{name}.crt"
        _write_certificate(file, certificate)
        return file


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    first: datetime,
    last: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(first)
        .not_valid_after(last)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts_of(file: Path) -> list[str]:
    """Names and addresses in a certificate."""
    try:
        names = read_certificate(file).extensions.get_extension_for_class(
            x509.SubjectAlternativeName
        )
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names.value]


def _write_key(file: Path, key: ec.EllipticCurvePrivateKey) -> None:
    with written_whole(file, mode=0o600) as stream:
        stream.write(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def _write_certificate(file: Path, certificate: x509.Certificate) -> None:
    with written_whole(file) as stream:
        stream.write(certificate.public_bytes(Encoding.PEM))


def _host(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?", text):
        try:
            ipaddress.ip_address(text)
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"{text!r} is no name or address of a machine"
            ) from None
    return text


def _actor(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}", text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no name of an actor: letters, digits, dots, dashes, underscores, at"
            " most 40"
        )
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="certificates", add_help=False)  # certificates.sh has it
    parser.add_argument("--out", type=Path)
    parser.add_argument("--hosts", type=_host, nargs="+", default=[])
    parser.add_argument("--actors", type=_actor, nargs="+", default=[])
    parser.add_argument("--days", type=integer(1, AUTHORITY_DAYS), default=365)
    parser.add_argument("--renew", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
