"""Certificates, keys and passwords of Zenoh and of the page: readable, belonging together, not expired."""

import ssl
import stat
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from drivers.counted import counted
from service.config import ServiceConfig
from service.encoding import Status
from service.errors import InputError, words_of
from service.extras import install_command
from service.offline.doctor.findings import Finding, fault, note, ok
from service.offline.doctor.machine import Machine
from service.publishing.certificate import UNTIL, Validity
from service.publishing.config import is_local
from service.publishing.security import SecurityConfig, TlsConfig, UsersConfig
from service.readable import open_file

if TYPE_CHECKING:  # cryptography is an extra
    from cryptography.x509 import Certificate

ENDS_SOON = timedelta(days=30)
MAKE = "corridor security init makes and renews them, see docs/security.md"


def look_at_certificates(machine: Machine, config: ServiceConfig) -> list[Finding]:
    """Nothing where the config names no file of them."""
    found: list[Finding] = []
    publishing = config.sinks["publishing"]
    if (security := publishing.secured) is not None:
        if security.users is not None:
            found += _users(machine, security, security.users)
        if security.tls is not None:
            in_fleet = config.vehicle if publishing.fleet.connect else None
            is_own_router = in_fleet is None or not all(map(is_local, publishing.listen))
            found += _site(machine, security, security.tls, in_fleet, is_own_router)
    web = config.sinks["web"]
    if web.enabled and web.tls_certificate is not None:
        found += _pair(machine, "web", web.tls_certificate, web.tls_key)[0]
    elif web.enabled and not is_local(f"tcp/{web.listen}"):
        words = f"{web.listen} is on the network without TLS: the token can be read in transit"
        found.append(note("web", words, "set web.tls_certificate and web.tls_key, or use SSH"))
    return found


def look_at_loaded(machine: Machine, config: ServiceConfig, statuses: Sequence[Status]) -> list[Finding]:
    """A note for each certificate that is not the one which the running service has loaded, by its health."""
    publishing, web = config.sinks["publishing"], config.sinks["web"]
    tls = publishing.secured.tls if publishing.secured is not None else None
    files = {"web": (web.tls_certificate, web.tls_key)}
    if tls is not None:
        files["zenoh"] = tls.certificate, tls.key
    found = []
    for status in statuses:
        certificate, key = files.get(status.name, (None, None))
        loaded = status.values.get(UNTIL)
        if certificate is None or key is None or loaded is None:
            continue
        on_disk = Validity(machine.path(certificate), machine.path(key)).until
        if on_disk not in ("", loaded):
            words = (
                f"the running service has loaded a certificate that is valid until {loaded} UTC; "
                f"{certificate} has been replaced since, by one until {on_disk}"
            )
            found.append(note(status.name, words, "restart the service to use it"))
    return found


def _site(
    machine: Machine, security: SecurityConfig, tls: TlsConfig, in_fleet: str | None, is_own_router: bool
) -> Iterator[Finding]:
    """in_fleet   name of the vehicle, where it connects to a router of the fleet
    is_own_router   the roles are used: by clients of this machine's own router
    """
    findings, certificate = _pair(machine, "zenoh", tls.certificate, tls.key)
    yield from findings
    try:
        authority = _read(machine.path(tls.ca))
    except InputError as error:
        yield fault("zenoh", str(error), "the certificate of the site's authority", MAKE)
        return
    if authority is None or certificate is None:
        return
    from cryptography.exceptions import InvalidSignature

    from service.offline.security.authority import common_name

    yield from _time(machine, "zenoh", tls.ca, authority)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        yield fault(
            "zenoh",
            f"{tls.certificate} is not signed by {tls.ca}",
            "a certificate and the authority of one site",
            "bring both files from one folder of corridor security init",
        )
    name = common_name(certificate)
    if in_fleet not in (None, name):
        yield fault(
            "fleet",
            f"{tls.certificate} is of {name!r}, the vehicle is called {in_fleet!r}",
            "one name: the router drops what the vehicle publishes by another one",
            f"write vehicle: {name}, or take the certificate of {in_fleet}",
        )
    if is_own_router and name not in security.roles.names:
        yield fault(
            "zenoh",
            f"the name {name!r} of {tls.certificate} has no role",
            "a name of publishing.security.roles",
            f"write roles: {{vehicle: [{name}], ...}}, or a role of it; without one it may nothing",
        )


def _pair(
    machine: Machine, who: str, certificate_path: Path, key_path: Path
) -> tuple[list[Finding], "Certificate | None"]:
    """A certificate and its key; the certificate only where it can be read, and cryptography is there."""
    found = _private(machine, who, key_path, "the key")
    try:
        certificate = _read(machine.path(certificate_path))
    except InputError as error:
        return [*found, fault(who, str(error), "a certificate in PEM", MAKE)], None
    if certificate is None:
        words = f"{certificate_path} is not examined: cryptography is not installed"
        return [*found, note(who, words, install_command("security"))], None
    if not found:
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
                machine.path(certificate_path), machine.path(key_path), password="no"
            )
        except (ssl.SSLError, OSError) as error:
            what = f"{key_path} is not the key of {certificate_path}: {words_of(error)}"
            found.append(fault(who, what, "a certificate and its own key, without password", MAKE))
    return [*found, *_time(machine, who, certificate_path, certificate)], certificate


def _time(machine: Machine, who: str, path: Path, certificate: "Certificate") -> list[Finding]:
    now = datetime.fromtimestamp(machine.unix_s(), UTC)
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now >= end:
        return [fault(who, f"{path} has expired on {end:%Y-%m-%d %H:%M} UTC", "a valid certificate", MAKE)]
    if now < begin:
        words = f"{path} is valid from {begin:%Y-%m-%d %H:%M} UTC on, and the clock says {now:%Y-%m-%d %H:%M}"
        return [fault(who, words, "a certificate that is valid by now", "set this machine's clock")]
    days = counted((end - now).days, "day")
    if end - now < ENDS_SOON:
        return [note(who, f"{path} ends in {days}, on {end:%Y-%m-%d}", MAKE)]
    return [ok(who, f"{path} is valid for {days}")]


def _private(machine: Machine, who: str, path: Path, what: str) -> list[Finding]:
    """Whether this user can read it, and no other."""
    there = machine.path(path)
    try:
        with open_file(there) as file:
            file.read(1)
        mode = stat.S_IMODE(there.stat().st_mode)
    except (OSError, InputError) as error:
        words = f"user {machine.user} cannot read {path}: {words_of(error)}"
        remedy = f"sudo chown {machine.user} {quote(str(path))}"
        return [fault(who, words, f"{what}, readable for the service", remedy)]
    if mode & 0o077:
        words, remedy = f"others may read {path} (mode {mode:04o})", f"chmod 600 {quote(str(path))}"
        return [fault(who, words, f"{what}, readable for the service alone", remedy)]
    return []


def _users(machine: Machine, security: SecurityConfig, users: UsersConfig) -> Iterator[Finding]:
    if found := _private(machine, "zenoh", users.file, "passwords"):
        yield from found
        return
    lines = machine.text(str(users.file)).splitlines()
    wrong = [str(number) for number, line in enumerate(lines, 1) if not all(line.partition(":"))]
    names = {line.partition(":")[0] for line in lines}
    if wrong:
        words = f"{users.file}: no user in line {', '.join(wrong[:5])}"
        yield fault("zenoh", words, "name:password in each line", "correct the file; Zenoh refuses all of it")
    for name in sorted(names - security.roles.names):
        yield note(
            "zenoh", f"the user {name!r} of {users.file} has no role", "list it in roles, or remove it"
        )
    for name in sorted(security.roles.names - names):
        yield note("zenoh", f"{name!r} has a role and no password in {users.file}", "add it, or take it out")
    if not wrong:
        yield ok("zenoh", f"{users.file} has {counted(len(lines), 'user')}")


def _read(path: Path) -> "Certificate | None":
    """None where cryptography is not installed. Raises InputError."""
    try:
        from service.offline.security.authority import read_certificate
    except ImportError:
        return None
    try:
        return read_certificate(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {words_of(error)}") from error
