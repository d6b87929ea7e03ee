"""drivers.link's loop in virtual time: sessions end on errors and unplugged cables, new ones come."""

from collections import Counter
from collections.abc import Callable

from drivers import link
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.frames import Frame, GnssFix
from simulators.faults import Faulty
from tests.drivers.virtual_time import SECOND_NS

TICK_NS = round(link.READ_TIMEOUT_S * SECOND_NS)
DELAY_NS = 100_000  # of the network, from the device


class VirtualLink:
    """One device with faults and the sessions that talk to it, one after the other.

    frames     scans and samples; fixes, which come in between and late, are left out
    passed_on  what drivers.link would hand on: fixes too, nothing before the device's clock is known
    chunks     what happened on the wire, as drivers.link tees it
    errors     what ended sessions, with the time; a fault of the driver itself is raised
    sent       with the time, what the device sent, as the session read it
    """

    def __init__(self, new_session: Callable[[], link.Session], device: Faulty, now_ns: int) -> None:
        self.device = device
        self.now_ns = now_ns
        self.frames: list[Frame] = []
        self.passed_on: list[Frame] = []
        self.chunks: list[link.RawChunk] = []
        self.errors: list[tuple[int, Exception]] = []
        self.sent: list[tuple[int, bytes]] = []
        self.connects = 0
        self._new_session = new_session
        self._session: link.Session | None = None
        self._gate = link.ClockGate()
        self._counters: Counter[str] = Counter()  # of sessions that have ended
        self._retry_s = link.FIRST_RETRY_S
        self._connect_at_ns = self._connected_ns = now_ns

    @property
    def counters(self) -> Counter[str]:
        """Over all sessions."""
        return self._counters + (Counter() if self._session is None else self._session.counters)

    @property
    def status(self) -> str:
        return "" if self._session is None else self._session.status

    def run(self, seconds: float) -> list[Frame]:
        """Let that much time pass; the frames that came meanwhile."""
        before = len(self.frames)
        end_ns = self.now_ns + round(seconds * SECOND_NS)
        while self.now_ns < end_ns:
            try:
                self._step(min(self.now_ns + TICK_NS, end_ns))
            except (TransportError, ProtocolError, DeviceError) as error:
                self._hang_up(error)
        return self.frames[before:]

    def _step(self, until_ns: int) -> None:
        """One tick of the session and what the device says until the next."""
        if self._session is None:
            self.now_ns = until_ns
            self.device.next_due_ns(self.now_ns)
            if self.now_ns >= self._connect_at_ns:
                self._connect()
            return
        if not self.device.plugged(self.now_ns):
            raise TransportError("unplugged")
        self._tick("waited", self.now_ns)
        while (due_ns := self.device.next_due_ns(self.now_ns)) is not None and due_ns <= until_ns:
            self.now_ns = max(self.now_ns, due_ns)
            if not self.device.plugged(self.now_ns):
                raise TransportError("unplugged")
            self._deliver(self.device.due(self.now_ns))
        self.now_ns = max(self.now_ns, until_ns)

    def _connect(self) -> None:
        if not self.device.plugged(self.now_ns):
            self._hang_up(TransportError("refused"))
            return
        self.connects += 1
        self._connected_ns = self.now_ns
        self._session, self._gate = self._new_session(), link.ClockGate()
        greeting = self.device.connected(self.now_ns)
        self._tick("connected", self.now_ns)
        self._deliver(greeting)

    def _hang_up(self, error: Exception) -> None:
        self.errors.append((self.now_ns, error))
        if self._session is not None:
            self._counters += self._session.counters
            self._session = None
            self.device.disconnected(self.now_ns)
            if self.now_ns - self._connected_ns > link.PROVEN_AFTER_S * SECOND_NS:
                self._retry_s = link.FIRST_RETRY_S
        wait_s = link.DEVICE_ERROR_RETRY_S if isinstance(error, DeviceError) else self._retry_s
        self._retry_s = min(2.0 * self._retry_s, link.LAST_RETRY_S)
        self._connect_at_ns = self.now_ns + round(wait_s * SECOND_NS)

    def _tick(self, kind: link.ChunkKind, now_ns: int, data: bytes = b"") -> None:
        """Have the session take what happened on the wire, and the device what the session then sends."""
        session = self._session
        self.chunks.append(link.RawChunk(now_ns, kind, data))
        if data:
            frames = session.receive_data(data, now_ns)
            self.frames += [frame for frame in frames if not isinstance(frame, GnssFix)]
            self.passed_on += [f for f in frames if self._gate.lets_through(session.clock_sigma_ns, now_ns)]
        session.tick(now_ns)
        if sent := bytes(session.outbox):
            session.outbox.clear()
            self.chunks.append(link.RawChunk(now_ns, "sent", sent))
            self._deliver(self.device.receive_data(sent, self.now_ns))

    def _deliver(self, data: bytes) -> None:
        if data:
            self.sent.append((self.now_ns, data))
            self._tick("received", self.now_ns + DELAY_NS, data)
