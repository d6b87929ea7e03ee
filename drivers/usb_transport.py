"""Bytes over a USB device's bulk endpoints, through libusb. The only module of drivers that uses USB."""

import errno
from collections.abc import Collection, Iterator
from typing import Any

import usb.core
import usb.util

from drivers.counted import counted
from drivers.errors import TransportError
from drivers.transport import Transport

READ_BYTES = 4096  # a multiple of every packet size: else a full packet overflows
WRITE_TIMEOUT_MS = 1000

BULK = usb.util.ENDPOINT_TYPE_BULK


class UsbTransport(Transport):
    """The first device of this vendor that is one of the products and, if given, has this serial number.

    A kernel driver that holds the interface (Linux makes /dev/ttyUSB of some) is detached while it is open.
    Raises TransportError when there is no such device, no right to open it, and when it is unplugged.
    backend: a usb.backend.IBackend in place of libusb's, for tests.
    """

    def __init__(
        self, vendor: int, products: Collection[int], serial: str | None = None, backend: Any = None
    ) -> None:
        self._where = f"USB {vendor:04x}" + (f" serial {serial}" if serial else "")
        self._device: Any = None
        self._claimed = self._detached = False
        try:
            self._device = self._find(vendor, products, serial, backend)
            self._interface, self._in, self._out = self._endpoints()
            self._claim()
        except usb.core.NoBackendError as error:
            raise TransportError(
                f"{self._where}: no libusb-1.0 here; on Debian and Ubuntu: apt install libusb-1.0-0"
            ) from error
        except usb.core.USBError as error:
            self.close()
            raise TransportError(f"{self._where}: cannot open: {_words(error)}") from error

    def _find(self, vendor: int, products: Collection[int], serial: str | None, backend: Any) -> Any:
        found = [
            device
            for device in usb.core.find(find_all=True, idVendor=vendor, backend=backend)
            if device.idProduct in products
        ]
        seen = []
        for device in found:
            number = self._serial_number(device) if serial is not None else None
            if serial is None or number == serial:
                return device
            seen.append(number or "unreadable")
        there = f"; there are those with serial {', '.join(seen)}" if seen else ""
        raise TransportError(f"{self._where}: no such device is plugged in{there}")

    def _serial_number(self, device: Any) -> str | None:
        try:
            number: str | None = usb.util.get_string(device, device.iSerialNumber)
        except ValueError as error:  # pyusb's word for a device whose strings it may not read
            raise TransportError(f"{self._where}: no rights to read its serial number ({error})") from error
        return number

    def _endpoints(self) -> tuple[int, int, int]:
        """Interface number and both bulk endpoints: of the first interface that has both directions."""
        for interface in self._interfaces():
            bulk = [e for e in interface if usb.util.endpoint_type(e.bmAttributes) == BULK]
            into = [e.bEndpointAddress for e in bulk if e.bEndpointAddress & 0x80]
            out = [e.bEndpointAddress for e in bulk if not e.bEndpointAddress & 0x80]
            if into and out:
                return interface.bInterfaceNumber, into[0], out[0]
        raise TransportError(f"{self._where}: no interface with bulk endpoints in both directions")

    def _interfaces(self) -> Iterator[Any]:
        for configuration in self._device:
            yield from configuration

    def _claim(self) -> None:
        try:
            if self._device.is_kernel_driver_active(self._interface):
                self._device.detach_kernel_driver(self._interface)
                self._detached = True
        except NotImplementedError:  # pyusb: this system has no drivers to detach
            pass
        try:
            self._device.get_active_configuration()
        except usb.core.USBError:
            self._device.set_configuration()
        usb.util.claim_interface(self._device, self._interface)
        self._claimed = True

    def read(self, timeout_s: float) -> bytes:
        try:
            return bytes(self._device.read(self._in, READ_BYTES, max(1, round(timeout_s * 1000))))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as error:
            raise TransportError(f"{self._where}: {_words(error)}") from error

    def write(self, data: bytes) -> None:
        try:
            sent = self._device.write(self._out, data, WRITE_TIMEOUT_MS)
        except usb.core.USBError as error:
            raise TransportError(
                f"{self._where}: cannot send {counted(len(data), 'byte')}: {_words(error)}"
            ) from error
        if sent != len(data):
            raise TransportError(f"{self._where}: {sent} of {counted(len(data), 'byte')} sent")

    def close(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        try:
            if self._claimed:
                usb.util.release_interface(device, self._interface)
            if self._detached:
                device.attach_kernel_driver(self._interface)
        except (usb.core.USBError, NotImplementedError):  # it may be unplugged already
            pass
        finally:
            usb.util.dispose_resources(device)


def _words(error: usb.core.USBError) -> str:
    match error.errno:
        case errno.ENODEV | errno.EIO | errno.EPROTO:
            return f"{error}; unplugged?"
        case errno.EACCES | errno.EPERM:
            return f"{error}; no rights: install the udev rule, or join its group"
        case errno.EBUSY:
            return f"{error}; another program has it open"
        case _:
            return str(error)
