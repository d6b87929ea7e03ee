"""Faults on the wire: a fake device that adds faults to another one. No I/O.

of the link              cut, delay, burst
of the bytes it sends    garbage, bit_flips, half_messages, wrong_checksum, duplicate, drop
of the device            silence, restart, slow_start, clock_jump

A message is one return value of the device. Several faults may act at a time; on a message they act
in the order of the file. Bytes of the host are never changed, but are lost
while the device is off.
"""

import logging
import math
from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from simulators.device import FakeDevice, HasChecksum, HasClock, Restartable
from simulators.fault_file import (
    BitFlips,
    Burst,
    ClockJump,
    Cut,
    Delay,
    Fault,
    Garbage,
    MessageFault,
    PlainMessageFault,
    RepeatedFault,
    Restart,
    Silence,
    SlowStart,
)

log = logging.getLogger(__name__)

TIMES, CONTENT = 0, 1  # generators of a fault: its times do not depend on the bytes sent


class _Scheduled:
    """A fault of one device, when it acts, and the chance that belongs to it.

    begin_ns, end_ns    of its next or present time; it acts before end_ns. None: never again
    """

    def __init__(self, fault: RepeatedFault, zero_ns: int, seed: int, number: int) -> None:
        self.fault = fault
        self.chance = np.random.default_rng([seed, number, CONTENT])
        self.active = False
        self._times = np.random.default_rng([seed, number, TIMES])
        self._first_ns = zero_ns + round(fault.at_s * 1e9)
        self._done = 0
        self.begin_ns: int | None = self._first_ns

    @property
    def end_ns(self) -> int | None:
        return None if self.begin_ns is None else self.begin_ns + round(self.fault.lasts_s * 1e9)

    @property
    def next_change_ns(self) -> int | None:
        return self.end_ns if self.active else self.begin_ns

    def go_on(self) -> None:
        """To its next time."""
        fault = self.fault
        self.active = False
        self._done += 1
        if fault.every_s is None or self._done == fault.times:
            self.begin_ns = None
            return
        late_s = self._times.uniform(0.0, fault.jitter_up_to_s)
        self.begin_ns = self._first_ns + round((self._done * fault.every_s + late_s) * 1e9)


class Faulty:
    """A FakeDevice that stands for `device` and has these faults; also Unpluggable.

    zero_ns    host time that the faults' times count from
    counters   messages harmed, lost and delayed, and how often each kind came; names are for people

    The same seed and the same messages give the same faults.
    """

    def __init__(self, device: FakeDevice, faults: Sequence[Fault], seed: int, zero_ns: int) -> None:
        self.device = device
        self.counters: Counter[str] = Counter()
        self._scheduled = [
            _Scheduled(fault, zero_ns, seed, number)
            for number, fault in enumerate(faults)
            if isinstance(fault, RepeatedFault)
        ]
        self._change_ns = min(self._changes(), default=(None, 0))[0]  # None: no fault begins or ends any more
        self._slow_starts = [
            (zero_ns + round(fault.at_s * 1e9), round(fault.for_s * 1e9))
            for fault in faults
            if isinstance(fault, SlowStart)
        ]
        self._off_until_ns = 0
        self._queue: deque[tuple[int, bytes]] = deque()  # host time to send, message; in order
        self._note_start(zero_ns)

    def connected(self, now_ns: int) -> bytes:
        self._advance(now_ns)
        self._accept(self.device.connected(now_ns), now_ns)
        return self._take_due(now_ns)

    def disconnected(self, now_ns: int) -> None:
        self._advance(now_ns)
        self._queue.clear()
        self.device.disconnected(now_ns)

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        self._advance(now_ns)
        if self._is_off(now_ns):
            self.counters["requests_lost"] += 1
        else:
            self._accept(self.device.receive_data(data, now_ns), now_ns)
        return self._take_due(now_ns)

    def next_due_ns(self, now_ns: int) -> int | None:
        self._advance(now_ns)
        leaves_ns = self._queue[0][0] if self._queue else None
        times = (self.device.next_due_ns(now_ns), leaves_ns, self._change_ns)
        return min([due_ns for due_ns in times if due_ns is not None], default=None)

    def due(self, now_ns: int) -> bytes:
        self._advance(now_ns)
        due_ns = self.device.next_due_ns(now_ns)
        if due_ns is not None and due_ns <= now_ns:
            self._accept(self.device.due(now_ns), now_ns)
        return self._take_due(now_ns)

    def plugged(self, now_ns: int) -> bool:
        self._advance(now_ns)
        return not any(scheduled.active and _unplugs(scheduled.fault) for scheduled in self._scheduled)

    def next_plug_ns(self, now_ns: int) -> int | None:
        self._advance(now_ns)
        times = [scheduled.next_change_ns for scheduled in self._scheduled if _unplugs(scheduled.fault)]
        return min((at_ns for at_ns in times if at_ns is not None), default=None)

    def _changes(self) -> list[tuple[int, int]]:
        """Next time each fault begins or ends, and its number."""
        ahead = [(scheduled.next_change_ns, number) for number, scheduled in enumerate(self._scheduled)]
        return [(at_ns, number) for at_ns, number in ahead if at_ns is not None]

    def _advance(self, now_ns: int) -> None:
        """Begin and end each fault whose time has come, in the order of time."""
        while self._change_ns is not None and self._change_ns <= now_ns:
            at_ns, number = min(self._changes())
            scheduled = self._scheduled[number]
            if scheduled.active:
                self._end(scheduled, at_ns)
            else:
                self._begin(scheduled, at_ns)
            self._change_ns = min(self._changes(), default=(None, 0))[0]

    def _begin(self, scheduled: _Scheduled, at_ns: int) -> None:
        fault = scheduled.fault
        scheduled.active = True
        self.counters[fault.kind] += 1
        log.info("%s: %s%s", fault.device, fault.kind, f" for {fault.lasts_s:g} s" if fault.lasts_s else "")
        if isinstance(fault, ClockJump):
            assert isinstance(self.device, HasClock)
            self.device.jump_clock(fault.by_s)
        elif isinstance(fault, Restart):
            self._queue.clear()

    def _end(self, scheduled: _Scheduled, at_ns: int) -> None:
        scheduled.go_on()
        if isinstance(scheduled.fault, Restart):
            assert isinstance(self.device, Restartable)
            self.device.restart(at_ns)
            self._note_start(at_ns)

    def _note_start(self, at_ns: int) -> None:
        for since_ns, lasts_ns in self._slow_starts:
            if since_ns <= at_ns:
                self._off_until_ns = max(self._off_until_ns, at_ns + lasts_ns)

    def _is_off(self, now_ns: int) -> bool:
        """Whether it neither receives nor sends."""
        off = any(scheduled.active and isinstance(scheduled.fault, Restart) for scheduled in self._scheduled)
        return off or now_ns < self._off_until_ns

    def _accept(self, message: bytes, now_ns: int) -> None:
        """Put a message of the device into _queue, with the active faults applied."""
        if not message:
            return
        active = [scheduled for scheduled in self._scheduled if scheduled.active]
        if self._is_off(now_ns) or any(isinstance(scheduled.fault, Silence) for scheduled in active):
            self.counters["messages_unsaid"] += 1
            return
        messages = [message]
        for scheduled in active:
            messages = [harmed for intact in messages for harmed in self._harm(intact, scheduled)]
        leaves_ns = self._leaves_ns(now_ns, active)
        self._queue += [(leaves_ns, harmed) for harmed in messages if harmed]

    def _leaves_ns(self, now_ns: int, active: Sequence[_Scheduled]) -> int:
        leaves_ns = now_ns
        for scheduled in active:
            if isinstance(scheduled.fault, Delay):
                leaves_ns += round(scheduled.chance.uniform(0.0, scheduled.fault.up_to_ms) * 1e6)
        for scheduled in active:
            if isinstance(scheduled.fault, Burst):
                begin_ns, end_ns = scheduled.begin_ns, scheduled.end_ns
                assert begin_ns is not None
                assert end_ns is not None
                hold_ns = round(scheduled.fault.hold_ms * 1e6)
                gate_ns = begin_ns + math.ceil((leaves_ns - begin_ns) / hold_ns) * hold_ns
                leaves_ns = max(leaves_ns, min(gate_ns, end_ns))
        if leaves_ns > now_ns:
            self.counters["messages_delayed"] += 1
        return leaves_ns

    def _take_due(self, now_ns: int) -> bytes:
        leaving = bytearray()
        while self._queue and self._queue[0][0] <= now_ns:
            leaving += self._queue.popleft()[1]
        return bytes(leaving)

    def _harm(self, message: bytes, scheduled: _Scheduled) -> list[bytes]:
        fault, chance = scheduled.fault, scheduled.chance
        if isinstance(fault, BitFlips):
            harmed = [_flip_bits(message, fault.rate, chance)]
        elif not isinstance(fault, MessageFault) or chance.random() >= fault.share:
            return [message]
        else:
            match fault:
                case Garbage():
                    length = int(chance.integers(1, fault.up_to_bytes, endpoint=True))
                    harmed = [chance.bytes(length), message]
                case PlainMessageFault(kind="half_messages"):
                    harmed = [message[: int(chance.integers(0, len(message)))]]
                case PlainMessageFault(kind="wrong_checksum"):
                    harmed = [self._spoil_checksum(message)]
                case PlainMessageFault(kind="duplicate"):
                    harmed = [message, message]
                case PlainMessageFault(kind="drop"):
                    harmed = []
                case _:
                    raise AssertionError(f"{fault.kind} is no fault of a message")
        if harmed != [message]:
            self.counters[f"messages_hit_by_{fault.kind}"] += 1
        return harmed

    def _spoil_checksum(self, message: bytes) -> bytes:
        if isinstance(self.device, HasChecksum):
            return self.device.spoil_checksum(message)
        return message[:-1] + bytes([message[-1] ^ 0xFF])


def _unplugs(fault: RepeatedFault) -> bool:
    return isinstance(fault, Cut) or (isinstance(fault, Restart) and fault.link_drops)


def _flip_bits(message: bytes, rate: float, chance: np.random.Generator) -> bytes:
    bits = np.unpackbits(np.frombuffer(message, np.uint8))
    flipped = chance.integers(0, len(bits), int(chance.binomial(len(bits), rate)))
    np.bitwise_xor.at(bits, flipped, 1)
    return np.packbits(bits).tobytes()
