"""Start-up with a fake LUX that answers, refuses, boots, or knows fewer commands."""

import pytest

from drivers.errors import DeviceError, TransportError
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.ibeo_lux.messages import Command, Parameter, read_command
from drivers.ibeo_lux.protocol import Decoder, ntp_difference_ns, ntp_from_unix_ns
from simulators.ibeo_lux import LuxSetup
from tests.drivers.lux import UNIX_NS, config, reconnect, talk
from tests.drivers.virtual_time import SECOND_NS


def commands(t):
    return [read_command(message.payload) for message in Decoder().receive_data(bytes(t.sent))]


def codes(t):
    return [code for code, _ in commands(t)]


def changes(t):
    return [
        Parameter(int.from_bytes(body[:2], "little"))
        for code, body in commands(t)
        if code == Command.SET_PARAMETER
    ]


AS_WANTED = {0x1012: 0xFFEE, 0x1102: 6400}


def test_device_that_is_as_it_should_be_is_not_stopped_or_changed():
    t = talk(LuxSetup(parameters=AS_WANTED)).run(3.0)
    assert changes(t) == []
    assert Command.STOP not in codes(t)
    assert Command.START not in codes(t)
    assert len(t.frames) > 60
    assert t.session.identity == {
        "firmware": "3.03.5 2015-01-14 13:32",
        "serial": "1502-147",
        "operating_hours": "1021",
    }


def test_what_differs_is_changed_with_the_scanner_stopped_and_read_back():
    t = talk(
        scan_rate_hz=50,
        first_angle_deg=40.0,
        last_angle_deg=-30.0,
        resolution="focused",
        sync_angle_deg=-90.0,
        upside_down=True,
    ).run(3.0)
    wanted = {
        Parameter.SCAN_FREQUENCY: 12_800,
        Parameter.START_ANGLE: 1280,
        Parameter.END_ANGLE: 0x10000 - 960,
        Parameter.RESOLUTION: 0,
        Parameter.SYNC_ANGLE: 0x4000 - 2880,
        Parameter.UPSIDE_DOWN: 1,
    }
    assert sorted(changes(t)) == sorted([Parameter.DATA_OUTPUT, *wanted])
    assert {parameter: t.device.parameter(parameter) for parameter in wanted} == wanted
    sent = codes(t)
    assert sent.index(Command.STOP) < sent.index(Command.SET_PARAMETER) < sent.index(Command.START)
    assert t.device.counters["saves"] == 0
    assert len(t.frames) > 80
    assert t.session.counters["scans_not_as_configured"] == 0


@pytest.mark.parametrize(
    ("stored", "wanted", "order"),
    [
        ((1600, -1920), (10.0, -10.0), [Parameter.START_ANGLE, Parameter.END_ANGLE]),
        ((-320, -960), (50.0, 0.0), [Parameter.START_ANGLE, Parameter.END_ANGLE]),
        ((1600, 320), (0.0, -50.0), [Parameter.END_ANGLE, Parameter.START_ANGLE]),
        ((1600, 320), (10.0, -50.0), [Parameter.END_ANGLE, Parameter.START_ANGLE]),
    ],
)
def test_start_angle_stays_above_the_end_angle_meanwhile(stored, wanted, order):
    parameters = AS_WANTED | {0x1100: stored[0] & 0xFFFF, 0x1101: stored[1] & 0xFFFF}
    t = talk(LuxSetup(parameters=parameters), first_angle_deg=wanted[0], last_angle_deg=wanted[1]).run(2.0)
    assert changes(t) == order
    assert t.session.counters["requests_refused"] == 0
    assert t.frames


@pytest.mark.parametrize("at_once", [True, False])
def test_clock_is_set_to_utc_before_scans_are_used(at_once):
    t = talk(LuxSetup(sets_ntp_at_once=at_once)).run(2.0)
    assert t.device.counters["clock_sets"] == (1 if at_once else 2)
    shows = t.device.ntp(t.now_ns)
    assert abs(ntp_difference_ns(shows, ntp_from_unix_ns(UNIX_NS + t.now_ns))) < 1_000_000
    assert t.session.counters["clock_resets"] == 0
    assert t.frames


def test_clock_whose_second_turns_between_the_two_commands_is_set_again():
    t = talk(LuxSetup(sets_ntp_at_once=False))
    readings = iter([0, 999_999_999, 1_000_000_001, 1_000_000_002, 1_000_000_003])
    t.session = IbeoLuxSession(config(), lambda: UNIX_NS + next(readings))
    t.run(1.0)
    assert t.device.counters["clock_sets"] == 4
    assert t.device.ntp(t.now_ns) >> 32 == (ntp_from_unix_ns(UNIX_NS) >> 32) + 1 + (
        t.now_ns // SECOND_NS - 1000
    )


@pytest.mark.parametrize(
    ("setup", "wanted", "words"),
    [
        (
            LuxSetup(unsupported=frozenset({Parameter.UPSIDE_DOWN})),
            {"upside_down": True},
            "configured upside_down true not taken: refused 3 times, so left and right of its scans would be "
            "exchanged; write upside_down: null",
        ),
        (
            LuxSetup(measuring=False, refused=frozenset({Command.START})),
            {},
            "Start was refused 3 times; motor off",
        ),
    ],
)
def test_refusal_of_what_is_needed_is_a_device_error_in_words(setup, wanted, words):
    t = talk(setup, **wanted)
    with pytest.raises(DeviceError, match=words):
        t.run(60.0)


@pytest.mark.parametrize("stored", [0x0000, 0x0010])
def test_output_that_cannot_be_changed_is_borne_where_scans_come(stored):
    """Objects come along, or errors do not."""
    parameters = {0x1012: stored, 0x1102: 6400}
    t = talk(LuxSetup(parameters=parameters, refused=frozenset({Command.SET_PARAMETER}))).run(3.0)
    assert len(t.frames) > 50
    assert t.session.counters["output_not_set"] == 1
    assert t.session.status.startswith("streaming")


def test_output_without_scans_that_cannot_be_changed_is_a_device_error():
    parameters = {0x1012: 0x0001, 0x1102: 6400}
    with pytest.raises(DeviceError, match=r"output 0xffee not taken: refused 3 times, it has 0x1, so"):
        talk(LuxSetup(parameters=parameters, refused=frozenset({Command.SET_PARAMETER}))).run(10.0)


def test_device_that_stands_still_is_started_and_waited_for():
    t = talk(LuxSetup(measuring=False, start_delay_ns=4 * SECOND_NS)).run(8.0)
    assert t.device.counters["starts"] == 1
    assert any("waiting for the mirror: laser off" in status for status in t.statuses)
    assert len(t.frames) > 60


def test_device_that_says_it_runs_but_sends_nothing_is_started():
    t = talk(LuxSetup(parameters=AS_WANTED))
    t.device.turning_since_ns = t.now_ns + 3_600 * SECOND_NS
    t.device.scanner_status = lambda now_ns: 0x030B
    t.run(2.5)
    assert t.device.counters["starts"] == 1


def test_device_that_sends_but_does_not_answer_is_taken_as_it_is():
    t = talk(LuxSetup(parameters={0x1102: 6400}), scan_rate_hz=50)
    receive = t.device.receive_data
    t.device.receive_data = lambda data, now_ns: receive(data, now_ns) and b""
    t.run(10.0)
    assert t.session.identity == {"commands": "not answered; taken as it is"}
    assert len(t.frames) > 100
    assert t.session.status == (
        "streaming; scans at 25 Hz from 50 to -60 deg, configured 50 Hz from 50 to -60 deg"
    )


@pytest.mark.parametrize(("rate_hz", "is_other"), [(25, False), (50, True)])
def test_device_that_answers_only_later_is_set_up_where_its_scans_are_not_as_configured(rate_hz, is_other):
    t = talk(LuxSetup(parameters={0x1102: 6400}), scan_rate_hz=rate_hz)
    receive = t.device.receive_data
    t.device.receive_data = lambda data, now_ns: receive(data, now_ns) and b""
    t.run(10.0)
    t.device.receive_data = receive
    if is_other:
        with pytest.raises(TransportError, match="scans come at 25 Hz from 50 to -60 deg, configured 50 Hz"):
            t.run(10.0)
        reconnect(t, scan_rate_hz=rate_hz)
    t.run(12.0)
    assert t.session.status.startswith("streaming")
    assert "configured" not in t.session.status
    assert t.session.counters["scans_not_as_configured"] == 0
    assert "commands" not in t.session.identity


def test_motor_that_does_not_start_is_a_device_error_in_words():
    t = talk(LuxSetup(measuring=False))
    t.device.motor_failed = True
    with pytest.raises(DeviceError, match=r"no scan 30 s after Start: motor off.*it reports: motor 1 fault"):
        t.run(60.0)
