"""A fake Create 1, Create 2 or Roomba: Open Interface bytes in and out, wheels fed by a WheelSource.

Source: the manuals named in drivers.irobot_create.protocol. Drive commands
change packets 39 to 42 but move nothing: the vehicle's motion comes from the world.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Literal

from drivers.errors import ProtocolError
from drivers.irobot_create.config import PRESETS
from drivers.irobot_create.protocol import (
    FRAME_HEADER,
    FRAME_PERIOD_NS,
    Command,
    CommandDecoder,
    Mode,
    Opcode,
    PacketId,
    data_bytes,
    encode_frame,
    encode_values,
    members,
)
from simulators.device import CATCH_UP_NS, TURNS_SKIPPED, WheelSource, turns_to_skip

SLEEP_AFTER_NS = 300_000_000_000
BANNER_AFTER_NS = 500_000_000
SPEED_SPAN_NS = 50_000_000  # span of the wheels' own speed where no drive command was sent
CREATE2_DEGREES = 0.324056  # what firmware before 3.4.1 reports for one true degree in packet 20
REQUESTED_IDS = {39, 40, 41, 42}

FLASH_TEXT = b"    Flash CRC successful: 0x0 (0x0)\n\r"
BANNER = (
    b"bl-start\r\nSTR730\r\nbootloader id: #x47186549 82ECCFFF\r\nbootloader info rev: #xF000\r\n"
    b"bootloader rev: #x0001\r\n2007-05-14-1715-L   \r\nRoomba by iRobot!\r\nstr730\r\n"
    b"r3_robot/tags/release-3.3.0:4379 CLEAN\r\n\r\nbattery-current-zero 252\r\n"
)

# What a Roomba 690 off its dock reported, as far as it stands still.
IDLE_VALUES: dict[int, int] = {
    PacketId.VOLTAGE: 13_900,
    PacketId.CURRENT: -151,
    PacketId.TEMPERATURE: 18,
    PacketId.BATTERY_CHARGE: 1_733,
    PacketId.BATTERY_CAPACITY: 2_068,
    28: 2_624,
    29: 2_653,
    30: 2_624,
    31: 2_510,
    46: 20,
    47: 16,
    48: 32,
    49: 31,
    50: 21,
    51: 3,
}


class FakeCreate:
    """One robot on one serial line. It sends nothing until it receives Start (128).

    start_counts           encoder readings when the world began (left, right)
    mode_one_too_high      packet 35 as some robots have it: passive 2, safe 3, full 4
    text_every_ns          how often it sends text unasked, every second time inside a frame; None: never
    sleep_after_ns         of Passive mode without a command; None: never
    wakes_on_connect       the cable's wake line is wired, and opening the port pulses it
    clock_drift_ppm        positive: its frames come faster
    """

    def __init__(
        self,
        wheels: WheelSource,
        model: Literal["create1", "create2", "roomba"] = "create2",
        *,
        baud: int | None = None,
        start_counts: tuple[int, int] = (0, 0),
        mode_one_too_high: bool = False,
        text_every_ns: int | None = None,
        sleep_after_ns: int | None = SLEEP_AFTER_NS,
        wakes_on_connect: bool = False,
        clock_drift_ppm: float = 0.0,
    ) -> None:
        preset = PRESETS[model]
        self.counters: Counter[str] = Counter()
        self._wheels = wheels
        self._encoders = model != "create1"
        self._wheel_base_m = preset.wheel_base_m
        self._m_per_count = math.pi * preset.wheel_diameter_m / preset.counts_per_revolution
        self._byte_ns = 10e9 / (baud or preset.baud)
        self._start_counts = start_counts
        self._reset_travel_m = (0.0, 0.0)
        self._mode_offset = int(mode_one_too_high)
        self._text_every_ns = text_every_ns
        self._sleep_after_ns = sleep_after_ns
        self._wakes_on_connect = wakes_on_connect
        self._frame_period_ns = round(FRAME_PERIOD_NS / (1.0 + clock_drift_ppm * 1e-6))
        self._ear = CommandDecoder(demo_takes_data=not self._encoders)
        self.asleep = False
        self.mode = Mode.OFF
        self.commands: list[Command] = []  # the newest 1000, for tests to look at
        self.values = dict(IDLE_VALUES)  # what the sensors read; tests and faults write here
        self._read_travel_m: dict[int, tuple[float, float]] = {}  # at the last reading of packets 19 and 20
        self._commanded: dict[int, int] | None = None  # packets 39 to 42 after a drive command
        self._stream_ids: tuple[int, ...] = ()
        self._paused = False
        self._frame_at_ns: int | None = None  # moment of measurement of the next frame
        self._text_at_ns: int | None = None
        self._texts_sent = 0
        self._banner_at_ns: int | None = None
        self._last_activity_ns = 0

    def connected(self, now_ns: int) -> bytes:
        if self._wakes_on_connect:
            self.wake(now_ns)
        self._skip(now_ns, 0)  # frames without a client are lost
        return b""

    def disconnected(self, now_ns: int) -> None:
        """Nothing changes."""

    def wake(self, now_ns: int) -> None:
        """A low pulse on BRC, or the Clean button."""
        self.asleep = False
        self._last_activity_ns = now_ns

    def drop_wheel(self, dropped: bool = True) -> None:
        """Lift the robot, or set it down. In Safe mode it falls back to Passive without a message."""
        self.values[PacketId.BUMPS_WHEEL_DROPS] = 0b01100 if dropped else 0
        if dropped and self.mode is Mode.SAFE:
            self.mode = Mode.PASSIVE

    def restart(self, now_ns: int) -> None:
        """Pull the battery and put it back."""
        self._ear = CommandDecoder(demo_takes_data=not self._encoders)
        self._texts_sent = 0
        self.reset(now_ns)

    def spoil_checksum(self, message: bytes) -> bytes:
        """Of the first stream frame in it; answers and texts carry none."""
        start = message.find(FRAME_HEADER)
        end = start + 3 + message[start + 1] if 0 <= start < len(message) - 1 else len(message) + 1
        if end > len(message):
            return message
        return message[: end - 1] + bytes([message[end - 1] ^ 0xFF]) + message[end:]

    def reset(self, now_ns: int) -> None:
        """As after opcode 7: encoders at zero, mode Off, and the banner."""
        self._go_off()
        self._start_counts, self._reset_travel_m = (0, 0), self._wheels.wheel_travel_m(now_ns)
        self._read_travel_m = dict.fromkeys((PacketId.DISTANCE, PacketId.ANGLE), self._reset_travel_m)
        self._banner_at_ns = now_ns + BANNER_AFTER_NS
        self._text_at_ns = None
        self.asleep = False

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        self._fall_asleep(now_ns)
        if self.asleep or self._banner_at_ns is not None:
            return b""
        self._last_activity_ns = now_ns
        return b"".join(self._obey(command, now_ns) for command in self._ear.receive_data(data))

    def next_due_ns(self, now_ns: int) -> int | None:
        text_at_ns = None if self._text_waits_for_frame() else self._text_at_ns
        times = [self._frame_due_ns(), text_at_ns, self._banner_at_ns]
        return min((due_ns for due_ns in times if due_ns is not None), default=None)

    def due(self, now_ns: int) -> bytes:
        self._fall_asleep(now_ns)
        sent = bytearray()
        if self._banner_at_ns is not None and now_ns >= self._banner_at_ns:
            self._banner_at_ns = None
            sent += BANNER
        if skipped := self._skip(now_ns, CATCH_UP_NS):
            self.counters[TURNS_SKIPPED] += skipped
        while (due_ns := self._frame_due_ns()) is not None and now_ns >= due_ns:
            sent += self._next_frame(now_ns)
        if self._text_is_due(now_ns) and not self._text_waits_for_frame():
            sent += self._send_text(now_ns)
        return bytes(sent)

    def _text_is_due(self, now_ns: int) -> bool:
        return self._text_at_ns is not None and now_ns >= self._text_at_ns

    def _text_waits_for_frame(self) -> bool:
        return self._texts_sent % 2 == 1 and self._frame_at_ns is not None

    def _frame_due_ns(self) -> int | None:
        """When the next frame's last byte leaves: it has its duration on the wire."""
        if self._frame_at_ns is None:
            return None
        content = len(self._stream_ids) + data_bytes(self._stream_ids)
        return self._frame_at_ns + round((3 + content) * self._byte_ns)

    def _next_frame(self, now_ns: int) -> bytes:
        assert self._frame_at_ns is not None
        frame = encode_frame(self._stream_ids, self._measure(self._stream_ids, self._frame_at_ns))
        self._frame_at_ns += self._frame_period_ns
        if self._text_is_due(now_ns) and self._text_waits_for_frame():
            middle = len(frame) // 2
            return frame[:middle] + self._send_text(now_ns) + frame[middle:]
        return frame

    def _send_text(self, now_ns: int) -> bytes:
        assert self._text_every_ns is not None
        self._texts_sent += 1
        self._text_at_ns = now_ns + self._text_every_ns
        return FLASH_TEXT

    def _skip(self, now_ns: int, keep_ns: int) -> int:
        """Leave out the frames older than that; returns their number."""
        if self._frame_at_ns is None:
            return 0
        skipped = turns_to_skip(now_ns - self._frame_at_ns, self._frame_period_ns, keep_ns)
        self._frame_at_ns += skipped * self._frame_period_ns
        return skipped

    def _fall_asleep(self, now_ns: int) -> None:
        if self._sleep_after_ns is None or self.mode is not Mode.PASSIVE:
            return
        if now_ns - self._last_activity_ns >= self._sleep_after_ns:
            self._go_off()
            self.asleep = True

    def _go_off(self) -> None:
        self.mode = Mode.OFF
        self._stream_ids, self._frame_at_ns, self._paused = (), None, False
        self._commanded = None

    def _obey(self, command: Command, now_ns: int) -> bytes:
        self.commands = [*self.commands[-999:], command]
        if self.mode is Mode.OFF and command.opcode not in (Opcode.START, Opcode.RESET):
            return b""
        match command.opcode:
            case Opcode.RESET if self._encoders:
                self.reset(now_ns)
            case Opcode.START:
                if self.mode is Mode.OFF and self._text_every_ns is not None:
                    self._text_at_ns = now_ns + self._text_every_ns
                self.mode = Mode.PASSIVE
            case Opcode.CONTROL | Opcode.SAFE:
                self.mode = Mode.SAFE
            case Opcode.FULL:
                self.mode = Mode.FULL
            case Opcode.SPOT | Opcode.CLEAN | Opcode.MAX | Opcode.DOCK:
                self.mode = Mode.PASSIVE
            case Opcode.POWER:
                self._go_off()
                self.asleep = True
            case Opcode.STOP if self._encoders:
                self._go_off()
            case Opcode.SENSORS:
                return self._answer(command.data, now_ns)
            case Opcode.QUERY_LIST:
                return self._answer(command.data[1:], now_ns)
            case Opcode.STREAM:
                self._stream(command.data[1:], now_ns)
            case Opcode.PAUSE_RESUME_STREAM:
                self._pause(command.data[0] == 0, now_ns)
            case Opcode.DRIVE | Opcode.DRIVE_DIRECT if self.mode in (Mode.SAFE, Mode.FULL):
                self._drive(command)
            case _:
                pass  # songs, lamps, motors, scripts, schedules: accepted, without an answer
        return b""

    def _answer(self, packet_ids: Sequence[int], now_ns: int) -> bytes:
        known = [packet_id for packet_id in packet_ids if _exists(packet_id)]
        return encode_values(known, self._measure(known, now_ns))

    def _stream(self, packet_ids: Sequence[int], now_ns: int) -> None:
        known = tuple(packet_id for packet_id in packet_ids if _exists(packet_id))
        if len(known) + data_bytes(known) > 255:
            return
        self._stream_ids, self._paused = known, False
        self._frame_at_ns = now_ns + self._frame_period_ns if known else None

    def _pause(self, paused: bool, now_ns: int) -> None:
        if paused == self._paused or not self._stream_ids:
            return
        self._paused = paused
        self._frame_at_ns = None if paused else now_ns + self._frame_period_ns

    def _drive(self, command: Command) -> None:
        first = int.from_bytes(command.data[:2], "big", signed=True)
        second = int.from_bytes(command.data[2:], "big", signed=True)
        if command.opcode is Opcode.DRIVE:
            right, left = _wheel_speeds(first, second, 1000.0 * self._wheel_base_m)
            velocity, radius = first, second
        else:
            right, left = first, second
            velocity, radius = (first + second) // 2, 0
        self._commanded = {
            PacketId.REQUESTED_VELOCITY: _clamp(velocity, 500),
            PacketId.REQUESTED_RADIUS: radius,
            PacketId.REQUESTED_RIGHT_VELOCITY: _clamp(right, 500),
            PacketId.REQUESTED_LEFT_VELOCITY: _clamp(left, 500),
        }

    def _measure(self, packet_ids: Sequence[int], at_ns: int) -> dict[int, int]:
        """The values of these packets now; reading packets 19 and 20 clears them."""
        wanted = {member for packet_id in packet_ids for member in members(packet_id)}
        travel_m = self._wheels.wheel_travel_m(at_ns)
        values = dict(self.values)
        values[PacketId.OI_MODE] = self.mode + self._mode_offset
        values[PacketId.STREAM_PACKETS] = len(self._stream_ids)
        if wanted & REQUESTED_IDS:
            values |= self._commanded if self._commanded is not None else self._own_speeds(at_ns)
        if PacketId.DISTANCE in wanted:
            left_m, right_m = self._since_last_reading(PacketId.DISTANCE, travel_m)
            values[PacketId.DISTANCE] = _clamp(int(500.0 * (left_m + right_m)), 32_767)
        if PacketId.ANGLE in wanted:
            left_m, right_m = self._since_last_reading(PacketId.ANGLE, travel_m)
            degrees = math.degrees((right_m - left_m) / self._wheel_base_m)
            if self._encoders:
                degrees *= CREATE2_DEGREES
            values[PacketId.ANGLE] = _clamp(int(degrees), 32_767)
        if self._encoders:
            values[PacketId.LEFT_ENCODER], values[PacketId.RIGHT_ENCODER] = (
                (start + math.floor((travel - reset) / self._m_per_count)) % 65_536
                for start, travel, reset in zip(
                    self._start_counts, travel_m, self._reset_travel_m, strict=True
                )
            )
        return values

    def _since_last_reading(self, packet_id: PacketId, travel_m: tuple[float, float]) -> tuple[float, float]:
        left_m, right_m = self._read_travel_m.get(packet_id, (0.0, 0.0))
        self._read_travel_m[packet_id] = travel_m
        return travel_m[0] - left_m, travel_m[1] - right_m

    def _own_speeds(self, at_ns: int) -> dict[int, int]:
        """Packets 39 to 42 as if the vehicle were moved by drive commands."""
        before_ns = max(at_ns - SPEED_SPAN_NS, 0)
        if before_ns == at_ns:
            return {}
        before_m, now_m = self._wheels.wheel_travel_m(before_ns), self._wheels.wheel_travel_m(at_ns)
        left, right = (
            _clamp(round((now - before) * 1e12 / (at_ns - before_ns)), 500)
            for before, now in zip(before_m, now_m, strict=True)
        )
        return {
            PacketId.REQUESTED_VELOCITY: (left + right) // 2,
            PacketId.REQUESTED_RIGHT_VELOCITY: right,
            PacketId.REQUESTED_LEFT_VELOCITY: left,
        }


def _exists(packet_id: int) -> bool:
    try:
        members(packet_id)
    except ProtocolError:
        return False
    return True


def _clamp(value: int, limit: int) -> int:
    return min(max(value, -limit), limit)


def _wheel_speeds(velocity: int, radius: int, wheel_base_mm: float) -> tuple[int, int]:
    """(right, left) mm/s of opcode 137; radius 1 and -1 spin on the spot, 0x8000 and 0x7FFF go straight."""
    if radius in (-32_768, 32_767) or radius == 0:
        return velocity, velocity
    if radius in (1, -1):
        return radius * velocity, -radius * velocity
    half = 0.5 * wheel_base_mm / radius
    return round(velocity * (1.0 + half)), round(velocity * (1.0 - half))
