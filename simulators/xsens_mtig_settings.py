"""The flash of a fake MTi-G or MTi-G-710: its settings and its answers to requests."""

import struct
from typing import Literal

from drivers.errors import ProtocolError
from drivers.xsens_mtig.mtdata import Layout
from drivers.xsens_mtig.mtdata2 import (
    EVERY_MESSAGE,
    KIND_MASK,
    MAX_ITEMS,
    Kind,
    read_output_configuration,
    write_output_configuration,
)
from drivers.xsens_mtig.protocol import (
    BAUD_INVALID,
    BAUD_OF_CODE,
    CODE_OF_BAUD,
    DATA_OVERFLOW,
    PARAMETER_INVALID,
    UNSUPPORTED,
    Message,
    Mid,
)
from drivers.xsens_mtig.wanted import PERIOD_HZ, PERIODS, line_bits_per_s
from simulators.xsens_mtig_data import can_send

POLLED = 0xFFFF  # skip factor of a unit that sends only on request
PERIOD_INVALID = 0x03
MAX_RATE_HZ = 400
# Of kinds that are slower: MT0101P, table of maximum output rates.
MAX_RATES = {
    Kind.TEMPERATURE: 1,
    Kind.PRESSURE: 50,
    Kind.MAGNETIC_FIELD: 100,
    Kind.GNSS_PVT: 4,
    Kind.GNSS_SATELLITES: 4,
}
ALWAYS = frozenset(
    (
        Kind.UTC,
        Kind.PACKET_COUNTER,
        Kind.SAMPLE_TIME_FINE,
        Kind.SAMPLE_TIME_COARSE,
        Kind.STATUS_BYTE,
        Kind.STATUS_WORD,
    )
)
FACTORY_OUTPUT = [  # of an MTi-G-710
    (0x1020, EVERY_MESSAGE),
    (0x1060, EVERY_MESSAGE),
    (0x2010, 100),
    (0x5022, 100),
    (0x5042, 100),
    (0xD012, 100),
    (0xE020, EVERY_MESSAGE),
]
SCENARIOS = {
    "mtdata2": (
        (1, "General"),
        (2, "GeneralNoBaro"),
        (3, "GeneralMag"),
        (4, "Automotive"),
        (5, "HighPerformanceEDR"),
    ),
    "legacy": (
        (7, "General purpose"),
        (8, "Aerospace"),
        (9, "Automotive"),
        (10, "Automotive nobaro"),
        (11, "Marine"),
    ),
}
SCENARIO_VERSION = 10
PRODUCTS = {"mtdata2": "MTi-G-710-2A5G4", "legacy": "MTi-G-28A53G35"}
SYNC_BYTES = 12

# mid -> (bytes, factory value, who has it)
_BOTH, _OLD, _NEW = ("legacy", "mtdata2"), ("legacy",), ("mtdata2",)
_REGISTERS: dict[int, tuple[int, bytes, tuple[str, ...]]] = {
    Mid.PERIOD: (2, struct.pack(">H", 1152), _BOTH),
    Mid.SKIP_FACTOR: (2, b"\x00\x00", _BOTH),
    Mid.OUTPUT_MODE: (2, b"\x00\x06", _BOTH),
    Mid.OUTPUT_SETTINGS: (4, b"\x00\x00\x00\x01", _BOTH),
    Mid.EXT_OUTPUT_MODE: (2, b"\x00\x00", _OLD),
    Mid.LOCATION_ID: (2, b"\x00\x00", _BOTH),
    Mid.ERROR_MODE: (2, b"\x00\x01", _BOTH),
    Mid.TRANSMIT_DELAY: (2, b"\x00\x00", _NEW),
    Mid.STRING_OUTPUT: (2, b"\x00\x00", _NEW),
    Mid.GNSS_PLATFORM: (2, b"\x00\x00", _NEW),
    Mid.LEVER_ARM: (12, bytes(12), _BOTH),
    Mid.LAT_LON_ALT: (24, bytes(24), _NEW),
    Mid.GRAVITY: (4, struct.pack(">f", 9.812687), _BOTH),
    Mid.MAGNETIC_DECLINATION: (4, bytes(4), _BOTH),
    Mid.HEADING: (4, bytes(4), _OLD),
    Mid.UTC_TIME: (12, struct.pack(">IHBBBBBB", 0, 2019, 1, 20, 13, 47, 24, 0), _BOTH),
    Mid.OBJECT_ALIGNMENT: (36, struct.pack(">9f", 1, 0, 0, 0, 1, 0, 0, 0, 1), _BOTH),
}
_PLAIN_ACKS = {
    Mid.RESTORE_FACTORY_DEFAULTS: _BOTH,
    Mid.STORE_XKF_STATE: _BOTH,
    Mid.ADJUST_UTC: _BOTH,
    Mid.NO_ROTATION: _NEW,
    Mid.RESET_ORIENTATION: _BOTH,
}


class Refusal(Exception):  # noqa: N818 - it is an answer, not a fault of ours
    """The device answers with an Error message of this code."""

    def __init__(self, code: int = UNSUPPORTED) -> None:
        super().__init__(code)
        self.code = code


class DeviceSettings:
    """Settings, kept over resets. A new baud rate is used from the next power-up on."""

    def __init__(
        self,
        personality: Literal["mtdata2", "legacy"],
        baud: int | None,
        product: str = "",
        fixed: frozenset[int] = frozenset(),
        unsendable: frozenset[int] = frozenset(),
    ) -> None:
        self._personality = personality
        self._product = product or PRODUCTS[personality]
        self._fixed, self._unsendable = fixed, unsendable
        self.baud = baud
        self._next_baud = baud
        self._registers: dict[int, bytes] = {}
        self._output: list[tuple[int, int]] = []
        self._syncs: dict[tuple[int, int], bytes] = {}
        self.option_flags = 0
        self.scenario = SCENARIOS[personality][0][0]
        self.alignments = [struct.pack(">4f", 1.0, 0.0, 0.0, 0.0)] * 2
        self._to_factory()

    @property
    def legacy(self) -> bool:
        return self._personality == "legacy"

    @property
    def device_id(self) -> bytes:
        return bytes.fromhex("01500618" if self.legacy else "07700DB1")

    @property
    def output(self) -> list[tuple[int, int]]:
        """Identifiers and rates of an MTi-G-710; to be set, not changed in place."""
        return self._output

    @output.setter
    def output(self, output: list[tuple[int, int]]) -> None:
        self._output = output
        self._work_out()

    def _work_out(self) -> None:
        """Compute the values below, after each change of a register or of the output.

        rate_hz     of MTData2 messages with samples; GNSS messages are apart
        period_ns   between two data messages with samples; of a unit that sends none, any
        sends_data  without a request for each message
        """
        self.mode, self.output_settings = self._number(Mid.OUTPUT_MODE), self._number(Mid.OUTPUT_SETTINGS)
        self.skip = self._number(Mid.SKIP_FACTOR)
        rates = [r for i, r in self._output if r != EVERY_MESSAGE and i & KIND_MASK != Kind.GNSS_PVT]
        self.rate_hz = max(rates, default=0)
        if self.legacy:
            skip = 0 if self.skip == POLLED else self.skip
            self.period_ns = round(1e9 * self._number(Mid.PERIOD) * (skip + 1) / PERIOD_HZ)
            self.sends_data = self.skip != POLLED
        else:
            self.period_ns = round(1e9 / (self.rate_hz or 100))
            self.sends_data = self.rate_hz > 0

    @property
    def receives_gnss(self) -> bool:
        """The solutions of an MTi-G-710 also go into its filter."""
        return self._product.startswith("MTi-G")

    def items_at(self, index: int) -> list[int]:
        """Ids of the items in the message of this sample, by their rates."""
        rate_hz = self.rate_hz
        return [
            identifier
            for identifier, rate in self.output
            if identifier & KIND_MASK != Kind.GNSS_PVT
            and (rate == EVERY_MESSAGE or index * rate // rate_hz != (index - 1) * rate // rate_hz)
        ]

    def power_up(self) -> None:
        self.baud = self._next_baud

    def write(self, mid: int, data: bytes) -> None:
        """As if it had been set before."""
        self._registers[mid] = data
        self._work_out()

    def _number(self, mid: int) -> int:
        return int.from_bytes(self._registers[mid], "big")

    def _to_factory(self) -> None:
        self._registers = {
            mid: value for mid, (_, value, who) in _REGISTERS.items() if self._personality in who
        }
        self.output = list(FACTORY_OUTPUT)

    def answer(self, message: Message) -> bytes:
        """Data of the acknowledgement. Raises Refusal."""
        mid, data = message.mid, message.data
        if data and mid in self._fixed:
            raise Refusal(PARAMETER_INVALID)
        if mid in self._registers:
            return self._register(mid, data)
        if mid in _PLAIN_ACKS:
            if self._personality not in _PLAIN_ACKS[Mid(mid)]:
                raise Refusal
            if mid == Mid.RESTORE_FACTORY_DEFAULTS:
                self._to_factory()
            return b""
        match mid:
            case Mid.REQ_DEVICE_ID | Mid.INIT_MT:
                return self.device_id
            case Mid.REQ_PRODUCT_CODE:
                return self._product.encode("ascii").ljust(0 if self.legacy else 20)
            case Mid.REQ_FIRMWARE:
                return bytes((2, 6, 1)) if self.legacy else bytes((1, 6, 0)) + struct.pack(">II", 4, 16_384)
            case Mid.REQ_HARDWARE_VERSION if not self.legacy:
                return bytes((2, 0))
            case Mid.REQ_DATA_LENGTH:
                return struct.pack(">H", self._data_bytes())
            case Mid.REQ_CONFIGURATION:
                return self.configuration()
            case Mid.BAUDRATE:
                return self._baudrate(data)
            case Mid.OUTPUT_CONFIGURATION if not self.legacy:
                return self._output_configuration(data)
            case Mid.REQ_SCENARIOS:
                return b"".join(
                    bytes((number, SCENARIO_VERSION)) + label.encode("ascii").ljust(20)
                    for number, label in SCENARIOS[self._personality]
                )
            case Mid.SCENARIO:
                return self._scenario(data)
            case Mid.OPTION_FLAGS if not self.legacy:
                return self._options(data)
            case Mid.ALIGNMENT_ROTATION if not self.legacy:
                return self._alignment(data)
            case Mid.SYNC_IN | Mid.SYNC_OUT if self.legacy:
                return self._sync(mid, data)
            case Mid.SYNC_SETTINGS if not self.legacy:
                if len(data) % SYNC_BYTES:
                    raise Refusal(PARAMETER_INVALID)
                return b""
            case Mid.RUN_SELFTEST:
                return b"\x01\xff"
            case Mid.GPS_STATUS if self.legacy:
                return bytes((16,)) + b"".join(bytes((n, n + 1, 0x0D, 7, 42)) for n in range(16))
        raise Refusal

    def _register(self, mid: int, data: bytes) -> bytes:
        if not data:
            return self._registers[mid]
        if len(data) != _REGISTERS[mid][0]:
            raise Refusal(PARAMETER_INVALID)
        if mid == Mid.PERIOD and int.from_bytes(data, "big") not in PERIODS:
            raise Refusal(PERIOD_INVALID)
        if mid == Mid.OUTPUT_SETTINGS and data[2] & 3 == 3:
            raise Refusal(PARAMETER_INVALID)
        self.write(mid, data)
        return b""

    def _data_bytes(self) -> int:
        if not self.legacy:
            return 0
        try:
            return Layout(self.mode, self.output_settings).data_bytes
        except ProtocolError as error:
            raise Refusal(PARAMETER_INVALID) from error

    def configuration(self) -> bytes:
        """Data of the Configuration message, 118 bytes."""
        return (
            self.device_id
            + struct.pack(">HHHHI", self._number(Mid.PERIOD), self.skip, 0x0010, 0, 0)
            + bytes(80)
            + struct.pack(">H", 1)
            + self.device_id
            + struct.pack(">HHI", self._data_bytes(), self.mode, self.output_settings)
            + bytes.fromhex("070A020601360202")
        )

    def _baudrate(self, data: bytes) -> bytes:
        if not data:
            return bytes((CODE_OF_BAUD[self._next_baud or 115_200],))
        if len(data) != 1 or data[0] not in BAUD_OF_CODE:
            raise Refusal(BAUD_INVALID)
        if self._next_baud is not None:
            self._next_baud = BAUD_OF_CODE[data[0]]
        return b""

    def _output_configuration(self, data: bytes) -> bytes:
        if data:
            self.output = self._effective(data)
        return write_output_configuration(self.output)

    def _effective(self, data: bytes) -> list[tuple[int, int]]:
        try:
            requested = read_output_configuration(data)
        except ProtocolError as error:
            raise Refusal(PARAMETER_INVALID) from error
        if len(requested) > MAX_ITEMS:
            raise Refusal(PARAMETER_INVALID)
        effective = []
        for identifier, rate in requested:
            if identifier == 0 and len(requested) == 1:
                return []
            kind = identifier & KIND_MASK
            without_receiver = kind == Kind.GNSS_PVT and not self.receives_gnss
            if without_receiver or kind in self._unsendable or not can_send(identifier):
                raise Refusal(PARAMETER_INVALID)
            most = MAX_RATES.get(Kind(kind), MAX_RATE_HZ)
            wanted = most if rate in (0, EVERY_MESSAGE) else min(rate, most)
            slower = next(r for r in range(wanted, 0, -1) if most % r == 0)
            effective.append((identifier, EVERY_MESSAGE if kind in ALWAYS else slower))
        if self._next_baud is not None and line_bits_per_s(effective) > self._next_baud:
            raise Refusal(DATA_OVERFLOW)
        return effective

    def _scenario(self, data: bytes) -> bytes:
        if not data:
            return bytes((SCENARIO_VERSION, self.scenario))
        number = int.from_bytes(data, "big")
        if len(data) != 2 or number not in dict(SCENARIOS[self._personality]):
            raise Refusal(PARAMETER_INVALID)
        self.scenario = number
        return b""

    def _options(self, data: bytes) -> bytes:
        if not data:
            return struct.pack(">I", self.option_flags)
        if len(data) != 8:
            raise Refusal(PARAMETER_INVALID)
        to_set, to_clear = struct.unpack(">II", data)
        self.option_flags = (self.option_flags | to_set) & ~to_clear & 0xFFFF_FFFF
        return b""

    def _sync(self, mid: int, data: bytes) -> bytes:
        """A parameter's number requests its value; number and value set it."""
        if len(data) not in (1, 3, 5):
            raise Refusal(PARAMETER_INVALID)
        if len(data) > 1:
            self._syncs[mid, data[0]] = data[1:]
            return b""
        return self._syncs.get((mid, data[0]), b"\x00\x00")

    def _alignment(self, data: bytes) -> bytes:
        if len(data) not in (1, 17) or data[0] > 1:
            raise Refusal(PARAMETER_INVALID)
        if len(data) == 1:
            return data + self.alignments[data[0]]
        self.alignments[data[0]] = data[1:]
        return b""
