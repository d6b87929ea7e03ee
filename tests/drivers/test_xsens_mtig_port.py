"""Finding the baud rate, and opening the right kind of wire."""

import pytest

from drivers.errors import TransportError
from drivers.transport import SerialTransport
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.port import DWELL_S, LIKELY_BAUDS, BaudPort, ProbingPort, open_port
from drivers.xsens_mtig.protocol import Mid, encode
from simulators.wire import PtyWire
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers.mtig import ZERO_NS, Swing, config, samples
from tests.drivers.virtual_time import SECOND_NS, TICK_NS


class Line(BaudPort):
    """A serial line in virtual time, with a fake device at its end: what one says at another rate than the
    other is garbage.
    """

    def __init__(self, device: FakeMtiG) -> None:
        self.device = device
        self.now_ns = ZERO_NS
        self.baud = 0
        self.tried: list[int] = []
        device.connected(self.now_ns)

    def set_baud(self, baud: int) -> None:
        self.baud = baud
        self.tried.append(baud)

    def read(self, timeout_s: float) -> bytes:
        self.now_ns += TICK_NS
        sent = b""
        while (due_ns := self.device.next_due_ns(self.now_ns)) is not None and due_ns <= self.now_ns:
            sent += self.device.due(max(due_ns, self.now_ns))
        return sent if self.baud == self.device.settings.baud else bytes(b ^ 0x5A for b in sent[::2])

    def write(self, data: bytes) -> None:
        same = self.baud == self.device.settings.baud
        self.device.receive_data(data if same else bytes(b ^ 0x5A for b in data[::2]), self.now_ns)

    def close(self) -> None: ...


def pump(line: Line, port: ProbingPort, session: XsensMtigSession, seconds: float) -> list[object]:
    frames: list[object] = []
    end_ns = line.now_ns + round(seconds * SECOND_NS)
    while line.now_ns < end_ns:
        session.tick(line.now_ns)
        if session.outbox:
            port.write(bytes(session.outbox))
            session.outbox.clear()
        if data := port.read(0.02):
            frames += session.receive_data(data, line.now_ns)
    return frames


@pytest.mark.parametrize("personality", ["mtdata2", "legacy"])
@pytest.mark.parametrize("baud", LIKELY_BAUDS[:-2])
def test_every_likely_baud_rate_is_found(baud: int, personality: str):
    device = FakeMtiG(Swing(), MtigSetup(personality, baud))  # type: ignore[arg-type]
    line = Line(device)
    port = ProbingPort(line, now_s=lambda: line.now_ns * 1e-9)
    session = XsensMtigSession(config(rate_hz=25, gnss=False))
    frames = pump(line, port, session, 1.5 + 2 * DWELL_S * LIKELY_BAUDS.index(baud))
    assert samples(frames)  # type: ignore[arg-type]
    assert port.baud == baud
    assert line.tried == list(LIKELY_BAUDS[: LIKELY_BAUDS.index(baud) + 1])
    assert session.identity["baud"] == str(baud)
    assert session.counters["resets_sent"] == 0


def test_a_quiet_device_is_found_by_its_answer():
    device = FakeMtiG(Swing(), MtigSetup(baud=460_800))
    line = Line(device)
    device.receive_data(encode(Mid.GO_TO_CONFIG), line.now_ns)
    port = ProbingPort(line, now_s=lambda: line.now_ns * 1e-9)
    assert samples(pump(line, port, XsensMtigSession(config()), 3.0))  # type: ignore[arg-type]
    assert port.baud == 460_800


def test_a_rate_once_found_is_kept_through_silence():
    line = Line(FakeMtiG(Swing()))
    port = ProbingPort(line, now_s=lambda: line.now_ns * 1e-9)
    pump(line, port, XsensMtigSession(config()), 1.0)
    line.device.state = "config"
    for _ in range(200):
        port.read(0.02)
    assert line.tried == [115_200]


def test_ports_are_opened_as_the_config_says(monkeypatch: pytest.MonkeyPatch):
    with PtyWire(FakeMtiG(Swing())) as path:
        with open_port(config(device=str(path))) as port:
            assert isinstance(port, ProbingPort)
        with open_port(config(device=str(path), baud=460_800)) as port:
            assert isinstance(port, SerialTransport)
    with pytest.raises(TransportError, match="cannot open /dev/nothing at 115200 baud"):
        open_port(config(device="/dev/nothing"))
    opened = []
    monkeypatch.setattr("drivers.xsens_mtig.port.UsbTransport", lambda *given: opened.append(given))
    open_port(config(device="usb:0380"))
    assert opened[0][0] == 0x2639
    assert 0x0017 in opened[0][1]
    assert opened[0][2] == "0380"
