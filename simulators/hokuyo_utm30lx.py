"""A fake Hokuyo laser of drivers.hokuyo_utm30lx.models. No I/O.

It answers the requests of third-party clients at their start-up (urg_library, hokuyo_node, MRPT, hokuyolx) in
the order and form they need, and reproduces the behaviour of real ones: silence while booting, 0M until the
motor turns evenly, a USB unit that goes on streaming after its client died, a clock of milliseconds that
drifts and wraps.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.protocol import (
    ABNORMAL,
    CLOCK_MODULUS,
    DENIED,
    MAX_STRING_CHARS,
    NOT_DEFINED,
    OK,
    RESUMED,
    SCIP_1,
    UNSTABLE,
    CommandDecoder,
    encode_info,
    encode_number,
    encode_reply,
)
from drivers.hokuyo_utm30lx.scans import ScanRequest, read_request, write_scan
from simulators.device import TURNS_SKIPPED, SweepSource, turns_to_skip
from simulators.hokuyo_optics import Optics
from simulators.hokuyo_setup import REPLIES, Utm30lxSetup

LEAVES_AFTER_SWEEP_NS = 300_000
REBOOT_WINDOW_NS = 1_000_000_000  # the second RB must come within
TOO_SHORT, TOO_LONG = {"usb": "0C", "ethernet": "0H"}, {"usb": "0G", "ethernet": "0D"}
STRING_TOO_LONG, NOT_SUPPORTED, ALREADY, INCOMPATIBLE, NOT_ADJUSTING = "0G", "0F", "02", "04", "04"
LASER_BROKEN = "01"
LOCKED_UP_NS = 1 << 62
SCANS = ("GD", "GS", "GE", "HD", "HE", "MD", "MS", "ME", "ND", "NE")
IN_ABNORMAL_STATE = ("VV", "PP", "II", "RB")
IN_TIME_ADJUST = ("VV", "II", "TM", "%ST", "RB")


class FakeUtm30lx:
    """One device with room for one client. While it runs set `abnormal`, `laser_broken`, `fault_status` (from
    21 to 97: its stream stops with it) or `stalled` (the same scan again and again)."""

    def __init__(self, source: SweepSource, setup: Utm30lxSetup | None = None) -> None:
        setup = setup or Utm30lxSetup()
        self.setup = setup
        self.abnormal = False
        self.laser_broken = False
        self.fault_status = ""
        self.stalled = False
        self.counters: Counter[str] = Counter()
        own = {name: getattr(setup, name) for name in ("last_step", "no_return_mm")}
        given = {name: value for name, value in own.items() if value is not None}
        self._replies = REPLIES[setup.model, setup.wire]._replace(**given)
        self._optics = Optics(source, self._replies)
        self._decoder = CommandDecoder()
        self._powered_on_ns: int | None = None
        self._answers_from_ns = 0
        self._steady_from_ns = 0
        self._clock_zero_ns = 0
        self._clock_zero_ms = 0
        self._scip_1 = setup.scip_1
        self._laser_on = False
        self._adjusting = False
        self._asleep = False
        self._speaks_high = False
        self._baud = 19_200
        self._reboot_requested_ns: int | None = None
        self._stream: ScanRequest | None = None
        self._stream_echo = ""
        self.stopped_with = ""
        self._next_turn = self._measured_turn = 0
        self._single: deque[tuple[ScanRequest, str, int]] = deque()  # request, echo, turn

    def connected(self, now_ns: int) -> bytes:
        self._decoder = CommandDecoder()
        if self._powered_on_ns is None:
            self.power_on(now_ns)
        if self._stream is None:
            return b""
        self._next_turn = self._turn_after(now_ns)
        telegram = self._scan_message(self._stream, self._stream_echo, self._next_turn - 1, "99")
        return telegram[len(telegram) // 2 :]  # the client connects within a telegram

    def disconnected(self, now_ns: int) -> None:
        self._single.clear()
        if self.setup.wire == "ethernet":
            self._stop()

    def power_on(self, now_ns: int) -> None:
        """As after a power cut: stored state is lost."""
        self._powered_on_ns = now_ns
        self._answers_from_ns = now_ns + self.setup.boot_ns
        self._steady_from_ns = self._answers_from_ns + self.setup.warm_up_ns
        self._set_clock(now_ns, self.setup.clock_start_ms)
        self._scip_1 = self.setup.scip_1
        self._adjusting = self._asleep = False
        self._stop()

    def restart(self, now_ns: int) -> None:
        self._decoder = CommandDecoder()
        self._speaks_high, self._baud, self._reboot_requested_ns = False, 19_200, None
        self.power_on(now_ns)

    def jump_clock(self, seconds: float) -> None:
        self._clock_zero_ms += round(seconds * 1000)

    def spoil_checksum(self, message: bytes) -> bytes:
        """Of its last line; a lone echo has none."""
        if len(message) < 4 or not message.endswith(b"\n\n"):
            return message
        return message[:-3] + bytes([message[-3] ^ 0x01]) + message[-2:]

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        commands = self._decoder.receive_data(data)
        if now_ns < self._answers_from_ns:
            self.counters["commands_while_deaf"] += len(commands)
            return b""
        return b"".join(self._answer(command, now_ns) for command in commands)

    def next_due_ns(self, now_ns: int) -> int | None:
        if now_ns < self._answers_from_ns:
            return None
        times = [self._leaves_ns(turn, request) for request, _, turn in self._single]
        if self._stream is not None:
            if bool(self.fault_status) != bool(self.stopped_with):
                return now_ns
            if not self.stopped_with:
                times.append(self._leaves_ns(self._next_turn, self._stream))
        return min(times, default=None)

    def due(self, now_ns: int) -> bytes:
        due_ns = self.next_due_ns(now_ns)
        if due_ns is None or due_ns > now_ns:
            return b""
        if self._single and self._leaves_ns(self._single[0][2], self._single[0][0]) <= now_ns:
            request, echo, turn = self._single.popleft()
            return self._scan_message(request, echo, turn, OK)
        return self._stream_on(now_ns)

    def first_ray_ns(self, turn: int) -> int:
        """When the mirror passed step 0 in that turn, counted from power-up."""
        return self._steady_from_ns + round(turn * self._turn_ns())

    def _stream_on(self, now_ns: int) -> bytes:
        request = self._stream
        assert request is not None
        if self.fault_status and not self.stopped_with:
            return self._stop_for_fault()
        if self.stopped_with and not self.fault_status:
            self.stopped_with = ""
            self._next_turn = self._turn_after(now_ns)
            return encode_reply(self._stream_echo, RESUMED)
        turns = 1 + request.skip
        behind_ns = now_ns - self._leaves_ns(self._next_turn, request)
        skipped = turns_to_skip(behind_ns, turns * self._turn_ns())
        if skipped:
            self.counters[TURNS_SKIPPED] += skipped
            self._next_turn += skipped * turns
        remaining = max(request.count - 1, 0)
        text = replace(request, count=remaining).text
        echo = text + self._stream_echo[len(text) :]
        self._measured_turn = self._measured_turn if self.stalled else self._next_turn
        message = self._scan_message(request, echo, self._measured_turn, "99")
        self._next_turn += turns
        self.counters["scans_sent"] += 1
        if request.count:
            self._stream = replace(request, count=remaining)
            if not remaining:
                self._stop()
        return message

    def _stop_for_fault(self) -> bytes:
        self.stopped_with = self.fault_status
        message = encode_reply(self._stream_echo, self.fault_status)
        if self.fault_status >= "50":
            self._stop()
            self.abnormal, self.fault_status = True, ""
        return message

    def _stop(self) -> None:
        self._stream = None
        self.stopped_with = ""
        self._laser_on = False
        self._single.clear()

    def _turn_ns(self) -> float:
        return 60e9 / self._replies.speed_rpm / self.setup.motor_speed

    def _turn_after(self, now_ns: int) -> int:
        """The first turn that begins at now_ns or later."""
        return max(0, -int(-(now_ns - self._steady_from_ns) // self._turn_ns()))

    def _leaves_ns(self, turn: int, request: ScanRequest) -> int:
        sweep_ns = self._turn_ns() * request.last_step / self._replies.steps_per_turn
        return self.first_ray_ns(turn) + round(sweep_ns) + LEAVES_AFTER_SWEEP_NS

    def _set_clock(self, now_ns: int, ms: int) -> None:
        self._clock_zero_ns, self._clock_zero_ms = now_ns, ms

    def clock_ms(self, host_ns: int) -> int:
        since_ms = (host_ns - self._clock_zero_ns) * (1.0 + self.setup.clock_drift_ppm * 1e-6) / 1e6
        return (self._clock_zero_ms + int(since_ms // 1)) % CLOCK_MODULUS

    def _scan_message(self, request: ScanRequest, echo: str, turn: int, status: str) -> bytes:
        replies = self._replies
        step_ns = self._turn_ns() / replies.steps_per_turn
        stamped_ns = self.first_ray_ns(turn)
        if self.setup.stamps_rear:
            stamped_ns += round((replies.front_step - replies.steps_per_turn / 2) * step_ns)
        scan = self._optics.measure(request, self.first_ray_ns(turn), step_ns, self.clock_ms(stamped_ns))
        return write_scan(scan, echo, status)

    def _answer(self, command: str, now_ns: int) -> bytes:
        self.counters["commands"] += 1
        if self._scip_1:
            self._scip_1 = command != "SCIP2.0"
            return encode_reply(command, SCIP_1 if self._scip_1 else "0")
        name = command[:3] if command.startswith("%") else command[:2]
        if name in self._replies.locks_up_at:
            self._answers_from_ns = LOCKED_UP_NS
            return b""
        length = self._replies.commands.get(name)
        if length is None:
            return self._refuse(command, NOT_DEFINED)
        text, string = command[:length], command[length:]
        if len(text) < length:
            return self._refuse(command, TOO_SHORT[self.setup.wire])
        if string and self.setup.wire == "ethernet" and not string.startswith(";"):
            return self._refuse(command, TOO_LONG[self.setup.wire])
        if len(string.removeprefix(";")) > MAX_STRING_CHARS:
            return self._refuse(command, STRING_TOO_LONG)
        if self.abnormal and name not in IN_ABNORMAL_STATE:
            return self._refuse(command, ABNORMAL)
        if self._adjusting and name not in IN_TIME_ADJUST:
            return self._refuse(command, NOT_DEFINED if name == "QT" else DENIED)
        if name in SCANS:
            return self._scan(text, command, now_ns)
        return self._handlers()[name](text, command, now_ns)

    def _handlers(self) -> dict[str, Callable[[str, str, int], bytes]]:
        return {
            "VV": self._version,
            "PP": self._parameters,
            "II": self._information,
            "BM": self._light,
            "QT": self._quit,
            "RS": self._reset,
            "RT": self._reset,
            "RB": self._reboot,
            "TM": self._time,
            "SS": self._set_baud,
            "CR": self._set_speed,
            "HS": self._set_sensitivity,
            "DB": self._pretend,
            "%ST": self._state,
            "%SL": self._sleep,
        }

    def _refuse(self, echo: str, status: str) -> bytes:
        self.counters["commands_refused"] += 1
        return encode_reply(echo, status)

    def _info(self, echo: str, *pairs: tuple[str, str]) -> bytes:
        if not self.setup.sums_count_semicolons:
            return encode_info(echo, pairs)
        return encode_reply(echo, OK, [f"{key}:{value};".encode("ascii") for key, value in pairs])

    def _version(self, text: str, echo: str, now_ns: int) -> bytes:
        replies = self._replies
        return self._info(
            echo,
            ("VEND", replies.vendor),
            ("PROD", self.setup.product or replies.product),
            ("FIRM", replies.firmware),
            ("PROT", replies.protocol),
            ("SERI", self.setup.serial_number),
        )

    def _parameters(self, text: str, echo: str, now_ns: int) -> bytes:
        replies = self._replies
        ethernet = self.setup.wire == "ethernet"
        speed_rpm = replies.speed_rpm * (self.setup.motor_speed if ethernet else 1.0)
        pairs = [
            ("MODL", replies.model),
            ("DMIN", str(replies.distance_min_mm)),
            ("DMAX", str(replies.distance_max_mm)),
            *([("PROT", replies.protocol)] if ethernet else []),
            ("ARES", str(replies.steps_per_turn)),
            ("AMIN", str(replies.first_step)),
            ("AMAX", str(replies.last_step)),
            ("AFRT", str(replies.front_step)),
            ("SCAN", str(round(speed_rpm))),
        ]
        return self._info(echo, *pairs)

    def _information(self, text: str, echo: str, now_ns: int) -> bytes:
        usb, replies = self.setup.wire == "usb", self._replies
        modes = {"001": "001 Booting", "003": "003 Single_scan", "004": "004 Multi_scan"}
        return self._info(
            echo,
            ("MODL", replies.model),
            ("LASR", "ON" if self._laser_on else "OFF"),
            ("SCSP", replies.speed),
            ("MESM", "CLASSIC" if usb else modes.get(self._state_code(now_ns), "000 Idle")),
            ("SBPS", "USB Full Speed" if usb else "Ethernet 100 [Mbps]"),
            ("TIME", f"{self.clock_ms(now_ns):06X}"),
            ("STAT", replies.abnormal if self.abnormal else replies.normal),
        )

    def _light(self, text: str, echo: str, now_ns: int) -> bytes:
        if now_ns < self._steady_from_ns:
            return self._refuse(echo, UNSTABLE)
        if self.laser_broken:
            return self._refuse(echo, LASER_BROKEN)
        status = ALREADY if self._laser_on else OK
        self._laser_on, self._asleep = True, False
        return encode_reply(echo, status)

    def _quit(self, text: str, echo: str, now_ns: int) -> bytes:
        stump = b""
        if self._stream is not None and self.setup.cuts_scan_on_quit:
            telegram = self._scan_message(self._stream, self._stream_echo, self._next_turn, "99")
            stump = telegram[: telegram.index(b"\n", len(telegram) // 2) + 1]
        self._stop()
        self._asleep = False
        return stump + encode_reply(echo, OK)

    def _reset(self, text: str, echo: str, now_ns: int) -> bytes:
        self._stop()
        self._set_clock(now_ns, 0)
        self._speaks_high = self._asleep = False
        return encode_reply(echo, OK)

    def _reboot(self, text: str, echo: str, now_ns: int) -> bytes:
        requested_ns, self._reboot_requested_ns = self._reboot_requested_ns, now_ns
        if requested_ns is None or now_ns - requested_ns > REBOOT_WINDOW_NS:
            return encode_reply(echo, "01")
        self.counters["reboots"] += 1
        self._reboot_requested_ns = None
        self.abnormal = False
        self.power_on(now_ns)
        return encode_reply(echo, OK)

    def _time(self, text: str, echo: str, now_ns: int) -> bytes:
        match text[2]:
            case "0":
                if self._laser_on:
                    return self._refuse(echo, DENIED)
                status, self._adjusting = (ALREADY if self._adjusting else OK), True
                return encode_reply(echo, status)
            case "1":
                if not self._adjusting and self.setup.wire == "usb":
                    return self._refuse(echo, NOT_ADJUSTING)
                return encode_reply(echo, OK, [encode_number(self.clock_ms(now_ns), 4)])
            case "2":
                status, self._adjusting = (OK if self._adjusting else "03"), False
                return encode_reply(echo, status)
        return self._refuse(echo, "01")

    def _set_baud(self, text: str, echo: str, now_ns: int) -> bytes:
        if self.setup.wire == "ethernet":
            return self._refuse(echo, NOT_SUPPORTED)
        if not text[2:].isdigit():
            return self._refuse(echo, "01")
        baud, before = int(text[2:]), self._baud
        if baud not in (19_200, 38_400, 57_600, 115_200, 250_000, 500_000, 750_000):
            return self._refuse(echo, "02")
        self._baud = baud
        return encode_reply(echo, "03" if baud == before else OK)

    def _set_speed(self, text: str, echo: str, now_ns: int) -> bytes:
        return self._refuse(echo, INCOMPATIBLE if text[2:].isdigit() else "01")

    def _set_sensitivity(self, text: str, echo: str, now_ns: int) -> bytes:
        if self.setup.wire == "ethernet":
            return self._refuse(echo, NOT_DEFINED)
        if text[2] not in "01":
            return self._refuse(echo, "01")
        high, before = text[2] == "1", self._speaks_high
        self._speaks_high = high
        return encode_reply(echo, ALREADY if high == before else OK)

    def _pretend(self, text: str, echo: str, now_ns: int) -> bytes:
        """DB: simulate a failure, 10 to end it."""
        if text[2:] not in ("02", "03", "04", "05", "10"):
            return self._refuse(echo, "01")
        self.abnormal = text[2:] != "10"
        if self.abnormal:
            self._stop()
        return encode_reply(echo, OK)

    def _state_code(self, now_ns: int) -> str:
        if self.abnormal:
            return "900"
        if now_ns < self._steady_from_ns:
            return "001"
        if self._adjusting:
            return "002"
        if self._asleep:
            return "005"
        return "004" if self._stream is not None else "003" if self._laser_on else "000"

    def _state(self, text: str, echo: str, now_ns: int) -> bytes:
        return encode_reply(echo, OK, [self._state_code(now_ns).encode("ascii")])

    def _sleep(self, text: str, echo: str, now_ns: int) -> bytes:
        self._stop()
        self._asleep = True
        return encode_reply(echo, OK)

    def _scan(self, text: str, echo: str, now_ns: int) -> bytes:
        for status, digits in (("01", text[2:6]), ("02", text[6:10]), ("03", text[10:12])):
            if not digits.isdigit():
                return self._refuse(echo, status)
        refused = self.setup.refused
        if text[:2] in refused or ("cluster" in refused and int(text[10:12]) > 1):
            return self._refuse(echo, NOT_DEFINED if text[:2] in refused else "03")
        if "skip" in refused and text[12:13] not in ("", "0"):
            return self._refuse(echo, "06")
        first, last = int(text[2:6]), int(text[6:10])
        replies = self._replies
        if not replies.first_step <= first <= replies.last_step or last > replies.last_step:
            return self._refuse(echo, "04")
        if last <= first:
            return self._refuse(echo, "05")
        if text[0] in "MN":
            for status, digits in (("06", text[12]), ("07", text[13:15])):
                if not digits.isdigit():
                    return self._refuse(echo, status)
        try:
            request = read_request(text)
        except ProtocolError:
            return self._refuse(echo, NOT_DEFINED)
        if now_ns < self._steady_from_ns:
            return self._refuse(echo, UNSTABLE)
        return self._start(request, echo, now_ns)

    def _start(self, request: ScanRequest, echo: str, now_ns: int) -> bytes:
        if not request.streams:
            if not self._laser_on:
                return self._refuse(echo, DENIED)
            self._single.append((request, echo, self._turn_after(now_ns)))
            return b""
        if self.laser_broken:
            return self._refuse(echo, "50")
        if self._stream is not None and self._stream.command != request.command:
            return self._refuse(echo, DENIED)
        self._laser_on, self._asleep = True, False
        self._stream, self._stream_echo, self.stopped_with = request, echo, ""
        self._next_turn = self._turn_after(now_ns)
        return encode_reply(echo, OK)
