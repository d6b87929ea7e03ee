"""A fake IBEO LUX. No I/O.

It measures from power-up, with a client or without, answers every command but Reset, and reproduces the
behaviour of real ones: label bits set at random where the labelling did not run, two of the four layers
missing at the rims of the field, silence for odd angles, refusal of what its firmware does not know, a clock
that counts from power-up until it is set and drifts. The points a scan agree with a real one: 742 from 50 to
-50 deg, where an LD-MRS announced 740 (SICKAG/sick_scan_xd, tools/test_server/config/test_server_ldmrs.yaml).

Assumed, without a source: which two layers remain at the right rim (the upper ones), and the sectors of the
focused resolution (0.125 deg within 10 deg of straight ahead, 0.25 within 30, 0.5 beyond).
"""

import math
import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drivers.errors import ProtocolError
from drivers.ibeo_lux.messages import (
    TICKS_PER_TURN,
    Command,
    DeviceStatus,
    ErrorRegisters,
    Parameter,
    Scan,
    ScanFlag,
    ScannerStatus,
    read_command,
    signed_16,
    write_parameter,
    write_reply,
    write_scan,
)
from drivers.ibeo_lux.protocol import NTP_MODULUS, DataType, Decoder, Message, encode
from simulators.device import TURNS_SKIPPED, Beams, LayeredSweepSource, turns_to_skip
from simulators.lux_optics import FOCUSED_SECTORS, LuxOptics, is_shot

DEVICE_ID = 7
LEAVES_AFTER_SWEEP_NS = 2_000_000
FAULT_PERIOD_NS = 1_000_000_000
COMPENSATIONS = 0x0300  # set in every status of a real unit
LAYERS_OF_A_SHOT = 2
SHOT_TICKS = 8  # between two shots; they go to the lower and the upper pair by turns
FREQUENCIES = (3200, 6400, 12_800)
FLEXRES, FLEXRES_AT_WRONG_FREQUENCY, FLEXRES_NOT_IDLE = 2, 0x6E, 0x70
READ_ONLY = (0x1105, Parameter.BEAM_TILT, Parameter.OPERATING_MINUTES, Parameter.FLEXRES_ERROR)
DEFAULTS = {
    **dict.fromkeys(range(0x1000, 0x1004), 0),
    **dict.fromkeys(range(0x1010, 0x1019), 0),
    Parameter.START_ANGLE: 1600,
    Parameter.END_ANGLE: -1920 & 0xFFFF,
    Parameter.SCAN_FREQUENCY: 3200,
    Parameter.SYNC_ANGLE: 0,
    Parameter.RESOLUTION: 1,
    0x1105: TICKS_PER_TURN,
    **dict.fromkeys(range(0x1108, 0x110C), 0),
    **dict.fromkeys(range(0x1200, 0x1211), 0),
    Parameter.BEAM_TILT: 0,
    Parameter.OPERATING_MINUTES: 61_234,
    0x3600: 0,
    **dict.fromkeys(range(0x4000, 0x4011), 0),
    Parameter.FLEXRES_ERROR: 0,
}


@dataclass(frozen=True, slots=True)
class LuxSetup:
    """Firmware, stored parameters and faults of this unit."""

    measuring: bool = True  # by itself after power-up
    boot_ns: int = 0  # the port is open but the device does not answer
    start_delay_ns: int = 300_000_000  # from standstill to measuring; a real one takes seconds
    parameters: dict[int, int] = field(default_factory=dict)  # stored in its flash, over DEFAULTS
    unsupported: frozenset[int] = frozenset()  # parameters this firmware does not know
    refused: frozenset[int] = frozenset()  # commands
    fixed: frozenset[int] = frozenset()  # parameters that it reads but refuses to set
    kept: frozenset[int] = frozenset()  # parameters whose change it accepts and does not make
    sets_ntp_at_once: bool = True  # command 0x0034, newer firmware
    clock_drift_ppm: float = 0.0  # positive: the device's clock runs fast
    motor_speed: float = 1.0  # of nominal
    labels: int = ScanFlag.DIRT_LABELLED
    height_m: float | None = None  # above ground; None: no ground
    rain_share: float = 0.0  # of the shots that meet a drop before the wall
    firmware_code: int = 0x3035
    serial_code: tuple[int, int, int] = (0x1502, 147, 1)


class FakeIbeoLux:
    """One device with room for one client. Set `motor_failed` and `silent` while it runs."""

    def __init__(self, source: LayeredSweepSource, setup: LuxSetup | None = None, seed: int = 0) -> None:
        self.setup = setup or LuxSetup()
        self.motor_failed = False  # scans end, and an error is reported once a second
        self.silent = False  # it sends no more messages
        self.counters: Counter[str] = Counter()
        self._source = source
        s = self.setup
        self._optics = LuxOptics(s.labels, s.height_m, s.rain_share, np.random.default_rng(seed))
        self._stored = DEFAULTS | self.setup.parameters
        self._parameters = dict(self._stored)
        self._decoder = Decoder()
        self._powered_on_ns: int | None = None
        self._boots_until_ns = 0
        self._clock_set_ns = 0  # the clock was at _clock_set_ntp then
        self._clock_set_ntp = 0
        self.turning_since_ns: int | None = None  # begin of sweep 0; None: standstill
        self._next_scan = 0
        self.number_base = 0
        self._pending: deque[bytes] = deque()
        self._next_fault_ns = 0
        self._is_connected = False

    def connected(self, now_ns: int) -> bytes:
        self._decoder = Decoder()
        self._pending.clear()
        self._is_connected = True
        if self._powered_on_ns is None:
            self.power_on(now_ns)
        elif self.turning_since_ns is not None:
            self._next_scan = max(self._next_scan, self._scans_complete(now_ns))
        return b""

    def disconnected(self, now_ns: int) -> None:
        self._is_connected = False
        self._pending.clear()

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        answers = b""
        try:
            messages = self._decoder.receive_data(data)
        except ProtocolError:
            self.counters["garbage"] += 1
            return b""
        for message in messages:
            if self.silent or now_ns < self._boots_until_ns:
                self.counters["requests_while_deaf"] += 1
            elif message.data_type != DataType.COMMAND:
                self.counters["messages_ignored"] += 1
            else:
                answers += self._answer(message.payload, now_ns)
        return answers

    def next_due_ns(self, now_ns: int) -> int | None:
        if not self._is_connected or self.silent:
            return None
        if self._pending:
            return now_ns
        if self.motor_failed:
            return max(now_ns, self._next_fault_ns)
        return None if self.turning_since_ns is None else self._leaves_ns(self._next_scan)

    def due(self, now_ns: int) -> bytes:
        due_ns = self.next_due_ns(now_ns)
        if due_ns is None or due_ns > now_ns:
            return b""
        if self._pending:
            return self._pending.popleft()
        if self.motor_failed:
            self._next_fault_ns = now_ns + FAULT_PERIOD_NS
            self.report(ErrorRegisters(errors_1=0x0002), now_ns)
            return self._pending.popleft() if self._pending else b""
        return self._next_message(now_ns)

    def power_on(self, now_ns: int) -> None:
        """Also off and on again: the clock starts over, settings that are not in the flash are lost."""
        self._powered_on_ns = self._clock_set_ns = now_ns
        self._clock_set_ntp = 0
        self._boots_until_ns = now_ns + self.setup.boot_ns
        self._parameters = dict(self._stored)
        self.number_base = self._next_scan = 0
        self.turning_since_ns = None
        self._pending.clear()
        if self.setup.measuring:
            self.turning_since_ns = self._boots_until_ns

    def restart(self, now_ns: int) -> None:
        self._decoder = Decoder()
        self.power_on(now_ns)

    def jump_clock(self, seconds: float) -> None:
        self._clock_set_ntp += round(seconds * (1 << 32))

    def spoil_checksum(self, message: bytes) -> bytes:
        """It has none."""
        return message

    def report(self, registers: ErrorRegisters, now_ns: int) -> None:
        """Send errors and warnings, if this is not switched off."""
        if not self._parameters[Parameter.DATA_OUTPUT] & 0x0010:
            self._pending.append(self._message(DataType.ERRORS, registers.write(), now_ns))

    def parameter(self, index: int) -> int:
        """Its present value."""
        return self._parameters[index]

    def ntp(self, now_ns: int) -> int:
        """Time of its clock."""
        since_ns = (now_ns - self._clock_set_ns) * (1.0 + self.setup.clock_drift_ppm * 1e-6)
        return (self._clock_set_ntp + (round(since_ns) << 32) // 1_000_000_000) % NTP_MODULUS

    def scanner_status(self, now_ns: int) -> int:
        if self.motor_failed or self.turning_since_ns is None:
            return COMPENSATIONS
        motor = COMPENSATIONS | ScannerStatus.MOTOR_ON
        if now_ns < self.turning_since_ns:
            return motor
        return motor | ScannerStatus.LASER_ON | ScannerStatus.FREQUENCY_REACHED

    def _message(self, data_type: int, payload: bytes, now_ns: int) -> bytes:
        return encode(Message(data_type, payload, DEVICE_ID, self.ntp(now_ns)))

    def _period_ns(self) -> float:
        return 256e9 / self._parameters[Parameter.SCAN_FREQUENCY] / self.setup.motor_speed

    def _angles_ticks(self) -> tuple[int, int]:
        return (
            signed_16(self._parameters[Parameter.START_ANGLE]),
            signed_16(self._parameters[Parameter.END_ANGLE]),
        )

    def _begins_ns(self, index: int) -> int:
        assert self.turning_since_ns is not None
        return self.turning_since_ns + round(index * self._period_ns())

    def _sweep_ns(self) -> int:
        start, end = self._angles_ticks()
        return round(self._period_ns() * (start - end) / TICKS_PER_TURN)

    def _leaves_ns(self, index: int) -> int:
        return self._begins_ns(index) + self._sweep_ns() + LEAVES_AFTER_SWEEP_NS

    def _scans_complete(self, now_ns: int) -> int:
        """How many have been measured since the mirror turns."""
        if now_ns < self._leaves_ns(0):
            return 0
        return int((now_ns - self._leaves_ns(0)) / self._period_ns()) + 1

    def _turn_from(self, since_ns: int) -> None:
        self.number_base += self._next_scan
        self.turning_since_ns, self._next_scan = since_ns, 0

    def _next_message(self, now_ns: int) -> bytes:
        skipped = turns_to_skip(now_ns - self._leaves_ns(self._next_scan), self._period_ns())
        if skipped:
            self.counters[TURNS_SKIPPED] += skipped
            self._next_scan += skipped
        index = self._next_scan
        self._next_scan += 1
        start, end = self._angles_ticks()
        output = self._parameters[Parameter.DATA_OUTPUT]
        if not output & 0x0004:
            self._pending.append(self._message(DataType.OBJECTS, self._objects(index), now_ns))
        if output & 0x0001 or start % 2 or end % 2:
            return self._pending.popleft() if self._pending else b""
        self.counters["scans_sent"] += 1
        return self._message(DataType.SCAN, write_scan(self._measure(index)), now_ns)

    def _measure(self, index: int) -> Scan:
        """Cast the rays of one sweep and write them as points."""
        begins_ns = self._begins_ns(index)
        ends_ns = begins_ns + self._sweep_ns()
        start, end = self._angles_ticks()
        focused = self._parameters[Parameter.RESOLUTION] == 0
        ray_ticks = FOCUSED_SECTORS[0][1] if focused else SHOT_TICKS
        ray_count = (start - end) // ray_ticks + 1
        radians_per_tick = 2.0 * math.pi / TICKS_PER_TURN
        interval_ns = round(self._period_ns() * ray_ticks / TICKS_PER_TURN)
        rays = Beams(
            begins_ns, interval_ns, start * radians_per_tick, -ray_ticks * radians_per_tick, ray_count
        )
        sweeps = self._source.sweep_layers(LAYERS_OF_A_SHOT, rays)
        angle_ticks = start - ray_ticks * np.arange(ray_count)
        shot = np.flatnonzero(is_shot(angle_ticks, start)) if focused else np.arange(ray_count)
        rear = bool(self._number(index) % 2)
        return Scan(
            number=self._number(index),
            status=self.scanner_status(ends_ns),
            start_ntp=self.ntp(begins_ns),
            end_ntp=self.ntp(ends_ns),
            start_ticks=start,
            end_ticks=end,
            points=self._optics.points(
                angle_ticks[shot],
                np.stack([sweep.range_m[shot] for sweep in sweeps], axis=1),
                np.stack([sweep.intensity[shot] for sweep in sweeps], axis=1),
            ),
            flags=self.setup.labels | (ScanFlag.REAR_MIRROR_SIDE if rear else 0),
        )

    def _number(self, index: int) -> int:
        return (self.number_base + index) % 65_536

    def _objects(self, index: int) -> bytes:
        """An object list with one object that has no contour."""
        return struct.pack("<QH", self.ntp(self._begins_ns(index)), 1) + bytes(58)

    def _answer(self, payload: bytes, now_ns: int) -> bytes:
        self.counters["requests"] += 1
        try:
            command, body = read_command(payload)
        except ProtocolError:
            self.counters["requests_unusable"] += 1
            return b""
        if command == Command.RESET:
            self.power_on(now_ns)  # the real one disconnects; here it ignores requests until it has booted
            return b""
        handlers: dict[int, Callable[[bytes, int], bytes]] = {
            Command.GET_STATUS: self._get_status,
            Command.SAVE_CONFIG: self._save,
            Command.SET_PARAMETER: self._set_parameter,
            Command.GET_PARAMETER: self._get_parameter,
            Command.RESET_PARAMETERS: self._reset_parameters,
            Command.START: self._start,
            Command.STOP: self._stop,
            Command.SET_NTP_SECONDS: self._set_seconds,
            Command.SET_NTP_FRACTION: self._set_fraction,
            Command.SET_NTP: self._set_ntp,
        }
        handler = handlers.get(command)
        try:
            if handler is None or command in self.setup.refused:
                raise _RefusedError
            reply = write_reply(command, handler(body, now_ns))
        except (_RefusedError, struct.error):
            self.counters["requests_refused"] += 1
            reply = write_reply(command, refused=True)
        return self._message(DataType.REPLY, reply, now_ns)

    def _get_status(self, body: bytes, now_ns: int) -> bytes:
        return DeviceStatus(
            firmware_code=self.setup.firmware_code,
            fpga_code=0x3021,
            status=self.scanner_status(now_ns),
            reserved=bytes(4),
            temperature_raw=round(579.2364 - 3.63 * 31.0),
            serial_code=self.setup.serial_code,
            fpga_time_code=(0x2014, 0x0611, 0x0928),
            firmware_time_code=(0x2015, 0x0114, 0x1332),
        ).write()

    def _save(self, body: bytes, now_ns: int) -> bytes:
        self._stored = dict(self._parameters)
        self.counters["saves"] += 1
        return b""

    def _reset_parameters(self, body: bytes, now_ns: int) -> bytes:
        self._parameters = dict(DEFAULTS)
        return b""

    def _get_parameter(self, body: bytes, now_ns: int) -> bytes:
        (index,) = struct.unpack_from("<H", body)
        return write_parameter(index, self._parameters[self._known(index)])

    def _set_parameter(self, body: bytes, now_ns: int) -> bytes:
        index, value = struct.unpack_from("<HI", body)
        if index in self.setup.fixed:
            raise _RefusedError
        self._check(self._known(index), value)
        if index in self.setup.kept:
            return b""
        if index == Parameter.SCAN_FREQUENCY and self.turning_since_ns is not None:
            self._turn_from(max(now_ns, self.turning_since_ns))
        self._parameters[index] = value
        self.counters["parameters_set"] += 1
        return b""

    def _known(self, index: int) -> int:
        if index not in self._parameters or index in self.setup.unsupported:
            raise _RefusedError
        return index

    def _check(self, index: int, value: int) -> None:
        """Raises _RefusedError for what the device cannot have."""
        start, end = self._angles_ticks()
        ticks = signed_16(value)
        legal = index not in READ_ONLY
        if index == Parameter.START_ANGLE:
            legal = max(-1919, end + 1) <= ticks <= 1600
        elif index == Parameter.END_ANGLE:
            legal = -1920 <= ticks <= min(1599, start - 1)
        elif index == Parameter.SCAN_FREQUENCY:
            legal = value in FREQUENCIES
        elif index == Parameter.RESOLUTION:
            fault = 0
            if self.turning_since_ns is not None:
                fault = FLEXRES_NOT_IDLE
            elif value == FLEXRES and self._parameters[Parameter.SCAN_FREQUENCY] != FREQUENCIES[0]:
                fault = FLEXRES_AT_WRONG_FREQUENCY
            self._parameters[Parameter.FLEXRES_ERROR] = fault
            legal = fault == 0 and value in (0, 1, FLEXRES)
        if not legal:
            raise _RefusedError

    def _start(self, body: bytes, now_ns: int) -> bytes:
        self.counters["starts"] += 1
        if self.turning_since_ns is None:
            self._turn_from(now_ns + self.setup.start_delay_ns)
        return b""

    def _stop(self, body: bytes, now_ns: int) -> bytes:
        self.counters["stops"] += 1
        self.number_base += self._next_scan
        self.turning_since_ns, self._next_scan = None, 0
        return b""

    def _set_seconds(self, body: bytes, now_ns: int) -> bytes:
        _, seconds = struct.unpack_from("<HI", body)
        self._set_clock(seconds << 32 | self.ntp(now_ns) & 0xFFFF_FFFF, now_ns)
        return b""

    def _set_fraction(self, body: bytes, now_ns: int) -> bytes:
        _, fraction = struct.unpack_from("<HI", body)
        self._set_clock(self.ntp(now_ns) >> 32 << 32 | fraction, now_ns)
        return b""

    def _set_ntp(self, body: bytes, now_ns: int) -> bytes:
        if not self.setup.sets_ntp_at_once:
            raise _RefusedError
        _, seconds, fraction = struct.unpack_from("<HII", body)
        self._set_clock(seconds << 32 | fraction, now_ns)
        return b""

    def _set_clock(self, ntp: int, now_ns: int) -> None:
        self.counters["clock_sets"] += 1
        self._clock_set_ns, self._clock_set_ntp = now_ns, ntp


class _RefusedError(Exception):
    """The device does not do this."""
