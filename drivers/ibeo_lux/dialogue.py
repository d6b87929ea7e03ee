"""Start-up dialogue of a LUX, and its polling while it streams. No I/O, no clock of its own.

Only what differs from the config is changed, with the scanner stopped, and read back; a change lasts until
the device loses power, its flash is not written. The start angle must stay above the end angle at all times,
so the order in which the two are set depends on where they stand. Old firmware refuses parameters it does not
know (SICKAG/sick_ldmrs_laser issue 1, SICKAG/sick_scan2 issue 15: 0x8011 to 0x1109). What is refused or not
kept is no fault where scans come and can be understood without it: `refusals` names it. Order and timeouts:
SICKAG/libsick_ldmrs, LD_MRS.cpp and LuxBase.cpp.
"""

from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from drivers.dialogue import Pause
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.messages import (
    SYNC_ANGLE_MASK,
    TICKS_PER_DEG,
    Command,
    DeviceStatus,
    Parameter,
    Reply,
    ScannerStatus,
    read_parameter,
    signed_16,
    write_ntp,
    write_ntp_part,
    write_parameter,
)
from drivers.ibeo_lux.protocol import ntp_from_unix_ns
from drivers.rates import same_rate

REPLY_TIMEOUT_S = 2.0  # SICK's library waits 0.5 to 2 s
FIRST_REPLY_TIMEOUT_S = 0.5  # while it may be booting, so that its return is not missed for long
STATUS_ATTEMPTS = 40
LISTENS, LISTEN_S = 10, 0.1  # a scanner that reports it runs sends by then, else it is started
LISTEN_AFTER = 6  # unanswered while scans come: take them as they are
CHANGE_ATTEMPTS = 3
CLOCK_ATTEMPTS = 3  # two commands within one second of the clock
START_ATTEMPTS = 3
START_POLLS, START_POLL_S = 150, 0.2  # while the mirror comes up to speed
WATCH_PERIOD_S = 10.0
UNANSWERED_LIMIT = 3  # then status is not requested again

OUTPUT_SCANS, OUTPUT_OBJECTS, OUTPUT_ERRORS = 0x0001, 0x0004, 0x0010  # a bit set switches off
OUTPUT_WANTED = 0xFFEE  # scans, errors and warnings, nothing else
RESOLUTIONS = {"focused": 0, "constant": 1}
RATE_UNIT = 256  # counts a Hz

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Ask:
    command: Command
    body: bytes
    timeout_s: float


Dialogue = Generator[Ask | Pause, Reply | None, T]


@dataclass(frozen=True, slots=True)
class Setting:
    """A parameter and its configured value. `agrees` compares with the value read, unsigned; `words` is
    such a number for people."""

    parameter: Parameter
    key: str  # in the config
    value: int
    agrees: Callable[[int], bool]
    words: Callable[[int], str]


class IbeoLuxDialogue:
    """Dialogue of one connection: `run` is the generator, the attributes are its results."""

    def __init__(self, config: IbeoLuxConfig, unix_ns: Callable[[], int]) -> None:
        self._config = config
        self._unix_ns = unix_ns
        self._unsupported: set[Parameter] = set()
        self.counters: Counter[str] = Counter()
        self.identity: dict[str, str] = {}
        self.phase = "waiting for the first answer: booting?"
        self.ready = False  # configured and started: scans from now on are as configured
        self.stopped = False  # by us
        self.scans_seen = 0  # kept by the session
        self.foreign = ""  # what other device seems to be there; kept by the session
        self.other_scans = ""  # rate and angles of the scans where they are not as configured; by the session
        self.refusals: list[str] = []  # refused settings, as text
        self.device_status: DeviceStatus | None = None  # the newest
        self.beam_tilt_rad = 0.0
        self.upside_down = False
        # What the device reported of itself, by the session.
        self.explain_faults: Callable[[], str] = lambda: ""

    def run(self) -> Dialogue[None]:
        """Raises TransportError where nothing answers, or only after the scans were used as they are;
        DeviceError where the device refuses.
        """
        answers = yield from self._identify()
        if answers:
            yield from self._configure()
            if self._config.set_clock:
                yield from self._set_clock()
            yield from self._start()
        self.ready = True
        self.phase = "waiting for the first scan"
        if not answers:
            yield from self._ask_until_answered()
        yield from self._watch()

    def _identify(self) -> Dialogue[bool]:
        """Whether the device answers commands; one that does not may still send scans."""
        unanswered = 0  # while scans came: it does not boot any more
        for _ in range(STATUS_ATTEMPTS):
            scans_came = self.scans_seen > 0
            status = yield from self._read_status(FIRST_REPLY_TIMEOUT_S)
            if status is not None:
                self.identity["firmware"] = status.firmware
                if status.serial:
                    self.identity["serial"] = status.serial
                return True
            unanswered += scans_came
            if unanswered >= LISTEN_AFTER:
                self.identity["commands"] = "not answered; taken as it is"
                return False
        if self.foreign:
            raise TransportError(f"no answer to Get status, but scans of {self.foreign}; wrong address?")
        raise TransportError(
            f"connected, but no answer to {STATUS_ATTEMPTS} times Get status and no scan; "
            "is it still booting, is this its port 12002, is another host connected to it?"
        )

    def _configure(self) -> Dialogue[None]:
        self.phase = "reading configuration"
        tilt = yield from self._read_parameter(Parameter.BEAM_TILT)
        self.beam_tilt_rad = signed_16(tilt or 0) / 10_000.0
        minutes = yield from self._read_parameter(Parameter.OPERATING_MINUTES)
        if minutes:
            self.identity["operating_hours"] = f"{minutes / 60:.0f}"
        changes = []
        for setting in self._settings():
            found = yield from self._read_parameter(setting.parameter)
            if found is None or not setting.agrees(found):
                changes.append((setting, found))
        if any(setting.parameter is not Parameter.DATA_OUTPUT for setting, _ in changes):
            self.phase = "changing configuration"
            yield from self._ask(Command.STOP)
            self.stopped = True
        for setting, found in _in_safe_order(changes):
            if reason := (yield from self._change(setting, found)):
                self._note_refusal(setting, reason)
        upside_down = yield from self._read_parameter(Parameter.UPSIDE_DOWN)
        self.upside_down = bool(upside_down)

    def _settings(self) -> list[Setting]:
        config = self._config
        rate = round(config.scan_rate_hz * RATE_UNIT)
        settings = [
            Setting(Parameter.DATA_OUTPUT, "output", OUTPUT_WANTED, _output_agrees, hex),
            Setting(
                Parameter.SCAN_FREQUENCY,
                "scan_rate_hz",
                rate,
                lambda found: same_rate(found, rate),
                _rate_words,
            ),
            _angle(Parameter.START_ANGLE, "first_angle_deg", config.first_ticks),
            _angle(Parameter.END_ANGLE, "last_angle_deg", config.last_ticks),
        ]
        if config.resolution != "as_set":
            wanted = RESOLUTIONS[config.resolution]
            settings.append(
                Setting(
                    Parameter.RESOLUTION,
                    "resolution",
                    wanted,
                    lambda found: found == wanted,
                    _resolution_words,
                )
            )
        if config.sync_angle_deg is not None:
            sync = round(config.sync_angle_deg * TICKS_PER_DEG)
            settings.append(
                Setting(
                    Parameter.SYNC_ANGLE,
                    "sync_angle_deg",
                    sync & SYNC_ANGLE_MASK,
                    lambda found: (found ^ sync) & SYNC_ANGLE_MASK == 0,
                    _sync_words,
                )
            )
        if config.upside_down is not None:
            flag = int(config.upside_down)
            settings.append(
                Setting(
                    Parameter.UPSIDE_DOWN,
                    "upside_down",
                    flag,
                    lambda found: bool(found) == bool(flag),
                    lambda found: "true" if found else "false",
                )
            )
        return settings

    def _note_refusal(self, setting: Setting, reason: str) -> None:
        """Raises DeviceError where scans would not come, or be wrong, without it."""
        words = f"configured {setting.key} {setting.words(setting.value)} not taken: {reason}"
        if setting.parameter is Parameter.UPSIDE_DOWN:
            raise DeviceError(
                f"{words}, so left and right of its scans would be exchanged; write upside_down: null, and "
                "mounting: {upside_down: true} where it hangs head down"
            )
        if setting.parameter is Parameter.DATA_OUTPUT:
            raise DeviceError(
                f"{words}, so it sends no scans; can its firmware ({self.identity['firmware']}) do it?"
            )
        self.refusals.append(words)

    def _change(self, setting: Setting, found: int | None) -> Dialogue[str]:
        """Set a parameter and read it back. Returns why the device did not take it, "" where it did."""
        if setting.parameter is Parameter.UPSIDE_DOWN and found is None and not setting.value:
            return ""  # a firmware without this mode has it off
        reply = None
        for _ in range(CHANGE_ATTEMPTS):
            reply = yield from self._ask(
                Command.SET_PARAMETER, write_parameter(setting.parameter, setting.value)
            )
            if reply is not None and not reply.refused:
                break
        if reply is None or reply.refused:
            if setting.parameter is Parameter.DATA_OUTPUT and self._scans_flow(found):
                self.counters["output_not_set"] += 1  # objects come along, or errors do not
                return ""
            how = "not answered" if reply is None else "refused"
            has = "" if found is None else f", it has {setting.words(found)}"
            return f"{how} {CHANGE_ATTEMPTS} times{has}"
        self.counters["parameters_changed"] += 1
        if setting.parameter in self._unsupported:
            return ""  # can be written, not read; scans will show it
        read = yield from self._read_parameter(setting.parameter)
        if setting.parameter is Parameter.DATA_OUTPUT and self._scans_flow(read):
            return ""
        if read is not None and not setting.agrees(read):
            return f"accepted, but it has {setting.words(read)}"
        return ""

    def _scans_flow(self, output: int | None) -> bool:
        """Whether scans come with this data_output; None: it cannot be read, then scans will show it."""
        return output is None or not output & OUTPUT_SCANS or self.scans_seen > 0

    def _set_clock(self) -> Dialogue[None]:
        """In one command where the firmware has it, else seconds and fraction, within one second."""
        self.phase = "setting the clock"
        now = ntp_from_unix_ns(self._unix_ns())
        reply = yield from self._ask(Command.SET_NTP, write_ntp(now))
        if reply is not None and not reply.refused:
            return
        for _ in range(CLOCK_ATTEMPTS):
            seconds = ntp_from_unix_ns(self._unix_ns()) >> 32
            reply = yield from self._ask(Command.SET_NTP_SECONDS, write_ntp_part(seconds))
            if reply is None or reply.refused:
                break
            now = ntp_from_unix_ns(self._unix_ns())
            yield from self._ask(Command.SET_NTP_FRACTION, write_ntp_part(now & 0xFFFF_FFFF))
            if now >> 32 == seconds:
                return
        self.counters["clock_not_set"] += 1
        self.refusals.append("configured set_clock not taken: its clock stays as it is, stamps are as good")

    def _start(self) -> Dialogue[None]:
        status = self.device_status
        running = ScannerStatus.MOTOR_ON | ScannerStatus.LASER_ON
        if not self.stopped and status is not None and status.status & running == running:
            for _ in range(LISTENS):
                if self.scans_seen:
                    return
                yield Pause(LISTEN_S)
        self.phase = "starting"
        reply = None
        for _ in range(START_ATTEMPTS):
            reply = yield from self._ask(Command.START)
            if reply is not None and not reply.refused:
                break
        if reply is not None and reply.refused:
            raise DeviceError(f"Start was refused {START_ATTEMPTS} times; {self._state_words()}")
        self.stopped = False
        yield from self._wait_until_turning()

    def _wait_until_turning(self) -> Dialogue[None]:
        before = self.scans_seen
        for _ in range(START_POLLS):
            status = yield from self._read_status()
            if self.scans_seen > before:
                return
            wanted = ScannerStatus.MOTOR_ON | ScannerStatus.LASER_ON | ScannerStatus.FREQUENCY_REACHED
            if status is not None and status.status & wanted == wanted:
                return
            self.phase = f"waiting for the mirror: {self._state_words()}"
            yield Pause(START_POLL_S)
        waited_s = START_POLLS * START_POLL_S
        raise DeviceError(
            f"no scan {waited_s:g} s after Start: {self._state_words()}; does the mirror turn, "
            "is it too hot or too cold?"
        )

    def _ask_until_answered(self) -> Dialogue[None]:
        """Request the status every WATCH_PERIOD_S: a device that was booting is set up later."""
        yield Pause(WATCH_PERIOD_S)
        while (yield from self._read_status()) is None:
            yield Pause(WATCH_PERIOD_S)
        self.identity.pop("commands")
        if self.other_scans:
            raise TransportError(
                f"scans come at {self.other_scans}, and the device answers commands now, which it did not do "
                "at the start; a new connection sets it up"
            )

    def _watch(self) -> Dialogue[None]:
        """Poll the status every WATCH_PERIOD_S; ends where the device no longer answers."""
        silent = 0
        while silent < UNANSWERED_LIMIT:
            yield Pause(WATCH_PERIOD_S)
            status = yield from self._read_status()
            silent = silent + 1 if status is None else 0

    def _state_words(self) -> str:
        """The newest status and what the device reported, to be shown."""
        parts = [] if self.device_status is None else status_faults(self.device_status.status)
        if faults := self.explain_faults():
            parts.append(f"it reports: {faults}")
        return ", ".join(parts) or "its status shows no fault"

    def _read_status(self, timeout_s: float = REPLY_TIMEOUT_S) -> Dialogue[DeviceStatus | None]:
        reply = yield from self._ask(Command.GET_STATUS, timeout_s=timeout_s)
        if reply is None or reply.refused:
            return None
        try:
            self.device_status = DeviceStatus.read(reply.body)
        except ProtocolError:
            self.counters["replies_unusable"] += 1
            return None
        return self.device_status

    def _read_parameter(self, parameter: Parameter) -> Dialogue[int | None]:
        """None where it is not answered or refused."""
        if parameter in self._unsupported:
            return None
        reply = yield from self._ask(Command.GET_PARAMETER, parameter.to_bytes(2, "little"))
        if reply is None:
            return None
        if reply.refused:
            self._unsupported.add(parameter)
            self.counters["parameters_not_supported"] += 1
            return None
        try:
            return read_parameter(reply.body)[1]
        except ProtocolError:
            self.counters["replies_unusable"] += 1
            return None

    def _ask(
        self, command: Command, body: bytes = b"", timeout_s: float = REPLY_TIMEOUT_S
    ) -> Dialogue[Reply | None]:
        reply = yield Ask(command, body, timeout_s)
        if reply is None:
            self.counters["requests_unanswered"] += 1
        elif reply.refused:
            self.counters["requests_refused"] += 1
        return reply


def status_faults(status: int) -> list[str]:
    """What the status lacks for scans, as text."""
    bits = (
        (ScannerStatus.MOTOR_ON, "motor off"),
        (ScannerStatus.LASER_ON, "laser off"),
        (ScannerStatus.FREQUENCY_REACHED, "scan frequency not reached"),
    )
    return [words for bit, words in bits if not status & bit]


def _angle(parameter: Parameter, key: str, ticks: int) -> Setting:
    return Setting(parameter, key, ticks, lambda found: signed_16(found) == ticks, _angle_words)


def _angle_words(value: int) -> str:
    return f"{signed_16(value) / TICKS_PER_DEG:g} deg"


def _rate_words(value: int) -> str:
    return f"{value / RATE_UNIT:.4g} Hz"


def _resolution_words(value: int) -> str:
    return next((name for name, number in RESOLUTIONS.items() if number == value), "by sectors (FlexRes)")


def _sync_words(value: int) -> str:
    turned = value & SYNC_ANGLE_MASK
    return (
        f"{(turned - SYNC_ANGLE_MASK - 1 if turned > SYNC_ANGLE_MASK // 2 else turned) / TICKS_PER_DEG:g} deg"
    )


def _output_agrees(found: int) -> bool:
    return not found & (OUTPUT_SCANS | OUTPUT_ERRORS) and bool(found & OUTPUT_OBJECTS)


def _in_safe_order(changes: list[tuple[Setting, int | None]]) -> list[tuple[Setting, int | None]]:
    """The end angle before the start angle where the new start lies at or below the present end.

    Moving the start first is safe while it stays above the present end. Else the new end, which lies below
    the new start, lies below the present start as well.
    """
    by_parameter = {setting.parameter: (setting, found) for setting, found in changes}
    start, end = by_parameter.get(Parameter.START_ANGLE), by_parameter.get(Parameter.END_ANGLE)
    if start is None or end is None or end[1] is None or start[0].value > signed_16(end[1]):
        return changes
    others = [change for change in changes if change not in (start, end)]
    return [*others, end, start]
