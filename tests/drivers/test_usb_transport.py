"""The USB wire, with a fake pyusb backend under it and a fake MTi-G-710 at its end."""

import pytest
import usb.core

from drivers.errors import TransportError
from drivers.usb_transport import UsbTransport
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.port import PRODUCTS, VENDOR
from drivers.xsens_mtig.protocol import MessageDecoder, Mid, encode
from simulators.xsens_mtig import FakeMtiG, MtigSetup
from tests.drivers.mtig import Swing, config, fixes, samples
from tests.drivers.usb_bus import FakeBus, Unit


def unit(**changes: object) -> Unit:
    return Unit(FakeMtiG(Swing(), MtigSetup(baud=None)), **changes)  # type: ignore[arg-type]


def open_usb(bus: FakeBus, serial: str | None = None) -> UsbTransport:
    return UsbTransport(VENDOR, PRODUCTS, serial, backend=bus)


def test_device_is_found_claimed_and_given_back():
    bus = FakeBus(unit(vendor=0x1D6B, product=2), unit())
    with open_usb(bus) as transport:
        transport.write(encode(Mid.GO_TO_CONFIG))
        decoder, mids = MessageDecoder(), []
        while Mid.GO_TO_CONFIG + 1 not in mids:
            mids += [message.mid for message in decoder.receive_data(transport.read(0.02))]
        assert transport.read(0.02) == b""  # nothing more: a time-out is no fault
    assert bus.calls == ["open", "claim 1", "release 1", "close"]
    transport.close()
    assert bus.calls[-1:] == ["close"]


def test_kernel_driver_is_detached_and_attached_again():
    bus = FakeBus(unit(kernel_driver=True))
    with open_usb(bus):
        assert "detach 1" in bus.calls
    assert bus.calls[-3:] == ["release 1", "attach 1", "close"]


def test_device_without_a_configuration_gets_one():
    bus = FakeBus(unit(configured=False))
    with open_usb(bus):
        assert "set_configuration 1" in bus.calls


def test_one_of_several_is_chosen_by_its_serial_number():
    one, other = unit(serial="0380A"), unit(serial="0380B")
    bus = FakeBus(one, other)
    with open_usb(bus, "0380B") as transport:
        transport.write(encode(Mid.GO_TO_CONFIG))
    assert (list(one.device.received), list(other.device.received)) == ([], [Mid.GO_TO_CONFIG])  # type: ignore[attr-defined]
    with pytest.raises(TransportError, match=r"serial 0380C: no such device .* serial 0380A, 0380B"):
        open_usb(bus, "0380C")


@pytest.mark.parametrize(
    ("changes", "diagnostic"),
    [
        ({"plugged": False}, "USB 2639: no such device is plugged in$"),
        ({"product": 0x0101}, "no such device"),
        ({"forbidden": True}, "no rights: install the udev rule"),
        ({"busy": True}, "another program has it open"),
        ({"bulk": False}, "no interface with bulk endpoints"),
    ],
)
def test_what_hinders_is_reported_in_words(changes: dict[str, object], diagnostic: str):
    with pytest.raises(TransportError, match=diagnostic):
        open_usb(FakeBus(unit(**changes)))


def test_device_that_cannot_be_had_is_given_back():
    bus = FakeBus(unit(kernel_driver=True, busy=True))
    with pytest.raises(TransportError, match="another program"):
        open_usb(bus)
    assert bus.calls == ["open", "detach 1", "claim 1", "attach 1", "close"]


def test_serial_number_that_may_not_be_read_is_reported():
    with pytest.raises(TransportError, match="no rights to read its serial number"):
        open_usb(FakeBus(unit(forbidden=True)), "0380A")


def test_missing_libusb_is_reported_with_its_remedy(monkeypatch: pytest.MonkeyPatch):
    def nothing(**_: object) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr("usb.core.find", nothing)
    with pytest.raises(TransportError, match=r"no libusb-1.0 here; .* apt install libusb-1.0-0"):
        UsbTransport(VENDOR, PRODUCTS)


def test_unplugging_ends_the_link_in_words():
    there = unit()
    transport = open_usb(FakeBus(there))
    there.plugged = False
    with pytest.raises(TransportError, match=r"USB 2639: .*unplugged"):
        transport.read(0.02)
    with pytest.raises(TransportError, match=r"cannot send 5 bytes: .*unplugged"):
        transport.write(encode(Mid.GO_TO_CONFIG))
    transport.close()


def test_mti_g_710_is_read_at_200_hz_over_its_own_usb():
    bus = FakeBus(unit())
    session = XsensMtigSession(config(device="usb"))
    frames = []
    begin_ns = bus.now_ns
    with open_usb(bus) as transport:
        while bus.now_ns < begin_ns + 10_000_000_000:
            session.tick(bus.now_ns)
            if session.outbox:
                transport.write(bytes(session.outbox))
                session.outbox.clear()
            if data := transport.read(0.02):
                frames += session.receive_data(data, bus.now_ns)
    assert len(samples(frames)) == pytest.approx(2000, abs=25)
    assert len(fixes(frames)) >= 38
    assert samples(frames)[-1].orientation_wxyz is not None
    assert session.counters["bytes_skipped"] == 0
    late_ns = [s.stamp_ns - 1_000_000_000_000 - s.rate_radps[2] * 1e9 for s in samples(frames)[200:]]
    assert max(late_ns) - min(late_ns) < 200_000
    assert late_ns[-1] == pytest.approx(1_000_000, abs=200_000)
