"""Session with one MTi-G, MTi-G-700 or MTi-G-710: its dialogue, and its data into frames. No I/O."""

from drivers.dialogue import DialogueRunner
from drivers.errors import ProtocolError
from drivers.frames import Frame, ImuSample
from drivers.watch import DAMAGED, DropReason, MalformedRun, WatchedSession
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.dialogue import Ask, MtigDialogue
from drivers.xsens_mtig.health import DeviceHealth
from drivers.xsens_mtig.protocol import Message, MessageDecoder, Mid, encode, error_text, warning_text
from drivers.xsens_mtig.streams import LegacyStream, Mtdata2Stream

BITS_A_BYTE = 10
STALE_NS = 100_000_000  # bytes of a message follow upon each other; adapters hold them back for 16 ms
FIRST_SAMPLE_TIMEOUT_S = 5.0
MALFORMED_LIMIT = 100  # messages in a row
OTHER_PROTOCOL = DropReason(
    "of the other protocol (MTData, MTData2) than it was set to", "another program sets it up: stop it"
)


class XsensMtigSession(WatchedSession):
    """The life of one connection; see drivers.link.Session. Yields an ImuSample per inertial message and a
    GnssFix per solution of the receiver.
    """

    def __init__(self, config: XsensMtigConfig) -> None:
        self._config = config
        self._decoder = MessageDecoder()
        self._dialogue = MtigDialogue(config)
        super().__init__("samples", self._dialogue.counters, MALFORMED_LIMIT)
        self._malformed = MalformedRun(self.counters, "messages", MALFORMED_LIMIT)
        self._runner: DialogueRunner[Ask, Message] = DialogueRunner(self._dialogue.run)
        self._heard_ns: int | None = None
        self._backdated = False  # the read at hand: its bytes had the time to come one after the other
        self._byte_ns = 0.0  # on the line; over USB none
        self._stream: Mtdata2Stream | LegacyStream | None = None
        self._streaming = False
        self.identity = self._dialogue.identity
        self.status = self._dialogue.phase
        self._health = DeviceHealth(self.counters)

    def receive_data(self, data: bytes, arrived_ns: int) -> list[Frame]:
        since_ns = arrived_ns if self._heard_ns is None else arrived_ns - self._heard_ns
        self._backdated = len(data) * self._byte_ns <= since_ns
        self._heard_ns = arrived_ns
        frames = self._take_all(self._decoder.receive_data(data), arrived_ns)
        self._set_status(arrived_ns)
        return frames

    def tick(self, now_ns: int) -> None:
        if self._decoder.waiting_bytes and now_ns - (self._heard_ns or 0) > STALE_NS:
            self._take_all(self._decoder.give_up_waiting(), now_ns, old=True)
        if (requested := self._runner.tick(now_ns)) is not None:
            self.outbox += encode(requested.mid, requested.data)
        limit_s = self._config.silence_timeout_s if self._streaming else FIRST_SAMPLE_TIMEOUT_S
        nothing = f"no sample for {limit_s:g} s; did it lose power, or is the cable out?"
        self._end_where_silent(now_ns, limit_s, self._dialogue.measuring, nothing)
        self._set_status(now_ns)

    def shutdown_request(self) -> bytes:
        return encode(Mid.GO_TO_CONFIG)  # units left streaming over USB were seen to ignore the next client

    def _take_all(self, messages: list[Message], arrived_ns: int, old: bool = False) -> list[Frame]:
        """old: they came a while before arrived_ns, so they are no use as samples."""
        frames: list[Frame] = []
        for message in messages:
            self._dialogue.heard = True
            match message.mid:
                case Mid.MTDATA2 | Mid.MTDATA:
                    if self._dialogue.measuring and not old:
                        frames += self._take_data(message, arrived_ns)
                    else:
                        self.counters["messages_before_start"] += 1
                case Mid.WAKE_UP:
                    self._wake_up(arrived_ns)
                case Mid.WARNING:
                    self.counters["device_warnings"] += 1
                    self._health.say(warning_text(message), arrived_ns)
                case _:
                    self._take_answer(message, arrived_ns)
        self._silence.dropped(DAMAGED, self._decoder.bad_checksums - self.counters["checksum_errors"])
        self._count(bytes_skipped=self._decoder.skipped_bytes, checksum_errors=self._decoder.bad_checksums)
        return frames

    def _take_answer(self, message: Message, now_ns: int) -> None:
        requested = self._runner.awaited
        if requested is not None and _answers(message, requested):
            self._runner.answer(message, now_ns)
            if self._runner.ended:
                self._begin_stream()
        elif message.mid == Mid.ERROR:
            self.counters["device_errors"] += 1
            self._health.say(error_text(message), now_ns)
        else:
            self.counters["messages_ignored"] += 1

    def _wake_up(self, now_ns: int) -> None:
        """The unit has just started; it stays in config state if WakeUp is acknowledged within 0.5 s."""
        self.outbox += encode(Mid.WAKE_UP_ACK)
        self.counters["wake_ups"] += 1
        if self._dialogue.awaits_wake_up:
            return
        if self._streaming:
            self.counters["device_restarts"] += 1
        self._runner.restart()
        self._dialogue.measuring = self._streaming = False

    def _begin_stream(self) -> None:
        dialogue = self._dialogue
        self._byte_ns = BITS_A_BYTE * 1e9 / dialogue.baud if dialogue.baud else 0.0
        self._silence.heard()
        shared = (self._config, self.counters, self._health, self._silence)
        if dialogue.legacy is None:
            self._clock = self._stream = Mtdata2Stream(*shared, dialogue.output)
        else:
            self._clock = self._stream = LegacyStream(*shared, dialogue.legacy)

    def _take_data(self, message: Message, arrived_ns: int) -> list[Frame]:
        assert self._stream is not None
        legacy = self._dialogue.legacy is not None
        if legacy is not (message.mid == Mid.MTDATA):
            self.counters["messages_of_the_other_protocol"] += 1
            self._silence.dropped(OTHER_PROTOCOL)
            return []
        try:
            behind = message.bytes_after / message.wire_bytes
            frames = self._stream.take(message.data, self._sent_ns(message, arrived_ns), arrived_ns, behind)
        except ProtocolError as error:
            self._malformed.bad(error)
            return []
        self._malformed.good()
        if any(isinstance(frame, ImuSample) for frame in frames):
            self._silence.heard()
            self._streaming = True
        return frames

    def _sent_ns(self, message: Message, arrived_ns: int) -> int:
        """Time at which the first byte of the message was on the line; never too early.

        What came behind it in the same read took its time on the line too. Not so where the read holds more
        than the line can have brought since the read before: that was delayed elsewhere.
        """
        byte_count = message.wire_bytes + (message.bytes_after if self._backdated else 0)
        return arrived_ns - round(byte_count * self._byte_ns)

    def _set_status(self, now_ns: int) -> None:
        if not self._streaming:
            texts: tuple[str, ...] = (self._dialogue.phase, self._health.newest(now_ns))
        else:
            notes = [] if self._stream is None else self._stream.notes
            parts = (self._dialogue.fault, *self._dialogue.refusals, *notes)
            texts = ("streaming", *parts, self._health.words(now_ns))
        self.status = "; ".join(text for text in texts if text)


def _answers(message: Message, requested: Ask) -> bool:
    """An Error message answers every request but those that a unit may ignore."""
    if message.mid == Mid.ERROR:
        return requested.mid not in (Mid.GO_TO_CONFIG, Mid.RESET)
    return message.mid == (requested.mid + 1) & 0xFF
