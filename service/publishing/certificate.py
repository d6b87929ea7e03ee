"""Whether an own certificate is valid now, without the extra `security`."""

import socket
import ssl
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from service.publishing.security import SecurityConfig, TlsConfig

UNTIL = "certificate_until"  # key of `until` in a row of health
SHOWN_WITHIN_S = 2.0
TIME = "%Y-%m-%d %H:%M:%S"
NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME of OpenSSL


class Validity:
    """Of the certificate as it is when constructed, as the service has it. Certificates that OpenSSL refuses
    have no fault here: the doctor examines them.
    """

    def __init__(
        self,
        certificate: Path | None,
        key: Path | None,
        unix_s: Callable[[], float] = time.time,
        authority: Path | None = None,
    ) -> None:
        """PEM files; None: there are none. authority: by which other machines judge it, if it is known."""
        self._files = None if certificate is None or key is None else (certificate, key)
        self._span_s = self._on_disk()
        self._unix_s = unix_s
        self._authority = authority
        self._is_of_authority = (
            authority is None or self._files is None or _span_unix_s(*self._files, authority) is not None
        )

    @property
    def until(self) -> str:
        """End of the certificate in UTC, to the second; "" where there is none that OpenSSL takes."""
        return "" if self._span_s is None else time.strftime(TIME, time.gmtime(self._span_s[1]))

    def fault(self) -> str:
        """Why no other machine can connect, "" where it is valid."""
        now_s = self._unix_s()
        if self._files is not None and self._span_s is not None and not self._is_of_authority:
            return (
                f"{self._files[0]} is not signed by {self._authority}: no other machine accepts it; bring "
                "both files from one folder of corridor security init, and restart"
            )
        if self._files is None or self._span_s is None or _holds(self._span_s, now_s):
            return ""
        begin, end, now = (
            time.strftime("%Y-%m-%d %H:%M", time.gmtime(at_s)) for at_s in (*self._span_s, now_s)
        )
        if now_s < self._span_s[0]:
            remedy = "is the clock right?"
        elif (on_disk_s := self._on_disk()) is not None and _holds(on_disk_s, now_s):
            remedy = "the file has been renewed since, restart to use it"
        else:
            remedy = "renew it, as by corridor security init, and restart"
        return (
            f"{self._files[0]} is valid from {begin} to {end} UTC, and it is {now}: no other machine accepts "
            f"it; {remedy}"
        )

    def _on_disk(self) -> tuple[float, float] | None:
        return None if self._files is None else _span_unix_s(*self._files)


def validity_of(security: SecurityConfig | None) -> Validity:
    """Of the certificate of Zenoh."""
    tls = None if security is None else security.tls
    return Validity(None, None) if tls is None else Validity(tls.certificate, tls.key, authority=tls.ca)


def refused(address: tuple[str, int], tls: TlsConfig) -> str:
    """Why a client with these files refuses the certificate that is shown at a host and port; "" where it
    does not, or nothing answers there.
    """
    try:
        client = ssl.create_default_context(cafile=tls.ca)
        client.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
        client.load_cert_chain(tls.certificate, tls.key, password="")
        with socket.create_connection(address, SHOWN_WITHIN_S) as connection:
            client.wrap_socket(connection, server_hostname=address[0]).close()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message.rstrip(".")
    except (OSError, ValueError):
        return ""
    return ""


def _holds(span_s: tuple[float, float], now_s: float) -> bool:
    return span_s[0] <= now_s <= span_s[1]


def _span_unix_s(certificate: Path, key: Path, authority: Path | None = None) -> tuple[float, float] | None:
    """From when to when it is valid, as a client of the authority learns it in a handshake, or without one
    each client; None where there is none.
    """
    client, server = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client.check_hostname = False
    client.verify_flags = ssl.VerifyFlags(client.verify_flags | NO_CHECK_TIME | ssl.VERIFY_X509_PARTIAL_CHAIN)
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        client.load_verify_locations(authority or certificate)
        server.load_cert_chain(certificate, key, password="")
        asking = client.wrap_bio(to_client, to_server)
        ends = asking, server.wrap_bio(to_server, to_client, server_side=True)
        for end in (*ends, *ends):
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
        found = asking.getpeercert()
    except (OSError, ValueError):  # ssl.SSLError is one, too
        return None
    if not found:
        return None
    begin_s, end_s = (ssl.cert_time_to_seconds(str(found[key])) for key in ("notBefore", "notAfter"))
    return begin_s, end_s
