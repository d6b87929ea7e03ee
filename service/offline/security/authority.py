"""A site's certificate authority: makes the certificates of its vehicles and people, and renews them.

The role stands in the certificate as its organisational unit. ca.key signs: it stays on this machine.
"""

import ipaddress
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal, cast, get_args

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from service.errors import InputError, StorageError, words_of
from service.private_file import write_whole
from service.publishing.security import RolesConfig, SecurityConfig, TlsConfig, access_control
from service.readable import open_file

Role = Literal["viewer", "operator", "vehicle"]
AUTHORITY_DAYS = 3650
RENEW_DAYS = 60  # so long before its end a certificate is renewed
RULES = "access_control.json5"
_CLOCKS_APART = timedelta(hours=1)  # a vehicle whose clock is behind takes a new certificate at once


@dataclass(frozen=True, slots=True)
class Holder:
    """Holder of a certificate. hosts: names and addresses by which clients reach it."""

    name: str
    role: Role
    hosts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SiteFiles:
    """Result of `init_site`, by names; `config` is the section for a vehicle's config."""

    folder: str
    made: tuple[str, ...]
    renewed: tuple[str, ...]
    kept: tuple[str, ...]
    config: str = field(repr=False)

    def __str__(self) -> str:
        lines = [f"{self.folder}: certificates of this site, and {RULES} for a site's zenohd"]
        for what in ("made", "renewed", "kept"):
            if names := getattr(self, what):
                lines.append(f"{what}: {', '.join(names)}")
        if self.renewed:
            lines.append(
                "a renewed .pem is in use once it is on its machine and the service there is restarted"
            )
        lines.append(
            "ca.key signs certificates: keep it off the vehicles, which get ca.pem and their own two files"
        )
        return "\n".join([*lines, self.config])


def init_site(
    folder: Path, holders: Sequence[Holder], days: int, renew: bool = False, now: datetime | None = None
) -> SiteFiles:
    """Make what is missing in `folder`, and renew what ends within 60 days; with `renew`, all of it.

    A certificate that is renewed keeps its key. Raises InputError where a file there is none of an authority,
    StorageError where the folder cannot be written.
    """
    now = now or datetime.now(UTC)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        site = _Site(folder, now, days)
        return site.issue_all(holders, renew)
    except OSError as error:
        raise StorageError(f"{error.filename or folder}: {words_of(error)}") from error


class _Site:
    def __init__(self, folder: Path, now: datetime, days: int) -> None:
        self._folder, self._now, self._days = folder, now, days
        paths = folder / "ca.pem", folder / "ca.key"
        self._is_new = not any(path.exists() for path in paths)
        if self._is_new:
            self._key = ec.generate_private_key(ec.SECP256R1())
            self._certificate = self._sign_itself()
            write_whole(paths[1], _pem_of_key(self._key))
            write_whole(paths[0], _pem(self._certificate), 0o644)
        elif missing := [path for path in paths if not path.exists()]:
            raise InputError(
                f"{missing[0]} is missing: certificates are made in the folder with ca.pem and ca.key of the "
                "site; if it is lost, begin a new authority in an empty folder, and bring its files to all "
                "machines"
            )
        else:
            self._certificate = read_certificate(paths[0])
            self._key = _read_key(paths[1])
        if self._certificate.not_valid_after_utc <= now:
            raise InputError(
                f"{paths[0]}: the authority has expired on {self._certificate.not_valid_after_utc:%Y-%m-%d}; "
                "begin a new one in an empty folder, and bring its files to all machines"
            )

    def issue_all(self, holders: Sequence[Holder], renew: bool) -> SiteFiles:
        known = dict(self._holders())
        for holder in holders:
            before = known.get(holder.name)
            if before is not None and before.role != holder.role:
                raise InputError(
                    f"{self._folder}/{holder.name}.pem has the role {before.role}; one name has one role"
                )
            known[holder.name] = holder if holder.hosts or before is None else before
        done: dict[str, list[str]] = {"made": ["ca"] if self._is_new else [], "renewed": [], "kept": []}
        for holder in known.values():
            done[self._issue(holder, renew)].append(holder.name)
        self._write_rules(list(known.values()))
        return SiteFiles(
            str(self._folder),
            **{what: tuple(names) for what, names in done.items()},
            config=_config_text(list(known.values())),
        )

    def _holders(self) -> Iterator[tuple[str, Holder]]:
        """Holders of existing certificates."""
        for path in sorted(self._folder.glob("*.pem")):
            if path.name != "ca.pem":
                certificate = read_certificate(path)
                role = _first(certificate.subject, NameOID.ORGANIZATIONAL_UNIT_NAME)
                if role not in get_args(Role):
                    raise InputError(f"{path}: no role in it, as `corridor security init` writes one")
                yield path.stem, Holder(common_name(certificate), cast(Role, role), _hosts_of(certificate))

    def _issue(self, holder: Holder, renew: bool) -> str:
        path, key_path = self._folder / f"{holder.name}.pem", self._folder / f"{holder.name}.key"
        has_key = key_path.exists()
        if path.exists() and has_key and not renew:
            present = read_certificate(path)
            is_long = present.not_valid_after_utc - self._now > timedelta(days=RENEW_DAYS)
            if is_long and _hosts_of(present) == holder.hosts:
                return "kept"
        key = _read_key(key_path) if has_key else ec.generate_private_key(ec.SECP256R1())
        if not has_key:
            write_whole(key_path, _pem_of_key(key))
        what = "renewed" if path.exists() else "made"
        write_whole(path, _pem(self._sign(holder, key.public_key())), 0o644)
        return what

    def _sign_itself(self) -> x509.Certificate:
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "corridor site authority")])
        return (
            self._begin(name, name, self._key.public_key(), self._now + timedelta(days=AUTHORITY_DAYS))
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
            .sign(self._key, hashes.SHA256())
        )

    def _sign(self, holder: Holder, key: ec.EllipticCurvePublicKey) -> x509.Certificate:
        name = x509.Name(
            [
                x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, holder.role),
                x509.NameAttribute(NameOID.COMMON_NAME, holder.name),
            ]
        )
        end = min(self._now + timedelta(days=self._days), self._certificate.not_valid_after_utc)
        uses = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        signing = self._begin(name, self._certificate.subject, key, end)
        if holder.hosts:
            signing = signing.add_extension(
                x509.SubjectAlternativeName([_general_name(host) for host in holder.hosts]), critical=False
            )
        return (
            signing.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
            .sign(self._key, hashes.SHA256())
        )

    def _begin(
        self, subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, end: datetime
    ) -> x509.CertificateBuilder:
        serial = x509.random_serial_number()
        signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        return (
            x509.CertificateBuilder(issuer, subject, key, serial, self._now - _CLOCKS_APART, end)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
            .add_extension(signer, critical=False)
        )

    def _write_rules(self, holders: Sequence[Holder]) -> None:
        """For a router that serves all vehicles of the site."""
        tls = TlsConfig(ca=Path("ca.pem"), certificate=Path("ca.pem"), key=Path("ca.key"))
        security = SecurityConfig(tls=tls, roles=_roles(holders))
        text = json.dumps({"access_control": access_control(security, None, trusts_plain=False)}, indent=1)
        write_whole(self._folder / RULES, f"{text}\n".encode(), 0o644)


def read_certificate(path: Path) -> x509.Certificate:
    """The first one of a PEM file. Raises InputError, and OSError where it cannot be read."""
    try:
        with open_file(path) as file:
            return x509.load_pem_x509_certificate(file.read())
    except ValueError as error:
        raise InputError(f"{path}: no certificate in PEM: {error}") from error


def common_name(certificate: x509.Certificate) -> str:
    """Common name of its holder, "" where there is none."""
    return _first(certificate.subject, NameOID.COMMON_NAME)


def _first(name: x509.Name, kind: x509.ObjectIdentifier) -> str:
    found = name.get_attributes_for_oid(kind)
    return str(found[0].value) if found else ""


def _read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except (ValueError, TypeError) as error:  # TypeError: it has a password
        raise InputError(f"{path}: no private key in PEM without password: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise InputError(f"{path}: no key of `corridor security init`, which makes elliptic curve keys")
    return key


def _hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(signs_certificates: bool) -> x509.KeyUsage:
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


def _roles(holders: Sequence[Holder]) -> RolesConfig:
    return RolesConfig(**{role: tuple(h.name for h in holders if h.role == role) for role in get_args(Role)})


def _config_text(holders: Sequence[Holder]) -> str:
    """For the first vehicle; the others differ by name."""
    roles = _roles(holders)
    name = next(iter(roles.vehicle), "veh1")
    place = "/etc/corridor/security"
    listed = {role: f"[{', '.join(getattr(roles, role))}]" for role in ("viewer", "operator")}
    return f"""\
publishing:
  listen: ["tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"]
  security:
    tls: {{ca: {place}/ca.pem, certificate: {place}/{name}.pem, key: {place}/{name}.key}}
    roles: {{viewer: {listed["viewer"]}, operator: {listed["operator"]}, vehicle: [{name}]}}"""


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _pem_of_key(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
