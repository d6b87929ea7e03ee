"""From the first byte to the stream: quiet and deaf devices, settings written only where they differ."""

import struct
from typing import Literal

import pytest

from drivers.errors import DeviceError, TransportError
from drivers.xsens_mtig.protocol import Message, MessageDecoder, Mid, encode
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from simulators.xsens_mtig_settings import FACTORY_OUTPUT, Refusal
from tests.drivers.mtig import MS, ZERO_NS, Swing, fixes, legacy, mtdata2, samples, talk
from tests.drivers.virtual_time import SECOND_NS

BOTH = pytest.mark.parametrize("make", [mtdata2, legacy])


def messages_in(wire: bytes) -> list[Message]:
    return MessageDecoder().receive_data(bytes(wire))


def sent_with_data(wire: bytes) -> list[int]:
    """Ids of what was set."""
    return [message.mid for message in messages_in(wire) if message.data]


@BOTH
def test_samples_come_at_200_hz_a_third_of_a_second_after_the_first_byte(make):
    t = talk(make()).run(0.35)
    assert samples(t.frames)
    t.run(10.0)
    assert len(samples(t.frames)) == pytest.approx(2055, abs=15)
    assert len(fixes(t.frames)) == pytest.approx(40, abs=3)
    assert t.session.status.startswith("streaming; filter valid, GNSS")


def test_who_it_is_is_read():
    t = talk(mtdata2()).run(1.0)
    assert t.session.identity == {
        "device_id": "07700DB1",
        "product": "MTi-G-710-2A5G4",
        "firmware": "1.6.0",
        "baud": "115200",
        "protocol": "MTData2",
    }
    t = talk(legacy()).run(1.0)
    assert t.session.identity["product"] == "MTi-G-28A53G35"
    assert t.session.identity["protocol"] == "MTData"


@BOTH
def test_settings_are_written_once_read_back_and_left_alone_ever_after(make):
    device = make()
    first = talk(device).run(2.0)
    assert first.session.counters["settings_written"] == 1
    assert sent_with_data(first.sent)
    device.receive_data(first.session.shutdown_request(), first.now_ns)
    second = talk(device)
    second.now_ns = first.now_ns + 1_000_000_000
    second.run(2.0)
    assert samples(second.frames)
    assert second.session.counters["settings_written"] == 0
    assert sent_with_data(second.sent) == []


def test_rate_of_a_legacy_unit_falls_before_its_messages_grow():
    device = legacy(baud=460_800)
    t = talk(device, rate_hz=50).run(1.0)
    assert sent_with_data(t.sent) == [Mid.SKIP_FACTOR, Mid.OUTPUT_MODE, Mid.OUTPUT_SETTINGS]
    assert device.settings.skip == 1
    t = talk(legacy(baud=460_800), rate_hz=200).run(1.0)
    assert sent_with_data(t.sent) == [Mid.OUTPUT_MODE, Mid.OUTPUT_SETTINGS, Mid.PERIOD]


def test_a_unit_that_shall_not_be_configured_is_not():
    device = mtdata2()
    device.settings.output = [(0x1020, 0xFFFF), (0x1060, 0xFFFF), (0x2034, 100), (0x4022, 100), (0x8021, 100)]
    kept = list(device.settings.output)
    t = talk(device, configure=False).run(2.0)
    assert device.settings.output == kept
    assert sent_with_data(t.sent) == []
    assert len(samples(t.frames)) == pytest.approx(190, abs=10)
    assert samples(t.frames)[-1].orientation_wxyz is not None


def test_factory_output_holds_no_samples_and_says_so():
    device = mtdata2()
    assert device.settings.output == FACTORY_OUTPUT
    with pytest.raises(DeviceError, match=r"it sends 1020, 1060, 2010, .* needed are 8020.*configure: false"):
        talk(device, configure=False).run(2.0)


@pytest.mark.parametrize(
    ("mode", "settings", "diagnostic"),
    [
        (0x4000, 0x1, "lacks rate of turn"),
        (0x0002, 0x21, "lacks rate of turn"),
        (0x0102, 0x1, r"holds data \(0x0100\) of unknown length"),
    ],
)
def test_legacy_output_that_is_no_use_says_so(mode: int, settings: int, diagnostic: str):
    device = legacy()
    device.settings.write(Mid.OUTPUT_MODE, struct.pack(">H", mode))
    device.settings.write(Mid.OUTPUT_SETTINGS, struct.pack(">I", settings))
    with pytest.raises(DeviceError, match=diagnostic):
        talk(device, configure=False).run(2.0)


def test_deaf_device_is_reset_and_found_again():
    device = FakeMtiG(Swing(), ignores_go_to_config=True)
    t = talk(device).run(6.0)
    assert t.session.counters["resets_sent"] == 1
    assert "GoToConfig is not answered; resetting the unit" in t.statuses
    assert samples(t.frames)
    assert t.session.counters["wake_ups"] == 1
    assert t.session.counters["device_restarts"] == 0


class Reticent(FakeMtiG):
    """It does not answer these messages, or refuses them with error 0x28."""

    unanswered: tuple[int, ...] = ()
    refused: tuple[int, ...] = ()

    def _act(self, message: Message, now_ns: int) -> bytes | None:
        if message.mid in self.unanswered:
            return None
        if message.mid in self.refused:
            raise Refusal(0x28)
        return super()._act(message, now_ns)


IDENTITY = (Mid.REQ_DEVICE_ID, Mid.REQ_PRODUCT_CODE, Mid.REQ_FIRMWARE, Mid.BAUDRATE, Mid.REQ_DATA_LENGTH)


@pytest.mark.parametrize("personality", ["mtdata2", "legacy"])
@pytest.mark.parametrize("how", ["unanswered", "refused"])
def test_a_unit_that_does_not_say_who_it_is_streams_all_the_same(personality: Literal["mtdata2"], how: str):
    device = Reticent(Swing(), MtigSetup(personality=personality))
    setattr(device, how, IDENTITY)
    t = talk(device).run(6.0)
    assert len(samples(t.frames)) > 100
    assert t.session.identity == {
        "baud": "115200",
        "protocol": {"mtdata2": "MTData2", "legacy": "MTData"}[personality],
    }
    assert t.session.counters["requests_unanswered" if how == "unanswered" else "requests_unsupported"] >= 4


def test_a_unit_that_does_not_tell_its_output_is_given_up():
    device = Reticent(Swing())
    device.unanswered = (Mid.OUTPUT_CONFIGURATION,)
    t = talk(device)
    with pytest.raises(TransportError, match="no answer to 3 times OUTPUT_CONFIGURATION; rebooting, or"):
        t.run(6.0)
    assert [message.mid for message in messages_in(t.sent)].count(Mid.OUTPUT_CONFIGURATION) == 3


class Earless(FakeMtiG):
    """Its receive line is broken."""

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        return b""


def test_device_that_hears_nothing_at_all_is_given_up_in_words():
    t = talk(Earless(Swing()))
    with pytest.raises(TransportError, match="neither GoToConfig nor 2 resets"):
        t.run(60.0)
    assert t.now_ns < ZERO_NS + 30 * SECOND_NS


def test_new_baud_rate_is_stored_and_the_unit_reset():
    device = mtdata2()
    t = talk(device, store_baud=460_800)
    with pytest.raises(TransportError, match="goes from 115200 to 460800 baud"):
        t.run(2.0)
    t.exchange()
    assert device.settings.baud == 460_800
    t = talk(device, store_baud=460_800)
    t.now_ns += 3_000_000_000
    t.run(4.0)
    assert t.session.identity["baud"] == "460800"
    assert samples(t.frames)[-1].orientation_wxyz is not None  # the faster line carries it


@BOTH
def test_lever_arm_and_filter_profile_are_written_where_they_differ(make):
    device = make()
    changes = {"lever_arm_m": (0.25, 0.0, 0.5), "filter_profile": "automotive"}
    t = talk(device, **changes).run(1.5)
    assert {Mid.LEVER_ARM, Mid.SCENARIO} <= set(sent_with_data(t.sent))
    assert device.settings.scenario in (4, 9)
    assert t.session.identity["filter_profile"] == "automotive"
    again = talk(device, **changes)
    again.now_ns = t.now_ns
    again.run(1.5)
    assert sent_with_data(again.sent) == []
    t = talk(make(), filter_profile="submarine").run(2.0)
    assert "filter_profile not taken: no filter_profile 'submarine', it has General" in t.session.status
    assert samples(t.frames)


def test_a_preamble_in_garbage_does_not_hold_up_the_answers():
    """It promises 192 bytes; a device in config state sends 5 at a time, five times a second."""
    device = mtdata2()
    t = talk(device)
    device.receive_data(encode(Mid.GO_TO_CONFIG), t.now_ns)
    t.now_ns += 30 * MS
    device.due(t.now_ns)
    t.session.receive_data(b"\xfa\xff\x36\xc0", t.now_ns)
    t.run(1.5)
    assert len(samples(t.frames)) > 50
