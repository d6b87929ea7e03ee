"""Session with a Create 1, which has no encoders: distance and rotation, corrected for truncation.

Packets 19 and 20 give integer millimetres and degrees since they were last read and drop the fraction. In a
stream, every 15 ms, a turn below 67 deg/s would read as no turn at all. So they are requested seldom, by a
query list, and the requested wheel speeds (41, 42) decide where inside its millimetre or degree a reading
lies.
"""

from drivers.errors import ProtocolError, TransportError
from drivers.frames import OdometrySample
from drivers.irobot_create.config import GIVE_UP_NS, RETRY_START_NS, IrobotCreateConfig
from drivers.irobot_create.health import CHARGING, HEALTH_IDS
from drivers.irobot_create.odometry import DeadReckoning, TwistWindow, inside_truncated
from drivers.irobot_create.protocol import (
    BANNER_END_NS,
    MODE_SWITCH_NS,
    Opcode,
    PacketId,
    TextCollector,
    data_bytes,
    decode_values,
    encode_query,
)
from drivers.irobot_create.robot import RobotSession

# An answer has neither length nor checksum: the mode at both ends is its guard.
QUERY_IDS = (
    PacketId.OI_MODE,
    *HEALTH_IDS[:-1],
    PacketId.DISTANCE,
    PacketId.ANGLE,
    PacketId.REQUESTED_RIGHT_VELOCITY,
    PacketId.REQUESTED_LEFT_VELOCITY,
    PacketId.OI_MODE,
)
ANSWER_NS = 100_000_000  # the robot answers within 16 ms; a USB adapter adds its own
QUIET_NS = 50_000_000  # after a broken answer, before the next request
FASTEST_MMPS = 500  # a request to a wheel, by the manual
UNBELIEVABLE_MMPS, UNBELIEVABLE_DEGPS = 2000, 900  # four times what such requests can lead to
TWIST_READINGS = 3
DEGREE_RAD = 0.017453292519943295
READING_VARIANCE_RAD2 = DEGREE_RAD**2 / 12.0  # uniform inside a degree
STREAK = 3  # refused answers in a row that mean the start is to be repeated


class Create1Session(RobotSession):
    """One connection's life; see drivers.link.Session. An OdometrySample per answer.

    A stamp is the middle between the earliest moment the question can have been heard and the latest the
    answer can have been sent (Cristian, "Probabilistic clock synchronization", 1989).
    """

    clock_offset_ns: int | None = None
    clock_sigma_ns: int | None = None
    _button = "power"

    def __init__(self, config: IrobotCreateConfig, odometry: DeadReckoning | None = None) -> None:
        super().__init__(config, odometry, TwistWindow(TWIST_READINGS))
        self._text = TextCollector()
        self._answer = bytearray()
        self._answer_bytes = data_bytes(QUERY_IDS)
        self._requested_ns: int | None = None  # None: no question is open
        self._ask_at_ns = 0
        self._last_mps: tuple[float, float] | None = None  # requested left and right; None before an answer
        self._path_length_lost = True  # of the time before this session
        self._refused_in_a_row = 0

    def shutdown_request(self) -> bytes:
        return bytes([Opcode.START])  # Passive: the robot may charge and sleep

    def tick(self, now_ns: int) -> None:
        if self._last_heard_ns is None:
            self._last_heard_ns = self._start_at_ns = now_ns
        if now_ns - self._last_heard_ns > GIVE_UP_NS:
            answers = self.counters["answers_received"]
            stopped = f"no valid answer for {GIVE_UP_NS / 1e9:.0f} s after {answers}" if answers else ""
            raise TransportError(self._explain_silence(stopped, "valid answer"))
        if self._requested_ns is not None and now_ns - self._requested_ns > ANSWER_NS:
            self._give_up_answer(now_ns)
        if self._start_at_ns is not None and now_ns >= self._start_at_ns:
            self.counters["starts"] += 1
            self.outbox.append(Opcode.START)
            self._start_at_ns = now_ns + RETRY_START_NS
            self._ask_at_ns = now_ns + MODE_SWITCH_NS
        elif self._requested_ns is None and now_ns >= self._ask_at_ns:
            self.outbox += encode_query(QUERY_IDS)
            self._requested_ns = now_ns
            self._answer.clear()

    def _give_up_answer(self, now_ns: int) -> None:
        self.counters["answers_missed"] += 1
        self._drop_answer(now_ns)
        if self._start_at_ns is None:
            self._start_at_ns = now_ns + RETRY_START_NS

    def _drop_answer(self, now_ns: int) -> None:
        """The open answer is lost, perhaps with motion that it reported: the counters were cleared."""
        self._path_length_lost = True
        self._skip(bytes(self._answer))
        self._answer.clear()
        self._requested_ns = None
        self._ask_at_ns = now_ns + QUIET_NS

    def _skip(self, data: bytes) -> None:
        self.counters["bytes_skipped"] += len(data)
        for byte in data:
            self._text.add(byte)

    def receive_data(self, data: bytes, arrived_ns: int) -> list[OdometrySample]:
        self._bytes_heard += len(data)
        if self._requested_ns is None:
            self._skip(data)
            self._ask_at_ns = max(self._ask_at_ns, arrived_ns + QUIET_NS)
            self._read_text(arrived_ns)
            return []
        self._answer += data
        if len(self._answer) < self._answer_bytes:
            return []
        answer, surplus = bytes(self._answer[: self._answer_bytes]), bytes(self._answer[self._answer_bytes :])
        values = None if surplus else self._accepted(answer, arrived_ns)
        if values is None:
            self.counters["answers_refused"] += 1
            self._refused_in_a_row += 1
            self._drop_answer(arrived_ns)
            if self._refused_in_a_row >= STREAK and self._start_at_ns is None:
                self._start_at_ns = arrived_ns + QUIET_NS
            self._read_text(arrived_ns)
            return []
        requested_ns, self._requested_ns = self._requested_ns, None
        self._answer.clear()
        self._text.interrupt()
        self._refused_in_a_row = 0
        self._start_at_ns = None
        self._last_heard_ns = arrived_ns
        self._ask_at_ns = max(requested_ns + self._config.poll_interval_ms * 1_000_000, arrived_ns)
        return [self._to_sample(values, requested_ns, arrived_ns)]

    def _read_text(self, arrived_ns: int) -> None:
        for line in self._text.lines:
            if self._take_line(line, arrived_ns, self._last_mps is not None):
                self._ask_at_ns = arrived_ns + BANNER_END_NS
        self._text.lines.clear()

    def _accepted(self, answer: bytes, arrived_ns: int) -> dict[int, int] | None:
        """The answer's values, None where they contradict themselves or the robot's abilities."""
        try:
            values = decode_values(QUERY_IDS, answer)
        except ProtocolError:
            return None
        if self._last_mps is None or self._odometry.stamp_ns is None:
            values |= {PacketId.DISTANCE: 0, PacketId.ANGLE: 0}  # of before we came
            elapsed_s = 0.0
        else:
            elapsed_s = (arrived_ns - self._odometry.stamp_ns) * 1e-9 + 0.1
        believable = (
            answer[0] == answer[-1]
            and values[PacketId.BUMPS_WHEEL_DROPS] < 32
            and all(values[packet_id] <= 1 for packet_id in HEALTH_IDS[1:5])  # cliffs
            and values[PacketId.CHARGING_STATE] < len(CHARGING)
            and 5_000 <= values[PacketId.VOLTAGE] <= 25_000
            and abs(values[PacketId.REQUESTED_LEFT_VELOCITY]) <= FASTEST_MMPS
            and abs(values[PacketId.REQUESTED_RIGHT_VELOCITY]) <= FASTEST_MMPS
            and abs(values[PacketId.DISTANCE]) <= UNBELIEVABLE_MMPS * elapsed_s
            and abs(values[PacketId.ANGLE]) <= UNBELIEVABLE_DEGPS * elapsed_s
        )
        return values if believable else None

    def _to_sample(self, values: dict[int, int], requested_ns: int, arrived_ns: int) -> OdometrySample:
        heard_ns = requested_ns + round((2 + len(QUERY_IDS)) * self._byte_ns)
        sent_ns = arrived_ns - round(self._answer_bytes * self._byte_ns)
        stamp_ns = (heard_ns + sent_ns) // 2 - round(self._config.latency_ms * 1e6)
        left_mps = values[PacketId.REQUESTED_LEFT_VELOCITY] * 1e-3
        right_mps = values[PacketId.REQUESTED_RIGHT_VELOCITY] * 1e-3
        ds_m = dth_rad = 0.0
        if self._odometry.stamp_ns is not None:
            stamp_ns = max(stamp_ns, self._odometry.stamp_ns + 1)
            elapsed_s = (stamp_ns - self._odometry.stamp_ns) * 1e-9
            if self._path_length_lost:
                self._odometry.lose(elapsed_s)
            if self._last_mps is not None:
                expected_left_m = 0.5 * (left_mps + self._last_mps[0]) * elapsed_s
                expected_right_m = 0.5 * (right_mps + self._last_mps[1]) * elapsed_s
                ds_m, dth_rad = self._roll(values, expected_left_m, expected_right_m)
        self._path_length_lost = False
        self._last_mps = (left_mps, right_mps)
        self._health.observe(values)
        self.counters["answers_received"] += 1
        self.status = f"polling; {self._health.words()}"
        twist = self._twist.add(stamp_ns, ds_m, dth_rad)
        return self._odometry.sample(self._config.name, stamp_ns, arrived_ns, twist)

    def _roll(
        self, values: dict[int, int], expected_left_m: float, expected_right_m: float
    ) -> tuple[float, float]:
        """Integrate a reading, its lost fractions filled in from the commanded wheel motion."""
        base_m = self._config.firmware_wheel_base_m
        expected_deg = (expected_right_m - expected_left_m) / base_m / DEGREE_RAD
        expected_mm = 500.0 * (expected_left_m + expected_right_m)
        turn_rad = inside_truncated(values[PacketId.ANGLE], expected_deg) * DEGREE_RAD
        path_length_m = inside_truncated(values[PacketId.DISTANCE], expected_mm) * 1e-3
        return self._odometry.roll(
            (path_length_m - 0.5 * base_m * turn_rad) * self._config.left_scale,
            (path_length_m + 0.5 * base_m * turn_rad) * self._config.right_scale,
            READING_VARIANCE_RAD2 if turn_rad else 0.0,
        )
