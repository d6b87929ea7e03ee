"""The session's talk with devices good and odd, in virtual time."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from drivers.errors import DeviceError, TransportError
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Decoder, Dialect, Telegram, encode, writer
from drivers.sick_lms100.telegrams import OutputRange, ScanConfig, ScanDataConfig, ScanTelegram, write_scan
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import config, talk, telegram
from tests.drivers.virtual_time import SECOND_NS, Talk

ASCII, BINARY = Dialect.ASCII, Dialect.BINARY


def requests(t):
    """Telegrams sent by the session: kind, name."""
    return [(r.kind, r.name) for r in Decoder().receive_data(bytes(t.sent))]


def writes(t):
    return [name for kind, name in requests(t) if kind in ("sWN", "sMN")]


@pytest.mark.parametrize("port", [2111, 2112, 40_000])
@pytest.mark.parametrize("dialect", [ASCII, BINARY])
def test_stream_starts_within_two_seconds_whatever_the_dialect(dialect, port):
    t = talk(Lms100Setup(dialect=dialect), port=port).run(2.0)
    assert t.frames
    assert t.session.identity == {
        "dialect": dialect.value,
        "device": "LMS10x_FieldEval",
        "firmware": "V1.80.2",
        "serial": "18090362",
    }
    assert t.session.status == "streaming"


def test_only_what_differs_is_changed_and_read_back():
    setup = Lms100Setup(scan=ScanConfig(2500, 2500), reconfigure_delay_ns=30 * SECOND_NS)
    t = talk(setup).run(45.0)
    assert writes(t) == ["SetAccessMode", "mLMPsetscancfg", "LMCstartmeas", "Run"]
    assert requests(t).count(("sRN", "LMPscancfg")) == 2
    assert t.frames[-1].angle_step_rad == pytest.approx(math.radians(0.5))
    assert "waiting for the laser: state 4 (spinning up)" in t.statuses
    assert t.session.counters["scans_not_as_configured"] == 0


def test_field_of_view_echo_and_intensity_are_set():
    t = talk(first_angle_deg=-90.0, last_angle_deg=45.0, echo="last", intensity_bits=16).run(3.0)
    assert writes(t) == ["SetAccessMode", "LMPoutputRange", "LMDscandatacfg", "LMCstartmeas", "Run"]
    frame = t.frames[-1]
    assert len(frame.range_m) == len(frame.intensity) == 271
    assert frame.first_angle_rad == pytest.approx(math.radians(-90.0))


def test_booting_device_is_asked_until_it_answers():
    t = talk(Lms100Setup(boot_ns=15 * SECOND_NS, first_writes_refused=2), intensity_bits=8).run(14.0)
    assert "booting" in t.session.status
    t.run(10.0)
    assert t.session.status == "streaming"
    assert t.session.counters["requests_refused"] == 2
    assert writes(t).count("LMDscandatacfg") == 3
    assert writes(t).count("SetAccessMode") == 3  # a login during boot may be forgotten


def test_forced_dialect_is_the_only_one_spoken():
    t = talk(Lms100Setup(dialect=BINARY), dialect="cola_a")
    with pytest.raises(TransportError, match="no answer in CoLa-A after"):
        t.run(30.0)
    assert {r.dialect for r in Decoder().receive_data(bytes(t.sent))} == {ASCII}


def test_shutdown_request_ends_the_subscription():
    t = talk(Lms100Setup(dialect=BINARY)).run(2.0)
    assert t.session.shutdown_request().hex() == "020202020000001173454e204c4d447363616e64617461200032"
    assert Lms100Session(config()).shutdown_request() == b""


def test_health_is_asked_seldom_and_put_into_words():
    t = talk().run(2.0)
    t.device.contamination = 1
    t.run(11.0)
    assert t.session.status == "streaming; contamination warning"
    assert t.session.counters["polls_contaminated"] == 1
    assert t.session.counters["scans_flagged_contamination_warning"] > 0
    t.device.contamination = 0
    t.run(11.0)
    assert t.session.status == "streaming"
    assert requests(t).count(("sRN", "LCMstate")) == 3


def test_error_flag_of_the_first_scans_is_no_fault_but_a_lasting_one_is():
    t = talk().run(1.0)
    assert t.session.counters["scans_flagged_device_error"] == 7
    assert set(t.statuses) & {"streaming; device error"} == set()
    t.device.failed = True
    t.run(2.0)
    assert t.session.status == "streaming; device error"


@dataclass
class Scripted:
    """Answers by a table, by name; no entry, no answer. Scans flow once `streams_after` was asked."""

    answers: dict[str, bytes]
    streams_after: str = "LMDscandata"
    period_ns: int = 20_000_000
    heard: list[str] = field(default_factory=list)
    due_at_ns: int | None = None
    next_scan: Callable[[int], ScanTelegram] = lambda k: telegram(k, k * 20_000)

    def __post_init__(self):
        self._decoder, self._count = Decoder(), 0

    def connected(self, now_ns):
        return b""

    def disconnected(self, now_ns):
        pass

    def receive_data(self, data, now_ns):
        out = b""
        for request in self._decoder.receive_data(data):
            if request.dialect is not BINARY:
                continue
            self.heard.append(request.name)
            if request.name == self.streams_after and self.due_at_ns is None:
                self.due_at_ns = now_ns + self.period_ns
            kind = {"sRN": "sRA", "sWN": "sWA", "sMN": "sAN", "sEN": "sEA"}[request.kind]
            answer = self.answers.get(request.name)
            if answer is not None and answer[:3] == b"sFA":
                out += encode(Telegram(BINARY, "sFA", "", answer[3:]))
            elif answer is not None:
                head, body = (answer[:3].decode(), answer[3:]) if answer[:2] == b"sA" else (kind, answer)
                out += encode(Telegram(BINARY, head, request.name, body))
        return out

    def next_due_ns(self, now_ns):
        return self.due_at_ns

    def due(self, now_ns):
        self.due_at_ns += self.period_ns
        self._count += 1
        return encode(write_scan(self.next_scan(self._count), BINARY))


def scripted(device, **changes):
    return Talk(Lms100Session(config(port=2112, **changes)), device).connect()


def body_of(layout):
    w = writer(BINARY)
    layout.write(w)
    return w.body


def test_server_that_answers_little_and_streams_after_run_is_put_up_with():
    """As sick_scan_xd's test_server.py: SCdevicestate stays 0, STlms and scan config are never answered."""
    layout = body_of(ScanDataConfig(1, False, False))
    answers = {"SCdevicestate": b"\0", "SetAccessMode": b"\1", "FirmwareVersion": b"\0\x09V1.80.2  "}
    answers |= {"LMPoutputRange": body_of(OutputRange(-450_000, 2_250_000)), "LMDscandatacfg": layout}
    answers |= {"LMCstartmeas": b"\0", "Run": b"\1", "LMDscandata": b"\1"}
    t = scripted(Scripted(answers, streams_after="Run")).run(60.0)
    assert t.session.status == "streaming"
    assert len(t.frames) > 1500
    assert t.device.heard[-1] == "LCMstate"
    assert t.device.heard.count("STlms") == 1 + 3 + 3  # each time given up after three


def test_server_that_answers_with_the_wrong_type_and_nothing_in_it_is_put_up_with():
    """As sick_scan_emulator: a bare sAN to LMPscancfg and STlms."""
    answers = {"SCdevicestate": b"\1", "LMPscancfg": b"sAN", "STlms": b"sAN", "SetAccessMode": b"\1"}
    answers |= {"LMDscandatacfg": b"", "LMCstartmeas": b"\0", "Run": b"\1", "LMDscandata": b"\1"}
    t = scripted(Scripted(answers)).run(30.0)
    assert t.session.status == "streaming"
    assert t.session.counters["answers_unusable"] > 3


def test_login_answered_with_nothing_counts_as_accepted():
    answers = {"SCdevicestate": b"\1", "SetAccessMode": b"", "LMDscandata": b"\1", "LMDscandatacfg": b""}
    t = scripted(Scripted(answers))
    assert t.run(60.0, until=lambda: t.frames != []).frames


def test_login_that_is_refused_for_another_reason_than_the_password_is_repeated_and_reported_with_it():
    busy = {"SCdevicestate": b"\1", "SetAccessMode": b"sFA\0\x0d"}
    with pytest.raises(DeviceError, match="SetAccessMode refused 5 times: error D: server busy"):
        scripted(Scripted(busy)).run(60.0)
    t = scripted(Scripted(busy))
    t.run(60.0, until=lambda: t.device.heard.count("SetAccessMode") == 2)
    t.device.answers |= {"SetAccessMode": b"\1", "LMDscandata": b"\1", "LMDscandatacfg": b""}
    assert t.run(60.0, until=lambda: t.frames != []).frames


def test_laser_that_never_gets_ready_is_restarted_twice_and_then_reported():
    status = b"\0\4\0\0\x0800:00:00\0\x0a01.01.1970"
    answers = {
        "SCdevicestate": b"\0",
        "SetAccessMode": b"\1",
        "STlms": status,
        "LMCstartmeas": b"\0",
        "Run": b"\1",
    }
    t = scripted(Scripted(answers))
    with pytest.raises(DeviceError, match=r"state 4 \(spinning up\) 150 s after the start, expected 7"):
        t.run(300.0)
    assert t.device.heard.count("LMCstartmeas") == 3


def test_subscription_that_is_never_answered_is_a_transport_error():
    with pytest.raises(TransportError, match="sEN LMDscandata"):
        scripted(Scripted({"SCdevicestate": b"\1", "SetAccessMode": b"\1"}, streams_after="")).run(200.0)


def test_scan_before_the_answer_to_the_subscription_is_taken():
    answers = {"SCdevicestate": b"\1", "SetAccessMode": b"\1"}  # sEN LMDscandata is answered by scans alone
    t = scripted(Scripted(answers))
    assert t.run(200.0, until=lambda: t.session.status == "streaming").session.status == "streaming"
