"""Start-up dialogue of a Hokuyo laser: from the first byte to the stream. No I/O, no clock.

The device may be booting (silent, or 0M), streaming for a client that died (on USB it goes on), left in
time-adjust mode, asleep, in SCIP 1 or abnormal. Hence: end all that first, then query its identity. Sources:
C-42-03320B; UrgNetworks/urg_library; ros-drivers/hokuyo_node; gbiggs/hokuyoaist; seqsense/urg_stamped PR 115.
"""

from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import TypeVar

from drivers.dialogue import Pause
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.hokuyo_utm30lx import protocol
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.geometry import Geometry
from drivers.hokuyo_utm30lx.models import mismatch
from drivers.hokuyo_utm30lx.scan_clock import TimeSample
from drivers.hokuyo_utm30lx.scans import ScanRequest

ANSWER_TIMEOUT_S = 0.5  # real answers take 1 to 25 ms
RESET_TIMEOUT_S = 2.0
STOP_ATTEMPTS = 15  # a boot takes up to some seconds
WARM_UP_PAUSE_S = 0.5
WARM_UP_PAUSES = 60
ATTEMPTS = 4
TIME_SAMPLES = 40
TIME_SAMPLES_UNANSWERED = 3
LASER_ATTEMPTS = 10
LASER_PAUSE_S = 1.0
UNKNOWN = ("0D", "0E", "0F")  # command; 0F also: not supported
BAD_CLUSTER, BAD_SKIP = "03", "06"
ALREADY = "02"  # BM: laser is on; TM0: time-adjust mode is on

HEALTHY = ("stable", "sensor works well", "sensor is working normally")
IDENTITY = (("product", "PROD"), ("firmware", "FIRM"), ("protocol", "PROT"), ("serial", "SERI"))

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Ask:
    command: str
    timeout_s: float = ANSWER_TIMEOUT_S


@dataclass(frozen=True, slots=True)
class Answer:
    """A reply, and between which host times the device made it."""

    reply: protocol.Reply
    requested_ns: int
    arrived_ns: int


Dialogue = Generator[Ask | Pause, Answer | None, T]


class UtmDialogue:
    """Dialogue of one connection: `run` is the generator, the attributes are its results."""

    def __init__(self, config: HokuyoUtm30lxConfig) -> None:
        self._config = config
        self.counters: Counter[str] = Counter()
        self.identity: dict[str, str] = {}
        self.phase = "connecting"
        self.fault = ""  # fault that the device reports, "" for none
        self.refusals: list[str] = []  # refused settings, as text
        self.geometry: Geometry | None = None
        self.request: ScanRequest | None = None  # of the stream that was requested
        self.time_samples: list[TimeSample] = []

    def run(self) -> Dialogue[None]:
        """Raises TransportError where nothing answers, DeviceError where the device refuses or is the wrong
        one, ProtocolError where its answer makes no sense."""
        yield from self._stop_whatever_runs()
        yield from self._identify()
        yield from self._look_at_state()
        self.geometry = yield from self._understood("PP", Geometry.of)
        if self._config.time_sync:
            yield from self._ask_the_time()
        yield from self._light_the_laser()
        yield from self._start_stream()

    def _stop_whatever_runs(self) -> Dialogue[None]:
        self.phase = "no answer yet: booting?"
        refusal = ""
        attempts = 0
        while attempts < STOP_ATTEMPTS:
            yield from self._ask("TM2", ANSWER_TIMEOUT_S / 2)  # whatever it answers
            reply = yield from self._ask("QT")
            attempts += 1
            if reply is None:
                continue
            if reply.status == protocol.OK:
                return
            refusal = reply.status
            if refusal == protocol.SCIP_1:
                self.counters["switched_to_scip_2"] += 1
                yield from self._ask("SCIP2.0")
            elif refusal == protocol.ABNORMAL:
                yield from self._reboot()
            elif refusal == protocol.UNSTABLE:
                attempts -= 1
                yield from self._warm_up()
            elif refusal == protocol.FIRMWARE_UPDATE:
                raise DeviceError("waits for new firmware (status 0I); finish the update with Hokuyo's tool")
            elif attempts >= ATTEMPTS:
                yield from self._reset()
        if refusal:
            raise DeviceError(f"QT refused {STOP_ATTEMPTS} times: {status_text(refusal)}; cut its power once")
        raise TransportError(
            f"connected, but no answer to {STOP_ATTEMPTS} times QT; is it still booting, is it a Hokuyo, "
            "does another program hold it?"
        )

    def _identify(self) -> Dialogue[None]:
        self.phase = "reading identity"
        reported = yield from self._understood("VV", dict)
        self.identity |= {key: reported[name] for key, name in IDENTITY if reported.get(name)}
        where = self._config.device or self._config.host
        if words := mismatch(self.identity.get("product", ""), self._config.model):
            raise DeviceError(f"{words}; is {where} the right laser?")
        wanted, found = self._config.serial_number, reported.get("SERI", "")
        if wanted is not None and wanted.strip().casefold() != found.casefold():
            raise DeviceError(
                f"this is unit {found or '(without a number)'}, expected serial_number {wanted}; are two "
                f"sensors swapped? look which one is at {where}"
            )

    def _look_at_state(self) -> Dialogue[None]:
        """State by II; a device that does not report it counts as well."""
        reply = yield from self._ask("II")
        if reply is None or reply.status != protocol.OK:
            return
        try:
            reported = protocol.read_info(reply)
        except ProtocolError:
            self.counters["answers_unusable"] += 1
            return
        state = reported.get("STAT", "")
        self.fault = "" if state.casefold().startswith(HEALTHY) or not state else state

    def _ask_the_time(self) -> Dialogue[None]:
        """Time-adjust mode, many short questions, and out. Some firmwares refuse at times: then stamps rest
        on arrivals alone."""
        self.phase = "asking its clock"
        reply = yield from self._ask("TM0")
        if reply is None or reply.status not in (protocol.OK, ALREADY):
            self.counters["time_sync_refused"] += 1
            self.refusals.append("configured time_sync not taken: stamps are uncertain by about 1 ms")
        else:
            yield from self._sample_time()
        yield from self._ask("TM2")

    def _sample_time(self) -> Dialogue[None]:
        unanswered = 0
        while len(self.time_samples) < TIME_SAMPLES and unanswered < TIME_SAMPLES_UNANSWERED:
            answer = yield Ask("TM1")
            if answer is None or answer.reply.status != protocol.OK:
                unanswered += 1
                continue
            try:
                device_ms = protocol.read_time(answer.reply)
            except ProtocolError:
                self.counters["answers_unusable"] += 1
                unanswered += 1
                continue
            self.time_samples.append(TimeSample(answer.requested_ns, device_ms, answer.arrived_ns))

    def _light_the_laser(self) -> Dialogue[None]:
        self.phase = "lighting the laser"
        for attempt in range(LASER_ATTEMPTS):
            if attempt:
                yield Pause(LASER_PAUSE_S)
            reply = yield from self._accepted("BM", (protocol.OK, ALREADY, "01"))
            if reply.status != "01":
                return
        raise DeviceError(
            f"the laser does not light: BM refused {LASER_ATTEMPTS} times with 01 (unstable or broken)"
            + (f"; it says: {self.fault}" if self.fault else "")
        )

    def _start_stream(self) -> Dialogue[None]:
        self.phase = "asking for scans"
        assert self.geometry is not None
        config = self._config
        first, last = (
            self.geometry.step_at(angle) for angle in (config.first_angle_deg, config.last_angle_deg)
        )
        if first >= last:
            raise DeviceError(
                f"{config.first_angle_deg:g} to {config.last_angle_deg:g} deg are steps {first} to {last} of "
                f"{self.geometry.first_step} to {self.geometry.last_step}: it cannot look there"
            )
        for key, angle_deg, step in (
            ("first_angle_deg", config.first_angle_deg, first),
            ("last_angle_deg", config.last_angle_deg, last),
        ):
            seen_deg = self.geometry.angle_deg(step)
            if abs(seen_deg - angle_deg) > 360.0 / self.geometry.steps_per_turn:
                self.refusals.append(f"configured {key} {angle_deg:g} not taken: it sees to {seen_deg:g} deg")
        request = ScanRequest(config.scan_command, first, last, config.cluster, config.skip_scans)
        while True:
            reply = yield from self._accepted(request.text, (protocol.OK, *protocol.SCAN_STATUS, *UNKNOWN))
            if reply.status == protocol.OK:
                break
            setting, simpler = self._simpler(request, reply.status)
            if simpler is None:
                question = f"it does not know the command; is this a {config.limits.name}?"
                words = protocol.SCAN_STATUS.get(reply.status, question)
                raise DeviceError(f"{request.text} refused (status {reply.status}): {words}")
            reason = f"{request.command} refused (status {reply.status})"
            self.refusals.append(f"configured {setting} not taken: {reason}")
            request = simpler
        self.request = request
        self.phase = "waiting for the first scan"

    def _simpler(self, request: ScanRequest, status: str) -> tuple[str, ScanRequest | None]:
        """The setting that this status refuses, and the request without it; None: there is none."""
        config = self._config
        if status == BAD_CLUSTER and request.cluster > 1:
            return f"cluster {request.cluster}", replace(request, cluster=1)
        if status == BAD_SKIP and request.skip:
            return f"skip_scans {request.skip}", replace(request, skip=0)
        if status in UNKNOWN and request.multi_echo:
            return f"echo {config.echo}", replace(request, command="ME" if config.intensity else "MD")
        if status in UNKNOWN and request.with_intensity:
            return "intensity", replace(request, command="MD")
        return "", None

    def _accepted(self, command: str, statuses: tuple[str, ...]) -> Dialogue[protocol.Reply]:
        """Repeat the request until one of these comes. Raises DeviceError on another refusal that stays."""
        refusal = ""
        attempts = 0
        while attempts < ATTEMPTS:
            reply = yield from self._ask(command)
            if reply is not None and reply.status in statuses:
                return reply
            if reply is not None and reply.status == protocol.UNSTABLE:
                yield from self._warm_up()
                continue
            attempts += 1
            refusal = refusal if reply is None else reply.status
            if refusal == protocol.ABNORMAL:
                yield from self._reboot()
            elif refusal == protocol.DENIED:
                yield from self._reset()
        if refusal:
            raise DeviceError(
                f"{command} refused: {status_text(refusal)}"
                + (f"; it says: {self.fault}" if self.fault else "")
            )
        raise TransportError(f"no answer to {ATTEMPTS} times {command}")

    def _understood(self, command: str, parse: Callable[[dict[str, str]], T]) -> Dialogue[T]:
        """Repeat the request until the lines can be read. Raises ProtocolError where they never can."""
        for attempt in range(ATTEMPTS):
            reply = yield from self._accepted(command, (protocol.OK,))
            try:
                return parse(protocol.read_info(reply))
            except ProtocolError:
                self.counters["answers_unusable"] += 1
                if attempt == ATTEMPTS - 1:
                    raise
        raise AssertionError("unreachable")

    def _warm_up(self) -> Dialogue[None]:
        """After power-on the device reports 0M until its motor turns evenly."""
        self.phase = "warming up"
        self.counters["warm_up_pauses"] += 1
        if self.counters["warm_up_pauses"] > WARM_UP_PAUSES:
            raise DeviceError(
                f"unstable (status 0M) for {WARM_UP_PAUSES * WARM_UP_PAUSE_S:.0f} s; does the motor turn, "
                "is the supply 12 V and 1 A?"
            )
        yield Pause(WARM_UP_PAUSE_S)

    def _reset(self) -> Dialogue[None]:
        """Leaves a state that no other command ends; the device's clock starts again."""
        self.counters["resets"] += 1
        yield from self._ask("RS", RESET_TIMEOUT_S)
        yield from self._ask("QT")
        self.time_samples.clear()

    def _reboot(self) -> Dialogue[None]:
        """All that an abnormal device accepts. Ends the connection: it is gone for seconds anyway."""
        self.phase = "abnormal; rebooting it"
        yield from self._look_at_state()
        for _ in range(2):  # the first is answered 01, the second within a second 00
            yield from self._ask("RB")
        raise DeviceError(
            "abnormal state (status 0L)" + (f", it says: {self.fault}" if self.fault else "") + "; it was "
            "rebooted; if this comes again cut its power, then have it repaired"
        )

    def _ask(self, command: str, timeout_s: float = ANSWER_TIMEOUT_S) -> Dialogue[protocol.Reply | None]:
        answer = yield Ask(command, timeout_s)
        if answer is None:
            self.counters["requests_unanswered"] += 1
            return None
        return answer.reply


def status_text(status: str) -> str:
    return f"{protocol.GENERAL_STATUS.get(status, 'not in the specification')} (status {status})"
