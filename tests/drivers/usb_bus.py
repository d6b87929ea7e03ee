"""A USB bus for tests: a pyusb backend with one Xsens unit on it, in virtual time."""

import errno
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core
import usb.util

from simulators.device import FakeDevice
from tests.drivers.mtig import ZERO_NS

IN, OUT, CONTROL = 0x83, 0x02, 0x81
PACKET = 64


@dataclass(eq=False)
class Unit:
    """A device of libusb: control interface 0, and interface 1 with bulk endpoints in both directions."""

    device: FakeDevice
    product: int = 0x0017
    vendor: int = 0x2639
    serial: str = "03800123"
    kernel_driver: bool = False
    plugged: bool = True
    forbidden: bool = False
    busy: bool = False
    bulk: bool = True
    configured: bool = True


class FakeBus(usb.backend.IBackend):  # type: ignore[misc]
    """now_ns is virtual: a read that finds nothing takes its whole time-out of it."""

    def __init__(self, *units: Unit) -> None:
        self.units = units
        self.now_ns = ZERO_NS
        self.calls: list[str] = []
        self._pending = {id(unit): bytearray() for unit in units}

    def enumerate_devices(self) -> Iterator[Unit]:
        return iter([unit for unit in self.units if unit.plugged])

    def get_device_descriptor(self, dev: Unit) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0xEF, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=dev.vendor, idProduct=dev.product,
            bcdDevice=0x100, iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1, address=5,
            bus=1, port_number=1, port_numbers=(1,), speed=2, extra_descriptors=[],
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Unit, config: int) -> SimpleNamespace:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=64, bNumInterfaces=2, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=250, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Unit, intf: int, alt: int, config: int) -> SimpleNamespace:
        if intf > 1 or alt or config:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0,
            bNumEndpoints=len(self._endpoints(dev, intf)), bInterfaceClass=0xFF, bInterfaceSubClass=0,
            bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def _endpoints(self, dev: Unit, intf: int) -> list[tuple[int, int]]:
        if intf == 0 or not dev.bulk:
            return [(CONTROL, usb.util.ENDPOINT_TYPE_INTR)]
        return [(OUT, usb.util.ENDPOINT_TYPE_BULK), (IN, usb.util.ENDPOINT_TYPE_BULK)]

    def get_endpoint_descriptor(
        self, dev: Unit, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        address, kind = self._endpoints(dev, intf)[ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=address, bmAttributes=kind, wMaxPacketSize=PACKET,
            bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: Unit) -> Unit:
        self.calls.append("open")
        if dev.forbidden:
            raise usb.core.USBError("Access denied (insufficient permissions)", None, errno.EACCES)
        return dev

    def close_device(self, dev_handle: Unit) -> None:
        self.calls.append("close")

    def get_configuration(self, dev_handle: Unit) -> int:
        if not dev_handle.configured:
            raise usb.core.USBError("Configuration not set", None, errno.ENOENT)
        return 1

    def set_configuration(self, dev_handle: Unit, config_value: int) -> None:
        self.calls.append(f"set_configuration {config_value}")
        dev_handle.configured = True

    def claim_interface(self, dev_handle: Unit, intf: int) -> None:
        self.calls.append(f"claim {intf}")
        if dev_handle.busy or dev_handle.kernel_driver:
            raise usb.core.USBError("Resource busy", None, errno.EBUSY)
        dev_handle.device.connected(self.now_ns)

    def release_interface(self, dev_handle: Unit, intf: int) -> None:
        self.calls.append(f"release {intf}")

    def is_kernel_driver_active(self, dev_handle: Unit, intf: int) -> bool:
        return dev_handle.kernel_driver

    def detach_kernel_driver(self, dev_handle: Unit, intf: int) -> None:
        self.calls.append(f"detach {intf}")
        dev_handle.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: Unit, intf: int) -> None:
        self.calls.append(f"attach {intf}")
        dev_handle.kernel_driver = True

    def ctrl_transfer(
        self, dev_handle: Unit, bm: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        """GET_DESCRIPTOR of strings; number 0 lists the languages."""
        text = dev_handle.serial.encode("utf-16-le") if value & 0xFF else b"\x09\x04"
        answer = bytes((len(text) + 2, 3)) + text
        answer = answer[: len(data)]
        data[: len(answer)] = type(data)("B", answer)
        return len(answer)

    def bulk_write(self, dev_handle: Unit, ep: int, intf: int, data: Any, timeout: int) -> int:
        assert (ep, intf) == (OUT, 1)
        self._check(dev_handle)
        self._pending[id(dev_handle)] += dev_handle.device.receive_data(bytes(data), self.now_ns)
        return len(data)

    def bulk_read(self, dev_handle: Unit, ep: int, intf: int, buff: Any, timeout: int) -> int:
        assert (ep, intf) == (IN, 1)
        assert len(buff) % PACKET == 0, "a transfer that is no multiple of the packet size overflows"
        self._check(dev_handle)
        pending, device = self._pending[id(dev_handle)], dev_handle.device
        end_ns = self.now_ns + timeout * 1_000_000
        while not pending:
            due_ns = device.next_due_ns(self.now_ns)
            if due_ns is None or due_ns > end_ns:
                self.now_ns = end_ns
                raise usb.core.USBTimeoutError("Operation timed out", None, errno.ETIMEDOUT)
            self.now_ns = max(self.now_ns, due_ns)
            pending += device.due(self.now_ns)
        taken = bytes(pending[: len(buff)])
        del pending[: len(taken)]
        buff[: len(taken)] = type(buff)("B", taken)
        return len(taken)

    def _check(self, unit: Unit) -> None:
        if not unit.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", None, errno.ENODEV)
