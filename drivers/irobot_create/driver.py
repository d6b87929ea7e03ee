"""Session with a Create 2 or a Roomba: start it, have it stream, turn encoder counts into odometry.

Read-only: no command for wheels, brushes or lamps is ever sent, and the robot stays in Passive mode.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import TransportError
from drivers.frames import OdometrySample
from drivers.irobot_create.config import GIVE_UP_NS, RETRY_START_NS, IrobotCreateConfig
from drivers.irobot_create.create1 import Create1Session
from drivers.irobot_create.frame_clock import FrameClock
from drivers.irobot_create.health import HEALTH_IDS, EncoderFaults
from drivers.irobot_create.odometry import FASTEST_MPS, DeadReckoning, TwistWindow, counts_between
from drivers.irobot_create.protocol import (
    FRAME_PERIOD_NS,
    MODE_SWITCH_NS,
    Opcode,
    PacketId,
    StreamDecoder,
    StreamFrame,
    encode_stream_request,
    frame_bytes,
)
from drivers.irobot_create.robot import RobotSession
from drivers.link import Session

log = logging.getLogger(__name__)

# 37 bytes a frame. The mode comes last: where a byte 0x13 of the last packet is lost, the next frame's header
# stands in for the checksum and the sum still fits; a mode is never 0x13.
STREAM_IDS = (PacketId.LEFT_ENCODER, PacketId.RIGHT_ENCODER, *HEALTH_IDS)
MODE_SETTLED_NS = 200_000_000  # by then packet 35 shows what 128 did
KEEP_ALIVE_NS = 60_000_000_000
UNSTICKING_STARTS = 4  # a robot that waits for the rest of a command takes the first ones for its data
REACH_MARGIN = 3.0  # over the fastest the wheels turn by themselves, for a vehicle may roll along faster
REACH_SLACK_NS = 80_000_000  # stamps may be so late: USB adapters hold frames back
NEAR_ZERO_COUNTS = 1_000  # 0.44 m: a robot that was reset counts from 0, and has hardly rolled since


@dataclass(frozen=True, slots=True)
class Reading:
    """Reading of both encoders, counts."""

    left: int
    right: int
    stamp_ns: int


class IrobotCreateSession(RobotSession):
    """One connection's life; see drivers.link.Session.

    Yields an OdometrySample per stream frame, 66.7 a second.
    """

    def __init__(self, config: IrobotCreateConfig, odometry: DeadReckoning | None = None) -> None:
        super().__init__(config, odometry, TwistWindow())
        self._decoder = StreamDecoder(STREAM_IDS)
        self._encoder_faults = EncoderFaults()
        self._frame_bytes = frame_bytes(STREAM_IDS)
        self._clock = FrameClock(round(self._frame_bytes * self._byte_ns + config.latency_ms * 1e6))
        self._read: Reading | None = None  # the last plausible one; None: not read since the last reset
        self._doubtful: Reading | None = None  # too far from that; the next one tells which of them was right
        self._heard_ns: int | None = None
        self._backdated = False  # the read at hand: its bytes had the time to come one after the other
        self._was_silent = False  # for a second or more, and no reading came since
        self._started_ns: int | None = None  # 128 was sent
        self._request_at_ns: int | None = None
        self._keep_alive_at_ns = 0
        self._stream_from_ns: int | None = None  # frames before this are of an older stream; None: all are
        self._mode_learned = False

    @property
    def clock_offset_ns(self) -> int | None:
        return self._clock.offset_ns

    @property
    def clock_sigma_ns(self) -> int | None:
        return self._clock.offset_sigma_ns

    def shutdown_request(self) -> bytes:
        return bytes([Opcode.START, Opcode.STOP])  # Stop ends stream and mode; else Safe drains the battery

    def tick(self, now_ns: int) -> None:
        if self._last_heard_ns is None:
            self._last_heard_ns = self._start_at_ns = now_ns
            self._keep_alive_at_ns = now_ns + KEEP_ALIVE_NS
        silence_ns = now_ns - self._last_heard_ns
        if silence_ns > GIVE_UP_NS:
            frames = self.counters["frames_received"]
            stopped = f"silent for {GIVE_UP_NS / 1e9:.0f} s after {frames} frames" if frames else ""
            raise TransportError(self._explain_silence(stopped, "stream frame"))
        if self._start_at_ns is None and silence_ns > RETRY_START_NS:
            self.status = "no stream; starting the robot again"
            self.counters["silences"] += 1
            self._was_silent = True
            self._start_at_ns = now_ns
        if self._start_at_ns is not None and now_ns >= self._start_at_ns:
            self._start(now_ns)
        if self._request_at_ns is not None and now_ns >= self._request_at_ns:
            self._request_at_ns = None
            self.outbox += encode_stream_request(STREAM_IDS)
            self._stream_from_ns = now_ns + FRAME_PERIOD_NS
            self._clock.restart()  # a stream requested again runs in another phase
            self._twist.clear()
        if now_ns >= self._keep_alive_at_ns:
            # resuming a stream that runs changes nothing and answers nothing, but it is activity
            self.outbox += bytes([Opcode.PAUSE_RESUME_STREAM, 1])
            self._keep_alive_at_ns = now_ns + KEEP_ALIVE_NS

    def _start(self, now_ns: int) -> None:
        self.counters["starts"] += 1
        again = self._started_ns is not None
        self.outbox += bytes([Opcode.START]) * (UNSTICKING_STARTS if again else 1)
        self._started_ns = now_ns
        self._request_at_ns = now_ns + MODE_SWITCH_NS
        self._start_at_ns = now_ns + RETRY_START_NS  # unless a frame comes
        self._stream_from_ns = None

    def receive_data(self, data: bytes, arrived_ns: int) -> list[OdometrySample]:
        self._bytes_heard += len(data)
        since_ns = arrived_ns if self._heard_ns is None else arrived_ns - self._heard_ns
        self._backdated = len(data) * self._byte_ns <= since_ns
        self._heard_ns = arrived_ns
        frames = self._decoder.receive_data(data)
        self._read_text(arrived_ns)
        samples = [sample for frame in frames if (sample := self._to_sample(frame, arrived_ns))]
        self.counters["bytes_skipped"] = self._decoder.bytes_skipped
        self.counters["checksum_failures"] = self._decoder.checksum_failures
        self.counters["frames_missed"] = self._clock.frames_missed
        self.counters["frame_clock_retunes"] = self._clock.retunes
        return samples

    def _read_text(self, arrived_ns: int) -> None:
        for line in self._decoder.lines:
            if self._take_line(line, arrived_ns, self.counters["frames_received"] > 0):
                self._request_at_ns = self._stream_from_ns = None
                self._read = self._doubtful = None
        self._decoder.lines.clear()

    def _to_sample(self, frame: StreamFrame, arrived_ns: int) -> OdometrySample | None:
        if self._stream_from_ns is None or arrived_ns < self._stream_from_ns:
            self.counters["frames_of_old_stream"] += 1
            return None
        self.counters["frames_received"] += 1
        self._last_heard_ns = arrived_ns
        self._start_at_ns = None
        if not self._mode_learned and self._started_ns is not None:
            self._learn_mode(frame, arrived_ns - self._started_ns)
        stamp_ns = self._clock.stamp(
            self._ended_ns(frame, arrived_ns),
            missing_at_most=-(-frame.damaged_bytes_before // self._frame_bytes),
        )
        ds_m, dth_rad = self._roll(frame, stamp_ns, arrived_ns)
        self._health.observe(frame.values)
        parts = ("streaming", self._encoder_faults.words(arrived_ns), self._health.words())
        self.status = "; ".join(text for text in parts if text)
        twist = self._twist.add(stamp_ns, ds_m, dth_rad)
        return self._odometry.sample(self._config.name, stamp_ns, arrived_ns, twist)

    def _ended_ns(self, frame: StreamFrame, arrived_ns: int) -> int:
        """Time at which the frame's last byte was on the line; never too early.

        What came behind it in the same read took its time on the line. Not so where the read holds more than
        the line can have brought since the read before: that was delayed elsewhere.
        """
        return arrived_ns - (round(frame.bytes_after * self._byte_ns) if self._backdated else 0)

    def _learn_mode(self, frame: StreamFrame, since_start_ns: int) -> None:
        if since_start_ns < MODE_SETTLED_NS:
            return
        self._mode_learned = True
        if self._health.learn_mode_offset(frame.values[PacketId.OI_MODE]):
            self.identity["oi_mode"] = "reported one too high"

    def _roll(self, frame: StreamFrame, stamp_ns: int, arrived_ns: int) -> tuple[float, float]:
        """Integrate the counts since the last reading; (m, rad), zeros where they are implausible."""
        counts = (frame.values[PacketId.LEFT_ENCODER], frame.values[PacketId.RIGHT_ENCODER])
        reading = Reading(*counts, stamp_ns)
        if self._was_silent and self._read is not None and _started_over(self._read, reading):
            self.counters["robot_resets"] += 1
            self._read = self._doubtful = None
        self._was_silent = False
        for before in (self._read, self._doubtful):
            if (
                before is not None
                and (path_lengths_m := self._path_lengths_m(before, reading, arrived_ns)) is not None
            ):
                self._read, self._doubtful = reading, None
                return self._odometry.roll(*path_lengths_m)
        if self._read is None:
            self._read = reading
        else:
            self._doubtful = reading
            self._note_fault(self._read, reading, arrived_ns)
        if self._odometry.stamp_ns is not None:
            self._odometry.lose((stamp_ns - self._odometry.stamp_ns) * 1e-9)
        return 0.0, 0.0

    def _path_lengths_m(self, before: Reading, now: Reading, arrived_ns: int) -> tuple[float, float] | None:
        """Travel of the left and the right wheel, m; None where they cannot have turned so far."""
        left_m, right_m = self._steps_m(before, now)
        possible = max(abs(left_m), abs(right_m)) <= _reach_m(before, arrived_ns)
        return (left_m, right_m) if possible else None

    def _steps_m(self, before: Reading, now: Reading) -> tuple[float, float]:
        return (
            counts_between(before.left, now.left) * self._config.left_m_per_count,
            counts_between(before.right, now.right) * self._config.right_m_per_count,
        )

    def _note_fault(self, before: Reading, now: Reading, arrived_ns: int) -> None:
        self.counters["encoder_faults"] += 1
        reach_m = _reach_m(before, arrived_ns)
        left, right = (abs(step_m) > reach_m for step_m in self._steps_m(before, now))
        wheel = "both" if left and right else "left" if left else "right"
        if faults := self._encoder_faults.add(wheel, arrived_ns):
            log.warning(
                "%s: encoders jumped from %d, %d to %d, %d, at most %.3f m are possible; not counted%s",
                self._config.name,
                before.left,
                before.right,
                now.left,
                now.right,
                reach_m,
                f"; {faults} jumps since the last such line" if faults > 1 else "",
            )


def _reach_m(since: Reading, arrived_ns: int) -> float:
    """Farthest travel of a wheel until a reading that arrived then; its stamp may not yet contain
    frames that were lost, m."""
    return REACH_MARGIN * FASTEST_MPS * (arrived_ns - since.stamp_ns + REACH_SLACK_NS) * 1e-9


def _started_over(before: Reading, now: Reading) -> bool:
    """Whether the robot was reset in the silence between the two: not all of them send a banner then.

    One that did roll to where both counters are near 0 is taken for one that was reset: its motion is not
    counted, the covariance takes it in.
    """
    near_zero = all(abs(counts_between(0, count)) <= NEAR_ZERO_COUNTS for count in (now.left, now.right))
    steps = (counts_between(before.left, now.left), counts_between(before.right, now.right))
    return near_zero and max(map(abs, steps)) > NEAR_ZERO_COUNTS


def session_maker(config: IrobotCreateConfig) -> Callable[[], Session]:
    """Makes the sessions that suit the model, one a connection; the pose goes on from one to the next."""
    odometry = DeadReckoning(config.wheel_base_m, config.travel_variance_m2_per_m)
    session = Create1Session if config.model == "create1" else IrobotCreateSession
    return lambda: session(config, odometry)
