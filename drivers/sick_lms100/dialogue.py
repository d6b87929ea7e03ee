"""Start-up dialogue of a SICK scanner of models.py, and its polling while it streams. No I/O, no clock.

Boot: the port is open before anything answers, the first write after power-up is refused with error 4, and
a new scan rate or angle step costs some 30 s without data. Hence: repeat until answered, change only what
differs, read back. Sources: an LMS111's start-up recorded in SICKAG/sick_scan_xd; clearpathrobotics/LMS1xx
issues 11, 21, 51; SICKAG/sick_scan issue 44; SICKAG/sick_scan_xd issues 35, 70, 503.

A setting that the device refuses or does not keep is no fault where scans come: each scan states its own
rate, step and angles. `refusals` names it.
"""

from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from drivers.device_text import one_line
from drivers.dialogue import Pause
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.models import mismatch
from drivers.sick_lms100.protocol import Dialect, Reader, Telegram, Writer, reader, refusal_text, writer
from drivers.sick_lms100.telegrams import (
    CONTAMINATION,
    SCAN_CONFIG_ERRORS,
    STATE_READY,
    STATES,
    DeviceStatus,
    OutputRange,
    ScanConfig,
    ScanDataConfig,
)

# A named source has the same waiting time; CPR is clearpathrobotics/LMS1xx, SXD is
# SICKAG/sick_scan_xd (sick_scan_common.h and .cpp), the rest is our own choice, with its reason.
ANSWER_TIMEOUT_S = 1.0  # CPR repeats it each second; the recorded answers take 1 to 3 ms, the slowest 14 ms
CHANGE_TIMEOUT_S = 5.0  # SXD, READ_TIMEOUT_MILLISEC_DEFAULT
PROBE_ROUNDS = 10  # of both dialects, 20 s; then a new connection, the old one may be a leftover of the boot
LOGIN_ATTEMPTS = 30  # of ANSWER_TIMEOUT_S: a boot takes tens of seconds (CPR issue 11), then as PROBE_ROUNDS
CHANGE_ATTEMPTS = 5  # a booting device refuses the first (SICKAG/sick_scan issue 44)
CHANGE_PAUSE_S = 2.0  # so what cannot be done at present is retried for 8 s
PASSING_REFUSALS = (0x4, 0xD)  # not allowed now, busy; the others are requested twice, once with a new login
START_ATTEMPTS = 30  # of CHANGE_PAUSE_S: a minute, as long as one refuses after a lost client (SXD, README)
READ_BACK_ATTEMPTS = 45  # SXD, so many polls, one a second
READY_POLLS = 150  # one a second: SXD, READ_TIMEOUT_MILLISEC_KILL_NODE
RESTART_AT_POLLS = (60, 105)  # at 25 Hz more than 44 s, or a second Run, were needed (SXD issue 503)
SUBSCRIBE_ATTEMPTS = 5  # as CHANGE_ATTEMPTS
WATCH_PERIOD_S = 10.0  # contamination and temperature change slowly, and a request takes the device's time
UNANSWERED_LIMIT = 3  # then this request is not repeated: SXD's test_server.py never answers it
ACCESS_LEVEL = 3
ECHO_FILTERS = {"first": 0, "last": 2}  # 1: all, of which DIST1 is the first

DIALECTS = {"cola_a": Dialect.ASCII, "cola_b": Dialect.BINARY}
ANSWERS = ("sRA", "sWA", "sAN", "sEA")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Ask:
    request: Telegram
    timeout_s: float


Dialogue = Generator[Ask | Pause, Telegram | None, T]
Change = tuple[str, Callable[[], Dialogue[None]]]  # what it sets, as text, and how


class Lms100Dialogue:
    """Dialogue of one connection: `run` is the generator, the attributes are its results."""

    def __init__(self, config: Lms100Config) -> None:
        self._config = config
        self._limits = config.limits
        self.dialect: Dialect | None = DIALECTS.get(config.dialect)
        self.counters: Counter[str] = Counter()
        self.identity: dict[str, str] = {}
        self.phase = "connecting"
        self.subscribed = False
        self.scans_seen = 0  # kept by the session
        self.scan_interval = 1  # every n-th scan is sent
        self.refusals: list[str] = []  # refused settings, as text
        self.fault = ""  # faults that the device reports, "" for none

    def run(self) -> Dialogue[None]:
        """Raises TransportError where nothing answers, DeviceError where the device sends no scans."""
        yield from self._find_dialect()
        yield from self._identify()
        changes = yield from self._differences()
        measuring = yield from self._is_measuring()
        if changes or not measuring:
            yield from self._set_up(changes, measuring)
        yield from self._subscribe()
        yield from self._watch()

    def _find_dialect(self) -> Dialogue[None]:
        self.phase = "no answer yet: booting, or refusing for a minute after a lost connection"
        first = Dialect.BINARY if self._config.port == 2112 else Dialect.ASCII
        second = Dialect.ASCII if first is Dialect.BINARY else Dialect.BINARY
        candidates = (first, second) if self.dialect is None else (self.dialect,)
        for _ in range(PROBE_ROUNDS):
            for candidate in candidates:
                answer = yield Ask(Telegram(candidate, "sRN", "SCdevicestate"), ANSWER_TIMEOUT_S)
                if answer is not None:
                    self.dialect = answer.dialect
                    self.identity["dialect"] = answer.dialect.value
                    return
        requested = " or ".join(candidate.value for candidate in candidates)
        raise TransportError(
            f"connected, but no answer in {requested} after {PROBE_ROUNDS * len(candidates)} requests; "
            "is it still booting, or is another host connected to this port?"
        )

    def _identify(self) -> Dialogue[None]:
        self.phase = "reading identity"
        for key, name in (
            ("device", "DeviceIdent"),
            ("firmware", "FirmwareVersion"),
            ("serial", "SerialNumber"),
        ):
            text = yield from self._read(name, lambda r: one_line(r.text()))
            if text:
                self.identity[key] = text
        if words := mismatch(self.identity.get("device", ""), self._config.model):
            raise DeviceError(f"{words}; is host {self._config.host} the right scanner?")

    def _is_measuring(self) -> Dialogue[bool]:
        status = yield from self._read("STlms", DeviceStatus.read)
        return status is not None and status.state == STATE_READY

    def _set_up(self, changes: list[Change], measuring: bool) -> Dialogue[None]:
        """Make the changes that it takes, and have it measure. Raises DeviceError where it does not measure
        and cannot be made to."""
        try:
            yield from self._log_in()
        except DeviceError as error:
            if not measuring:
                raise
            self._note_refusal(" and ".join(name for name, _ in changes), error)
            return
        for name, change in changes:
            try:
                yield from change()
            except DeviceError as error:
                self._note_refusal(name, error)
        yield from self._start_measuring()
        yield from self._wait_until_measuring()

    def _note_refusal(self, setting: str, error: DeviceError) -> None:
        self.refusals.append(f"configured {setting} not taken: {str(error).replace('; ', ', ')}")

    def _differences(self) -> Dialogue[list[Change]]:
        """The changes to be made, in the order to make them. What cannot be read is taken to be right,
        but for the layout of the scan telegram, which is cheap to write."""
        self.phase = "reading configuration"
        changes: list[Change] = []
        if not self._limits.scan_is_fixed:
            scan = yield from self._read("LMPscancfg", ScanConfig.read)
            if scan is not None and not scan.agrees(self.scan_config):
                changes.append((self.scan_config.words, self._change_scan_config))
        fields = yield from self._read("LMPoutputRange", OutputRange.read)
        if fields is not None and not fields.agrees(self.output_range):
            change = (f"field of view {self.output_range.words}", self._change_output_range)
            changes.insert(0 if self._limits.output_range_first else len(changes), change)
        if self._limits.echoes == "filter":
            echo = yield from self._read("FREchoFilter", lambda r: r.u8())
            if echo not in (None, ECHO_FILTERS[self._config.echo]):
                changes.append((f"echo {self._config.echo}", self._change_echo))
        layout = yield from self._read_scan_data()
        if layout != self.scan_data_config:
            changes.append((self.scan_data_config.words, self._change_scan_data))
        return changes

    def _read_scan_data(self) -> Dialogue[ScanDataConfig | None]:
        layout = yield from self._read("LMDscandatacfg", ScanDataConfig.read)
        if layout is not None:
            self.scan_interval = max(layout.interval, 1)
        return layout

    @property
    def scan_config(self) -> ScanConfig:
        """The configured scan rate and angle step, in device units."""
        step_e4deg = round(self._config.angle_step_deg * 10_000)
        limits = self._limits
        return ScanConfig(self._config.scan_rate_hz * 100, step_e4deg, limits.first_e4deg, limits.last_e4deg)

    @property
    def output_range(self) -> OutputRange:
        """The configured field of view, in device units: device angle is sensor angle + 90 deg."""
        return OutputRange(
            round((self._config.first_angle_deg + 90.0) * 10_000),
            round((self._config.last_angle_deg + 90.0) * 10_000),
            self._limits.output_step_e4deg or self.scan_config.step_e4deg,
        )

    @property
    def scan_data_config(self) -> ScanDataConfig:
        bits = self._config.intensity_bits
        both = self._config.echo == "last" and self._limits.echoes == "channels"
        return ScanDataConfig(3 if both else 1, bits > 0, bits == 16)

    def _log_in(self) -> Dialogue[None]:
        self.phase = "logging in"

        def level_and_password(w: Writer) -> None:
            w.u8(ACCESS_LEVEL)
            w.u32(int(self._config.password_hash, 16))

        refusals = 0
        for _ in range(LOGIN_ATTEMPTS):
            answer = yield from self._ask("sMN", "SetAccessMode", level_and_password)
            if answer is None:
                continue
            if answer.kind == "sFA":  # of the request, not of the password
                refusals += 1
                if refusals == CHANGE_ATTEMPTS:
                    raise DeviceError(
                        f"SetAccessMode refused {refusals} times: {_refusal(answer)}; is it still booting, "
                        "does another host, SOPAS ET say, hold it? cut its power once"
                    )
                yield Pause(CHANGE_PAUSE_S)
                continue
            if _first_number(answer) == 0:
                raise DeviceError(
                    f"login as authorised client refused (hash {self._config.password_hash}); "
                    "has the password been changed? Set password_hash"
                )
            return
        raise TransportError(f"no answer to {LOGIN_ATTEMPTS} logins; is the device still booting?")

    def _change_scan_config(self) -> Dialogue[None]:
        wanted = self.scan_config
        self.phase = "changing scan rate and angle step, about 30 s"
        answer = yield from self._change("sMN", "mLMPsetscancfg", wanted.write)
        code = None if answer is None else _first_number(answer)
        if code:
            raise DeviceError(f"mLMPsetscancfg refused: {SCAN_CONFIG_ERRORS.get(code, f'status {code}')}")
        unreadable = 0
        found = None
        for _ in range(READ_BACK_ATTEMPTS):
            scan = yield from self._read("LMPscancfg", ScanConfig.read)
            if scan is None:
                unreadable += 1
            elif scan.agrees(wanted):
                return
            found = scan or found
            if found is None and unreadable >= UNANSWERED_LIMIT:
                return  # scans will show what it does
            yield Pause(1.0)
        has = "cannot be read" if found is None else f"has {found.words}"
        raise DeviceError(f"{READ_BACK_ATTEMPTS} s after mLMPsetscancfg was accepted it {has}")

    def _change_output_range(self) -> Dialogue[None]:
        self.phase = "changing field of view"
        wanted = self.output_range
        yield from self._change("sWN", "LMPoutputRange", wanted.write)
        found = yield from self._read("LMPoutputRange", OutputRange.read)
        if found is not None and not found.agrees(wanted):
            raise DeviceError(f"after LMPoutputRange was accepted it has {found.words}")
        if self._limits.output_range_first:  # it counts once the device was logged out of
            yield from self._ask("sMN", "Run", timeout_s=CHANGE_TIMEOUT_S)
            yield from self._log_in()

    def _change_echo(self) -> Dialogue[None]:
        self.phase = "choosing echo and intensity"
        wanted = ECHO_FILTERS[self._config.echo]
        yield from self._change("sWN", "FREchoFilter", lambda w: w.u8(wanted))
        found = yield from self._read("FREchoFilter", lambda r: r.u8())
        if found not in (None, wanted):
            raise DeviceError(f"after FREchoFilter {wanted} was accepted it has {found}")

    def _change_scan_data(self) -> Dialogue[None]:
        self.phase = "choosing echo and intensity"
        wanted = self.scan_data_config
        yield from self._change("sWN", "LMDscandatacfg", wanted.write)
        found = yield from self._read_scan_data()
        if found is not None and found != wanted:
            raise DeviceError(f"after LMDscandatacfg was accepted it has {found.words}")

    def _change(self, kind: str, name: str, write: Callable[[Writer], None]) -> Dialogue[Telegram | None]:
        """Request a change until it is accepted; None where nothing answered. Raises DeviceError."""
        refusal, lasting = None, 0
        for attempt in range(CHANGE_ATTEMPTS):
            if attempt:
                if not lasting:
                    yield Pause(CHANGE_PAUSE_S)
                yield from self._log_in()  # a login during boot may have been forgotten
            answer = yield from self._ask(kind, name, write, CHANGE_TIMEOUT_S)
            if answer is not None and answer.kind != "sFA":
                return answer
            refusal = answer or refusal
            lasting += answer is not None and _first_number(answer, 16) not in PASSING_REFUSALS
            if lasting == 2:
                break
        if refusal is None:
            return None
        raise DeviceError(f"{name} refused {attempt + 1} times: {_refusal(refusal)}")

    def _start_measuring(self) -> Dialogue[None]:
        self.phase = "starting the laser"
        for _ in range(START_ATTEMPTS):
            answer = yield from self._ask("sMN", "LMCstartmeas", timeout_s=CHANGE_TIMEOUT_S)
            if answer is None or (answer.kind != "sFA" and not _first_number(answer)):
                break  # STlms and the scans show whether it runs
            self.counters["starts_refused"] += 1
            if (yield from self._is_measuring()):
                break
            yield Pause(CHANGE_PAUSE_S)
        yield from self._ask("sMN", "Run", timeout_s=CHANGE_TIMEOUT_S)  # logs out and applies the parameters

    def _wait_until_measuring(self) -> Dialogue[None]:
        unreadable, state = 0, "unknown"
        for poll in range(READY_POLLS):
            status = yield from self._read("STlms", DeviceStatus.read)
            if status is None:
                unreadable += 1
                if unreadable >= UNANSWERED_LIMIT:
                    return
            else:
                if status.state == STATE_READY:
                    return
                state = f"{status.state} ({STATES.get(status.state, 'not in the listing')})"
                self.phase = f"waiting for the laser: state {state}"
            if poll in RESTART_AT_POLLS:
                yield from self._log_in()
                yield from self._start_measuring()
            yield Pause(1.0)
        raise DeviceError(
            f"still in state {state} {READY_POLLS} s after the start, expected 7 (measuring); see its LEDs"
        )

    def _subscribe(self) -> Dialogue[None]:
        self.phase = "asking for scans"
        answer = None
        for _ in range(SUBSCRIBE_ATTEMPTS):
            before = self.scans_seen
            answer = yield from self._ask("sEN", "LMDscandata", lambda w: w.u8(1), 2.0 * ANSWER_TIMEOUT_S)
            if self.scans_seen > before or (answer is not None and answer.kind != "sFA"):
                self.subscribed = True
                self.phase = "waiting for the first scan"
                return
            yield Pause(ANSWER_TIMEOUT_S)
        if answer is None:
            raise TransportError(f"no answer to {SUBSCRIBE_ATTEMPTS} times sEN LMDscandata")
        raise DeviceError(f"sEN LMDscandata refused: {_refusal(answer)}")

    def _watch(self) -> Dialogue[None]:
        """Poll state and contamination every WATCH_PERIOD_S; ends where the device answers neither."""
        silent: Counter[str] = Counter()
        while min(silent["STlms"], silent["LCMstate"]) < UNANSWERED_LIMIT:
            faults = []
            if silent["STlms"] < UNANSWERED_LIMIT:
                status = yield from self._read("STlms", DeviceStatus.read)
                silent["STlms"] = silent["STlms"] + 1 if status is None else 0
                if status is not None and status.state != STATE_READY:
                    faults.append(f"state {status.state} ({STATES.get(status.state, 'not in the listing')})")
                if status is not None and status.too_hot_or_cold:
                    self.counters["polls_temperature_fault"] += 1
                    faults.append("temperature out of range")
            if silent["LCMstate"] < UNANSWERED_LIMIT:
                contamination = yield from self._read("LCMstate", lambda r: r.u8())
                silent["LCMstate"] = silent["LCMstate"] + 1 if contamination is None else 0
                if contamination:
                    self.counters["polls_contaminated"] += 1
                    faults.append(CONTAMINATION.get(contamination, f"contamination {contamination}"))
            self.fault = ", ".join(faults)
            yield Pause(WATCH_PERIOD_S)

    def _read(self, name: str, parse: Callable[[Reader], T]) -> Dialogue[T | None]:
        """The variable's value, or None where it is not answered, refused, or answered wrongly."""
        answer = yield from self._ask("sRN", name)
        if answer is None or answer.kind == "sFA":
            return None
        try:
            if answer.kind == "sRA":
                return parse(reader(answer))
        except ProtocolError:
            pass
        self.counters["answers_unusable"] += 1
        return None

    def _ask(
        self,
        kind: str,
        name: str,
        write: Callable[[Writer], None] | None = None,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> Dialogue[Telegram | None]:
        assert self.dialect is not None
        body = None
        if write is not None:
            w = writer(self.dialect)
            write(w)
            body = w.body
        answer = yield Ask(Telegram(self.dialect, kind, name, body), timeout_s)
        if answer is None:
            self.counters["requests_unanswered"] += 1
        elif answer.kind == "sFA":
            self.counters["requests_refused"] += 1
        return answer


def _first_number(answer: Telegram, bits: int = 8) -> int | None:
    """The status most answers begin with; None where the answer is empty, as older manuals show it."""
    try:
        r = reader(answer)
        return r.u8() if bits == 8 else r.u16()
    except ProtocolError:
        return None


def _refusal(answer: Telegram) -> str:
    try:
        return refusal_text(answer)
    except ProtocolError:
        return f"error {(answer.body or b'')[:20]!r}"
