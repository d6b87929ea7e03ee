"""Each fault on a device that sends a counter, in virtual time."""

import itertools
from collections.abc import Iterator

import pytest

from simulators.device import FakeDevice
from simulators.fault_file import parse_faults
from simulators.faults import Faulty

ZERO_NS = 1_000_000_000_000
MS, S = 1_000_000, 1_000_000_000
PERIOD_NS = 10 * MS


class Counting:
    """FakeDevice that sends `<ms since its start>` each 10 ms to a client, and answers."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.restarts_ns: list[int] = []
        self._start_ns, self._ahead_ms, self._next_ns = ZERO_NS, 0, None

    def connected(self, now_ns: int) -> bytes:
        self._next_ns = now_ns + PERIOD_NS
        return b"<hello>"

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        self.received.append(data)
        return b"<" + data + b">"

    def next_due_ns(self, now_ns: int) -> int | None:
        return self._next_ns

    def due(self, now_ns: int) -> bytes:
        assert self._next_ns <= now_ns
        message = b"<%06d>" % ((self._next_ns - self._start_ns) // MS + self._ahead_ms)
        self._next_ns += PERIOD_NS
        return message

    def disconnected(self, now_ns: int) -> None:
        self._next_ns = None

    def restart(self, now_ns: int) -> None:
        self.restarts_ns.append(now_ns)
        self._start_ns, self._ahead_ms = now_ns, 0

    def jump_clock(self, seconds: float) -> None:
        self._ahead_ms += round(seconds * 1000)


class CountingWithSum(Counting):
    """Its checksum is the >."""

    def spoil_checksum(self, message: bytes) -> bytes:
        return message.replace(b">", b"!")


def faulty(*lines: str, seed: int = 1, device: FakeDevice | None = None) -> Faulty:
    device = device or Counting()
    text = "faults:\n" + "".join(f"  - {{device: x, {line}}}\n" for line in lines)
    return Faulty(device, parse_faults(text, "faults.yaml", {"x": device}), seed, ZERO_NS)


def run(device: Faulty, seconds: float, from_s: float = 0.0) -> Iterator[tuple[float, bytes]]:
    """Its messages, with the seconds since zero."""
    now_ns, end_ns = ZERO_NS + round(from_s * S), ZERO_NS + round((from_s + seconds) * S)
    while (due_ns := device.next_due_ns(now_ns)) is not None and due_ns < end_ns:
        assert due_ns > now_ns or now_ns == ZERO_NS + round(from_s * S)
        now_ns = due_ns
        message = device.due(now_ns)
        if message:
            yield (now_ns - ZERO_NS) / S, message


def messages_of(*lines: str, seconds: float = 0.2, seed: int = 1, device: FakeDevice | None = None):
    device = faulty(*lines, seed=seed, device=device)
    device.connected(ZERO_NS)
    return list(run(device, seconds))


def numbers(*milliseconds: int) -> list[bytes]:
    return [b"<%06d>" % ms for ms in milliseconds]


def test_silence_loses_what_is_sent_and_not_what_is_received():
    device = faulty("kind: silence, at_s: 0.015, for_s: 0.03")
    device.connected(ZERO_NS)
    assert [text for _, text in run(device, 0.02)] == numbers(10)
    assert device.receive_data(b"x", ZERO_NS + 20 * MS) == b""
    assert [text for _, text in run(device, 0.05, from_s=0.02)] == numbers(50, 60)
    assert device.device.received == [b"x"]
    assert device.counters == {"silence": 1, "messages_unsaid": 4}


def test_a_repeated_fault_comes_as_often_as_it_should_and_at_moments_of_the_seed():
    def begins(seed: int, count: str = "count: 5") -> list[float]:
        lost = messages_of(
            f"kind: drop, at_s: 0.095, for_s: 0.01, every_s: 0.3, {count}", seconds=3.0, seed=seed
        )
        spoken = {text for _, text in lost}
        return [ms / 1000 for ms in range(10, 3000, 10) if b"<%06d>" % ms not in spoken]

    once = begins(1)
    assert begins(1) == once
    assert begins(2) != once
    assert len(once) == 5
    assert once[0] == 0.1
    for number, begin_s in enumerate(once):
        assert 0.0 <= begin_s - 0.095 - 0.3 * number <= 0.075 + 0.01
    assert len(begins(1, "jitter_s: 0")) == 10


def test_the_seed_and_the_messages_decide_what_is_harmed():
    lines = ("kind: garbage, for_s: 1, share: 0.3", "kind: bit_flips, for_s: 1, rate: 0.01")
    assert messages_of(*lines) == messages_of(*lines)
    assert messages_of(*lines) != messages_of(*lines, seed=2)


def test_garbage_stands_between_messages():
    received = messages_of("kind: garbage, for_s: 1, share: 0.5, up_to_bytes: 7", seconds=1.0)
    texts = [text for _, text in received]
    assert all(text.endswith(b"<%06d>" % ms) for text, ms in zip(texts, range(10, 1000, 10), strict=True))
    lengths = [len(text) - 8 for text in texts]
    assert set(lengths) == set(range(8))
    assert 30 < sum(length > 0 for length in lengths) < 70


def test_bits_flip_at_the_given_rate():
    received = b"".join(
        text for _, text in messages_of("kind: bit_flips, for_s: 10, rate: 0.02", seconds=10.0)
    )
    whole = b"".join(numbers(*range(10, 10_000, 10)))
    assert len(received) == len(whole)
    flips = sum((a ^ b).bit_count() for a, b in zip(received, whole, strict=True))
    assert 0.017 < flips / (8 * len(whole)) < 0.023


def test_half_a_message_is_its_beginning():
    received = [text for _, text in messages_of("kind: half_messages, for_s: 1", seconds=1.0)]
    assert 70 < len(received) < 99  # of an empty half nothing is sent
    assert {len(text) for text in received} == set(range(1, 8))
    assert all(b"<000".startswith(text[:4]) and b">" not in text for text in received)


def test_a_checksum_is_spoilt_by_the_device_or_in_the_last_byte():
    assert [text for _, text in messages_of("kind: wrong_checksum, for_s: 1", seconds=0.025)] == [
        b"<000010" + bytes([ord(">") ^ 0xFF]),
        b"<000020" + bytes([ord(">") ^ 0xFF]),
    ]
    own = messages_of("kind: wrong_checksum, for_s: 1", seconds=0.015, device=CountingWithSum())
    assert own == [(0.01, b"<000010!")]


def test_messages_are_doubled_and_lost():
    assert [text for _, text in messages_of("kind: duplicate, for_s: 1", seconds=0.025)] == [
        b"<000010><000010>",
        b"<000020><000020>",
    ]
    assert messages_of("kind: drop, for_s: 1") == []
    assert 40 < len(messages_of("kind: drop, for_s: 1, share: 0.5", seconds=1.0)) < 60


def test_faults_on_one_message_act_in_the_order_of_the_file():
    first = messages_of("kind: drop, for_s: 1, share: 0.5", "kind: duplicate, for_s: 1", seconds=1.0)
    assert all(text[:8] == text[8:] for _, text in first)
    second = messages_of("kind: duplicate, for_s: 1", "kind: drop, for_s: 1, share: 0.5", seconds=1.0)
    assert {len(text) for _, text in second} == {8, 16}


def test_delayed_messages_come_late_and_in_order():
    received = messages_of("kind: delay, at_s: 0.2, for_s: 0.5, up_to_ms: 35", seconds=1.0)
    assert b"".join(text for _, text in received) == b"".join(numbers(*range(10, 1000, 10)))
    late_ms = [round(1000 * at_s) - int(text[-7:-1]) for at_s, text in received]
    assert max(late_ms[:19]) == 0
    assert 20 < max(late_ms) <= 35
    assert max(late_ms[-20:]) == 0


def test_a_burst_delays_messages_and_sends_them_together():
    received = messages_of("kind: burst, at_s: 0.1, for_s: 0.25, hold_ms: 100", seconds=0.4)
    at_s = {text: at_s for at_s, text in received}
    assert at_s[b"".join(numbers(*range(110, 201, 10)))] == 0.2
    assert at_s[b"".join(numbers(*range(210, 301, 10)))] == 0.3
    assert at_s[b"".join(numbers(310, 320, 330, 340, 350))] == 0.35  # it ends here


def test_a_clock_jumps_once():
    assert [text for _, text in messages_of("kind: clock_jump, at_s: 0.015, by_s: 2.5", seconds=0.035)] == [
        b"<000010>",
        b"<002520>",
        b"<002530>",
    ]


def test_a_cut_unplugs_for_its_time_and_reports_its_end():
    device = faulty("kind: cut, at_s: 1, for_s: 0.5", "kind: cut, at_s: 3")
    assert device.next_plug_ns(ZERO_NS) == ZERO_NS + S
    assert [device.plugged(ZERO_NS + round(at_s * S)) for at_s in (0.9, 1.0, 1.4)] == [True, False, False]
    assert device.next_plug_ns(ZERO_NS + round(1.4 * S)) == ZERO_NS + round(1.5 * S)
    assert device.plugged(ZERO_NS + round(1.5 * S))
    assert device.next_plug_ns(ZERO_NS + 6 * S) is None


def test_a_restart_takes_the_link_along_and_begins_again_at_its_own_moment():
    device = faulty("kind: restart, at_s: 1, for_s: 0.5")
    device.connected(ZERO_NS)
    assert not device.plugged(ZERO_NS + S)
    device.disconnected(ZERO_NS + S)
    assert device.next_due_ns(ZERO_NS + S) == ZERO_NS + round(1.5 * S)
    assert device.plugged(ZERO_NS + 2 * S)  # polled late
    assert device.device.restarts_ns == [ZERO_NS + round(1.5 * S)]
    device.connected(ZERO_NS + 2 * S)
    assert next(run(device, 1.0, from_s=2.0)) == (2.01, b"<000510>")


def test_a_device_that_restarts_behind_a_link_that_stays_neither_receives_nor_sends():
    device = faulty("kind: restart, at_s: 0.015, for_s: 0.03, link_drops: false")
    device.connected(ZERO_NS)
    assert [text for _, text in run(device, 0.02)] == numbers(10)
    assert device.plugged(ZERO_NS + 20 * MS)
    assert device.receive_data(b"x", ZERO_NS + 20 * MS) == b""
    assert [text for _, text in run(device, 0.05, from_s=0.02)] == numbers(5, 15)
    assert device.device.received == []


def test_a_slow_start_neither_receives_nor_sends_after_each_start():
    device = faulty("kind: slow_start, for_s: 0.3", "kind: restart, at_s: 1, for_s: 0.1, link_drops: false")
    assert device.connected(ZERO_NS) == b""
    assert device.receive_data(b"x", ZERO_NS) == b""
    at_s = [at_s for at_s, _ in run(device, 2.0)]
    silent = [(before, after) for before, after in itertools.pairwise([0.0, *at_s]) if after - before > 0.015]
    assert silent == [(0.0, pytest.approx(0.3)), (pytest.approx(0.99), pytest.approx(1.4))]
    assert device.device.received == []


def test_what_waits_is_lost_with_the_link():
    device = faulty("kind: delay, for_s: 9, up_to_ms: 5000")
    device.connected(ZERO_NS)
    list(run(device, 0.1))
    device.disconnected(ZERO_NS + S)
    assert device.due(ZERO_NS + 8 * S) == b""
