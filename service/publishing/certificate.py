"""Whether the service's own certificate is valid now, without the extra `security`."""

import ssl
import time
from collections.abc import Callable
from contextlib import suppress

from service.publishing.security import TlsConfig

NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME of OpenSSL


class Validity:
    """Of the certificate as it is when constructed, as the service has it. Certificates that OpenSSL refuses
    have no fault here: the doctor examines them.
    """

    def __init__(self, tls: TlsConfig | None, unix_s: Callable[[], float] = time.time) -> None:
        self._path = "" if tls is None else str(tls.certificate)
        self._span_s = None if tls is None else _span_unix_s(tls)
        self._unix_s = unix_s

    def fault(self) -> str:
        """Why no other machine can connect, "" where it is valid."""
        if self._span_s is None:
            return ""
        begin_s, end_s = self._span_s
        now_s = self._unix_s()
        if begin_s <= now_s <= end_s:
            return ""
        begin, end, now = (
            time.strftime("%Y-%m-%d %H:%M", time.gmtime(at_s)) for at_s in (begin_s, end_s, now_s)
        )
        return (
            f"{self._path} is valid from {begin} to {end} UTC, and it is {now}: no client connects by tls/; "
            + (
                "is the clock right?"
                if now_s < begin_s
                else "renew it by corridor security init, and restart"
            )
        )


def _span_unix_s(tls: TlsConfig) -> tuple[float, float] | None:
    """From when to when it is valid, as a client learns it in a handshake; None where there is none."""
    client, server = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client.check_hostname = False
    client.verify_flags = ssl.VerifyFlags(client.verify_flags | NO_CHECK_TIME)
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        client.load_verify_locations(tls.ca)
        server.load_cert_chain(tls.certificate, tls.key, password="")
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
