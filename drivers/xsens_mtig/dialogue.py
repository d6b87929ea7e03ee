"""Start-up dialogue of an MTi-G: from the first byte to the stream. No I/O, no clock.

The order: into config state, read identity and output, write what differs, read back, into measurement state.

A device that streams acknowledges GoToConfig behind some data, and was seen to ignore it until it was reset.
The device keeps what is written over power cuts, so only what differs is written. What it refuses is left out
where samples come all the same, and named in `refusals`.
Sources: MT0101P, chapters 4 and 5; markvilar/xsensmti-py (MTi-G-700 by USB, deaf to GoToConfig);
ethz-asl/ethzasl_xsens_driver issues 55, 66 (answers of an MTi-G).
"""

import struct
from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass
from typing import TypeVar

from drivers.counted import counted
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.xsens_mtig.config import AUTO, XsensMtigConfig
from drivers.xsens_mtig.mtdata import KNOWN_MODE, Layout, Mode
from drivers.xsens_mtig.mtdata2 import KIND_MASK, Kind, read_output_configuration, write_output_configuration
from drivers.xsens_mtig.protocol import (
    BAUD_OF_CODE,
    CODE_OF_BAUD,
    DATA_OVERFLOW,
    TIMER_OVERFLOW,
    UNSUPPORTED,
    Message,
    Mid,
    error_text,
)
from drivers.xsens_mtig.wanted import (
    LegacyOutput,
    OutputItems,
    agree,
    difference,
    has_receiver,
    left_out,
    legacy_difference,
    wanted_items,
    wanted_layout,
)

GO_TO_CONFIG_S = 0.2  # between two GoToConfig
SEARCH_ATTEMPTS = 75  # 15 s: three rounds of all baud rates
IGNORED_ATTEMPTS = 10  # of a device that sends data; then it is reset
RESETS = 2
WAKE_ATTEMPTS = 50  # of 100 ms after a reset; real ones took 1.7 s
WAKE_ATTEMPT_S = 0.1
ANSWER_S = 0.5
WRITE_S = 2.0  # into its flash
ATTEMPTS = 3
OPTIONAL_ATTEMPTS = 2  # of what the stream does not depend on
SCENARIO_BYTES, SCENARIO_LABEL_BYTES = 22, 20

T = TypeVar("T")


class RefusedError(DeviceError):
    """An Error message answered a request."""

    def __init__(self, requested: str, answer: Message) -> None:
        self.reason = error_text(answer)
        self.code = answer.data[0] if answer.data else 0
        super().__init__(f"refused {requested}: {self.reason}")


@dataclass(frozen=True, slots=True)
class Ask:
    mid: int
    data: bytes
    timeout_s: float


Dialogue = Generator[Ask, Message | None, T]


class MtigDialogue:
    """Dialogue of one connection: `run` is the generator, the attributes are its results."""

    def __init__(self, config: XsensMtigConfig) -> None:
        self._config = config
        self.counters: Counter[str] = Counter()
        self.identity: dict[str, str] = {}
        self.phase = "waiting for an answer"
        self.fault = ""  # what was requested and is not available, "" where nothing is missing
        self.refusals: list[str] = []  # refused settings, as text
        self.output: OutputItems = []  # of a device that sends MTData2
        self.heard = False  # any complete message; kept by the session
        self.awaits_wake_up = False  # after our own reset
        self.baud: int | None = None if config.over_usb else 115_200
        self.legacy: LegacyOutput | None = None  # of a device that sends MTData; None: MTData2
        self.measuring = False

    def run(self) -> Dialogue[None]:
        """Raises TransportError where nothing answers, DeviceError where the device refuses."""
        self.measuring = False
        self.refusals.clear()
        yield from self._enter_config()
        yield from self._identify()
        yield from self._find_baud()
        current = yield from self._ask(Mid.OUTPUT_CONFIGURATION)
        if current is None:
            yield from self._set_up_legacy()
        else:
            self.legacy = None
            yield from self._set_up_mtdata2(read_output_configuration(current))
        if self._config.configure:
            yield from self._unless_refused("lever_arm_m", self._set_lever_arm())
            yield from self._unless_refused("filter_profile", self._set_filter_profile())
        self.phase = "starting to measure"
        yield from self._ask(Mid.GO_TO_MEASUREMENT, needed=True)
        self.measuring = True
        self.phase = "waiting for samples"

    def _unless_refused(self, setting: str, steps: Dialogue[None]) -> Dialogue[bool]:
        """Whether the device takes the setting; one that it refuses is named."""
        try:
            yield from steps
        except DeviceError as error:
            reason = error.reason if isinstance(error, RefusedError) else str(error).replace("; ", ", ")
            self.refusals.append(f"configured {setting} not taken: {reason}")
            return False
        return True

    def _write(self, mid: int, data: bytes) -> Dialogue[None]:
        yield from self._ask(mid, data, needed=True)

    def _enter_config(self) -> Dialogue[None]:
        self.phase = "waiting for an answer"
        ignored = resets = 0
        for _ in range(SEARCH_ATTEMPTS):
            if (yield Ask(Mid.GO_TO_CONFIG, b"", GO_TO_CONFIG_S)) is not None:
                return
            ignored += self.heard
            if ignored < IGNORED_ATTEMPTS:
                continue
            if resets == RESETS:
                raise TransportError(
                    f"it sends data but answers neither GoToConfig nor {RESETS} resets; is the line to it "
                    "(our TX) broken, or another program on this port?"
                )
            resets += 1
            ignored = 0
            if (yield from self._reset()):
                return
        raise TransportError(self._explain_silence())

    def _reset(self) -> Dialogue[bool]:
        """True where it is in config state afterwards."""
        self.phase = "GoToConfig is not answered; resetting the unit"
        self.counters["resets_sent"] += 1
        self.awaits_wake_up = True
        yield Ask(Mid.RESET, b"", ANSWER_S)
        for _ in range(WAKE_ATTEMPTS):
            if (yield Ask(Mid.GO_TO_CONFIG, b"", WAKE_ATTEMPT_S)) is not None:
                self.awaits_wake_up = False
                return True
        self.awaits_wake_up = False
        return False

    def _explain_silence(self) -> str:
        seconds = SEARCH_ATTEMPTS * GO_TO_CONFIG_S
        if self.heard:
            return f"messages came, but no answer to GoToConfig in {seconds:.0f} s; is our TX line broken?"
        if self._config.over_usb:
            return f"no answer in {seconds:.0f} s over USB; unplug it and plug it in again"
        if self._config.baud == AUTO:
            return f"no answer in {seconds:.0f} s at any baud rate; is it powered, is this its port?"
        return (
            f"no answer in {seconds:.0f} s at {self._config.baud} baud; is it powered, is this its port? "
            "baud: auto looks for another rate"
        )

    def _identify(self) -> Dialogue[None]:
        self.phase = "reading identity"
        device_id = yield from self._ask_if_known(Mid.REQ_DEVICE_ID)
        if device_id:
            self.identity["device_id"] = device_id.hex().upper()
        code = yield from self._ask_if_known(Mid.REQ_PRODUCT_CODE)
        if code:
            self.identity["product"] = "".join(chr(b) for b in code if 0x20 < b < 0x7F)
        firmware = yield from self._ask_if_known(Mid.REQ_FIRMWARE)
        if firmware and len(firmware) >= 3:
            self.identity["firmware"] = ".".join(map(str, firmware[:3]))

    def _find_baud(self) -> Dialogue[None]:
        """Find the line's baud rate, and write store_baud, which ends this connection."""
        if self._config.over_usb:
            return
        code = yield from self._ask_if_known(Mid.BAUDRATE)
        reported = BAUD_OF_CODE.get(code[0]) if code else None
        self.baud = self._config.baud if isinstance(self._config.baud, int) else reported or self.baud
        self.identity["baud"] = str(self.baud)
        wanted = self._config.store_baud
        if wanted is None or reported is None or wanted == reported:
            return
        self.phase = f"storing {wanted} baud"
        stored = self._write(Mid.BAUDRATE, bytes((CODE_OF_BAUD[wanted],)))
        if not (yield from self._unless_refused(f"store_baud {wanted}", stored)):
            return
        yield Ask(Mid.RESET, b"", ANSWER_S)  # from here on it has the new rate
        raise TransportError(f"it goes from {reported} to {wanted} baud as store_baud asks for")

    def _set_up_mtdata2(self, current: OutputItems) -> Dialogue[None]:
        self.phase = "reading output configuration"
        self.identity["protocol"] = "MTData2"
        if self._config.configure:
            wanted = wanted_items(self._config, self.baud)
            if not agree(wanted, current):
                self.phase = "writing output configuration"
                self.counters["settings_written"] += 1
                wanted = yield from self._write_output(wanted, current)
                again = yield from self._ask(Mid.OUTPUT_CONFIGURATION, needed=True)
                current = read_output_configuration(again or b"")
            self.fault = difference(wanted, current)
        self.output = current
        kinds = {identifier & KIND_MASK for identifier, _ in current}
        if not self._config.configure:
            self.fault = left_out(
                self._config,
                places=Kind.GNSS_PVT in kinds,
                orientation=not kinds.isdisjoint((Kind.QUATERNION, Kind.EULER, Kind.MATRIX)),
                status=not kinds.isdisjoint((Kind.STATUS_BYTE, Kind.STATUS_WORD)),
            )
        if Kind.RATE not in kinds or Kind.ACCELERATION not in kinds:
            have = ", ".join(f"{identifier:04X}" for identifier, _ in current) or "nothing"
            raise DeviceError(
                f"it sends {have}; needed are 8020 (rate of turn) and 4020 (acceleration). Is it a unit "
                f"without calibrated data, or configure: false? {', '.join(self.refusals)}".rstrip()
            )

    def _write_output(self, wanted: OutputItems, current: OutputItems) -> Dialogue[OutputItems]:
        """The accepted output: without orientation where it refuses that, `current` where it refuses all.
        Raises DeviceError where it refuses GNSS fixes alone: a unit without a receiver."""
        inertial = [item for item in wanted if item[0] & KIND_MASK != Kind.QUATERNION]
        try:
            yield from self._write(Mid.OUTPUT_CONFIGURATION, write_output_configuration(wanted))
        except RefusedError as refusal:
            if inertial != wanted and (yield from self._accepts(inertial, current)):
                self.refusals.append(f"configured orientation not taken: {refusal.reason}")
                return inertial
            bare = [item for item in inertial if item[0] & KIND_MASK != Kind.GNSS_PVT]
            product = self.identity.get("product", "")
            requests_fixes = bare != inertial and refusal.code not in (DATA_OVERFLOW, TIMER_OVERFLOW)
            if requests_fixes and (not has_receiver(product) or (yield from self._accepts(bare, current))):
                raise DeviceError(
                    f"{product or 'this unit'} has no GNSS receiver: it refused GNSS fixes "
                    f"({refusal.reason}); write gnss: false for this sensor"
                ) from refusal
            self.refusals.append(f"configured output not taken: {refusal.reason}")
        return wanted

    def _accepts(self, items: OutputItems, current: OutputItems) -> Dialogue[bool]:
        if agree(items, current):
            return True
        try:
            yield from self._write(Mid.OUTPUT_CONFIGURATION, write_output_configuration(items))
        except RefusedError:
            return False
        return True

    def _set_up_legacy(self) -> Dialogue[None]:
        self.phase = "reading output mode and settings"
        self.identity["protocol"] = "MTData"
        current = yield from self._read_legacy()
        if self._config.configure:
            wanted = wanted_layout(self._config, self.baud)
            if current != wanted:
                self.phase = "writing output mode and settings"
                self.counters["settings_written"] += 1
                yield from self._write_legacy(current, wanted)
                current = yield from self._read_legacy()
            self.fault = legacy_difference(wanted, current)
        else:
            mode = current.layout.mode
            self.fault = left_out(
                self._config,
                places=bool(mode & (Mode.POSITION | Mode.RAW_GPS)),
                orientation=bool(mode & Mode.ORIENTATION),
                status=bool(mode & Mode.STATUS),
            )
        unknown = current.layout.mode & ~KNOWN_MODE
        if unknown:
            raise DeviceError(
                f"output mode 0x{current.layout.mode:04X} holds data (0x{unknown:04X}) of unknown length; "
                "write configure: true"
            )
        names = {part.name for part in current.layout.parts()}
        if not {"rate_radps", "acceleration_mps2"} <= names:
            raise DeviceError(
                f"mode 0x{current.layout.mode:04X} with settings 0x{current.layout.settings:08X} lacks "
                "rate of turn or acceleration; "
                + (", ".join(self.refusals) or "write configure: true, or is it a unit without them?")
            )
        answer = yield from self._ask_if_known(Mid.REQ_DATA_LENGTH)
        length = int.from_bytes(answer, "big") if answer else current.layout.data_bytes
        if length != current.layout.data_bytes:
            raise DeviceError(
                f"it announces {counted(length, 'byte')} a message, mode "
                f"0x{current.layout.mode:04X} with settings "
                f"0x{current.layout.settings:08X} makes {current.layout.data_bytes}"
            )
        self.legacy = current

    def _read_legacy(self) -> Dialogue[LegacyOutput]:
        mode = yield from self._number(Mid.OUTPUT_MODE, ">H")
        settings = yield from self._number(Mid.OUTPUT_SETTINGS, ">I")
        period = yield from self._number(Mid.PERIOD, ">H")
        skip = yield from self._number(Mid.SKIP_FACTOR, ">H")
        if not period:
            raise DeviceError("output period 0; reset it to factory defaults")
        return LegacyOutput(Layout(mode, settings), period, skip)

    def _write_legacy(self, current: LegacyOutput, wanted: LegacyOutput) -> Dialogue[None]:
        """The rate first where it falls and last where it rises: no state in between is too much for it."""
        layout, rate = [], []
        rate_words = f"rate {wanted.rate_hz:g} Hz"
        if wanted.layout.mode != current.layout.mode:
            words = "output mode" + " (write gnss: false for a unit without a receiver)" * self._config.gnss
            layout.append((words, Mid.OUTPUT_MODE, struct.pack(">H", wanted.layout.mode)))
        if wanted.layout.settings != current.layout.settings:
            data = struct.pack(">I", wanted.layout.settings)
            layout.append(("output settings", Mid.OUTPUT_SETTINGS, data))
        if wanted.period != current.period:
            rate.append((rate_words, Mid.PERIOD, struct.pack(">H", wanted.period)))
        if wanted.skip != current.skip:
            rate.append((rate_words, Mid.SKIP_FACTOR, struct.pack(">H", wanted.skip)))
        for words, mid, data in layout + rate if wanted.rate_hz > current.rate_hz else rate + layout:
            yield from self._unless_refused(words, self._write(mid, data))

    def _set_lever_arm(self) -> Dialogue[None]:
        wanted = self._config.lever_arm_m
        if wanted is None:
            return
        data = struct.pack(">3f", *wanted)
        current = yield from self._ask(Mid.LEVER_ARM)
        if current != data:
            self.counters["settings_written"] += 1
            yield from self._ask(Mid.LEVER_ARM, data, needed=True)

    def _set_filter_profile(self) -> Dialogue[None]:
        wanted = self._config.filter_profile
        if wanted is None:
            return
        table = yield from self._ask(Mid.REQ_SCENARIOS, needed=True)
        profiles = dict(_scenarios(table or b""))
        number = next((n for label, n in profiles.items() if label.lower() == wanted.lower()), None)
        if number is None:
            raise DeviceError(f"no filter_profile {wanted!r}; it has {', '.join(profiles) or 'none'}")
        current = yield from self._ask(Mid.SCENARIO, needed=True)
        if not current or current[-1] != number:
            self.counters["settings_written"] += 1
            yield from self._ask(Mid.SCENARIO, struct.pack(">H", number), needed=True)
        self.identity["filter_profile"] = wanted

    def _number(self, mid: int, code: str) -> Dialogue[int]:
        answer = yield from self._ask(mid, needed=True)
        try:
            (value,) = struct.unpack(code, answer or b"")
        except struct.error as error:
            raise ProtocolError(f"answer to 0x{mid:02X} is {(answer or b'').hex()}") from error
        return int(value)

    def _ask_if_known(self, mid: int) -> Dialogue[bytes | None]:
        """Data of the answer to what the stream does not depend on; None where it is silent or refuses."""
        for _ in range(OPTIONAL_ATTEMPTS):
            answer = yield Ask(mid, b"", ANSWER_S)
            if answer is not None and answer.mid != Mid.ERROR:
                return answer.data
            if answer is not None:
                self.counters["requests_unsupported"] += 1
                return None
        self.counters["requests_unanswered"] += 1
        return None

    def _ask(self, mid: int, data: bytes = b"", needed: bool = False) -> Dialogue[bytes | None]:
        """Data of the answer; None where the device does not know the message and it is not needed.
        Raises TransportError where it does not answer, DeviceError where it refuses.
        """
        for _ in range(ATTEMPTS):
            answer = yield Ask(mid, data, WRITE_S if data else ANSWER_S)
            if answer is None:
                continue
            if answer.mid != Mid.ERROR:
                return answer.data
            if answer.data[:1] == bytes((UNSUPPORTED,)) and not needed:
                self.counters["requests_unsupported"] += 1
                return None
            requested = f"{_name(mid)} {data.hex()}".rstrip()
            raise RefusedError(requested, answer)
        raise TransportError(f"no answer to {ATTEMPTS} times {_name(mid)}; rebooting, or a bad cable?")


def _name(mid: int) -> str:
    return Mid(mid).name if mid in list(Mid) else f"0x{mid:02X}"


def _scenarios(table: bytes) -> list[tuple[str, int]]:
    """(label, number) of each filter profile of the device: type, version, label padded with blanks."""
    found = []
    for at in range(0, len(table) - SCENARIO_BYTES + 1, SCENARIO_BYTES):
        label = table[at + 2 : at + 2 + SCENARIO_LABEL_BYTES]
        text = "".join(chr(b) for b in label if 0x20 <= b < 0x7F).strip()
        if text:
            found.append((text, table[at]))
    return found
