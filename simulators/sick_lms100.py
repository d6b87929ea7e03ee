"""A fake SICK scanner of drivers.sick_lms100.models. No I/O.

It answers the requests of third-party clients at their start-up (libLMS1xx, Clearpath's LMS1xx, MRPT,
sick_scan_xd) in the order and form they need, and reproduces the behaviour of real ones: a port open before
anything answers, one dialect and no answer in the other, a login, no scans for half a minute after a new
scan rate, an error flag on the first scans, a motor that turns a little slower than it states, a clock that
drifts and wraps.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from drivers.errors import ProtocolError
from drivers.sick_lms100.models import MODELS
from drivers.sick_lms100.protocol import (
    STX,
    Decoder,
    Dialect,
    Reader,
    Telegram,
    Writer,
    encode,
    reader,
    writer,
)
from drivers.sick_lms100.telegrams import (
    FULL_TURN_E4DEG,
    Calendar,
    DeviceStatus,
    OutputRange,
    ScanConfig,
    ScanDataConfig,
    ScanTelegram,
    exact_step_deg,
    write_calendar,
    write_scan,
)
from simulators.device import TURNS_SKIPPED, Beams, SweepSource, turns_to_skip
from simulators.sick_optics import channels_of
from simulators.sick_setup import TRAITS, Lms100Setup

LEAVES_AFTER_SWEEP_NS = 300_000
ZERO_TO_SENDING_NS = 3_107_000  # mean of 175 scans of a recorded LMS111, 3.07 to 3.27 ms
SENDING_JITTER_NS = 60_000
SCAN_COUNTER_AT_START = 4
FLAGGED_SCANS = 7
CALENDAR_LAG_NS = 3_850_000_000  # the calendar starts this long after the microsecond counter
DEVICE_NAME = "not defined"
PASSWORDS = {2: 0xB21ACE26, 3: 0xF4724744, 4: 0x81BE23AA}
STATE_BOOTING, STATE_IDLE, STATE_SPINNING_UP, STATE_STANDBY, STATE_MEASURING = 1, 3, 4, 6, 7

ACCESS_DENIED, UNKNOWN_METHOD, UNKNOWN_VARIABLE, NOT_NOW = 0x1, 0x2, 0x3, 0x4
TOO_FEW_PARAMETERS, WRITE_DENIED, UNKNOWN_COMMAND, UNKNOWN_EVENT = 0x8, 0xA, 0xC, 0xF

EVENTS = ("LMDscandata", "LIDoutputstate", "LIDinputstate", "LFErec")
SETTINGS = (
    *("LMPoutputRange", "LMDscandatacfg", "EIHstCola"),
    *("LCMcfg", "LFPparticle", "LFPmeanfilter", "LFPmedianfilter", "LFPnto1filter"),
    *("LICencset", "LICsrc", "LICencres", "LocationName", "EIIpAddr", "EImask", "Elgate"),
    *("TSCRole", "TSCTCInterface", "TSCTCSrvAddr", "TSCTCtimezone", "TSCTCupdatetime"),
)


class FakeLms100:
    """One device with room for one client. Set `contamination` (0 to 3) and `failed` while it runs."""

    def __init__(self, source: SweepSource, setup: Lms100Setup | None = None, seed: int = 0) -> None:
        self.setup = setup or Lms100Setup()
        self._model, self._traits = MODELS[self.setup.model], TRAITS[self.setup.model]
        self._own_settings = ("FREchoFilter",) if self._model.echoes == "filter" else ()
        self._reach_m = self.setup.reach_m or self._traits.reach_m
        self.contamination = 0
        self.failed = False
        self.counters: Counter[str] = Counter()
        self._source = source
        self._jitter = np.random.default_rng(seed)
        self._take_factory_settings()
        self._decoder = Decoder()
        self._powered_on_ns: int | None = None
        self._clock_ahead_us = 0
        self._boots_until_ns = 0
        self._turning_since_ns: int | None = None  # first beam of scan 0; None: not measuring
        self._standby = False
        self._telegram_base = 0xC1C3
        self._next_scan = 0
        self._last_scan: ScanTelegram | None = None
        self._subscribed: set[str] = set()
        self._logged_in = False
        self._pending: deque[bytes] = deque()
        self._output_changes = 0

    def _take_factory_settings(self) -> None:
        model = self._model
        self._scan = self.setup.scan or self._scan_config(
            model.rates_hz[0] * 100, round(model.steps_deg[0] * 1e4)
        )
        self.range = self.setup.output_range or OutputRange(model.first_e4deg, model.last_e4deg)
        self.echo_filter = self.setup.echo_filter
        self.scan_data = self.setup.scan_data
        self._dialect = self._next_dialect = self.setup.dialect
        self._writes_to_refuse = self.setup.first_writes_refused

    def _scan_config(self, frequency_chz: int, step_e4deg: int) -> ScanConfig:
        return ScanConfig(frequency_chz, step_e4deg, self._model.first_e4deg, self._model.last_e4deg)

    def connected(self, now_ns: int) -> bytes:
        self._forget_client()
        self._decoder = Decoder()
        self._dialect = self._next_dialect
        if self._powered_on_ns is None:
            self._power_on(now_ns)
            if self.setup.measuring:
                self._turn_from(self._boots_until_ns)
        return b""

    def disconnected(self, now_ns: int) -> None:
        self._forget_client()

    def _forget_client(self) -> None:
        self._subscribed.clear()
        self._pending.clear()
        self._logged_in = False

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        answers = b""
        try:
            telegrams = self._decoder.receive_data(data)
        except ProtocolError:
            self.counters["garbage"] += 1
            return b""
        for telegram in telegrams:
            if telegram.dialect is not self._dialect:
                self.counters["requests_in_other_dialect"] += 1
            elif now_ns < self._boots_until_ns:
                self.counters["requests_while_deaf"] += 1
            else:
                answers += encode(self._answer(telegram, now_ns))
        return answers

    def next_due_ns(self, now_ns: int) -> int | None:
        if self._pending:
            return now_ns
        if "LMDscandata" not in self._subscribed or self._turning_since_ns is None:
            return None
        return self._leaves_ns(self._next_scan)

    def due(self, now_ns: int) -> bytes:
        if self._pending:
            return self._pending.popleft()
        due_ns = self.next_due_ns(now_ns)
        if due_ns is None or due_ns > now_ns:
            return b""
        skipped = turns_to_skip(now_ns - due_ns, self._period_ns())
        if skipped:
            self.counters[TURNS_SKIPPED] += skipped
            self._telegram_base -= skipped
            self._next_scan += skipped
        scan = self._measure(self._next_scan)
        self._next_scan += self.scan_data.interval
        self.counters["scans_sent"] += 1
        if self._next_scan == FLAGGED_SCANS and "LIDoutputstate" in self._subscribed:
            self._output_changes += 1
            self._pending.append(self._output_event(now_ns))
        return encode(write_scan(scan, self._dialect))

    def state(self, now_ns: int) -> int:
        """Content of STlms."""
        if now_ns < self._boots_until_ns:
            return STATE_BOOTING
        if self._turning_since_ns is None:
            return STATE_STANDBY if self._standby else STATE_IDLE
        return STATE_MEASURING if now_ns >= self._turning_since_ns else STATE_SPINNING_UP

    def restart(self, now_ns: int) -> None:
        """Off and on again. It has no flash: its settings are those of the factory."""
        self._forget_client()
        self._decoder = Decoder()
        self._take_factory_settings()
        self._power_on(now_ns)
        self._turning_since_ns, self._next_scan, self._last_scan = None, 0, None
        if self.setup.measuring:
            self._turn_from(self._boots_until_ns + self.setup.start_delay_ns)
        self._telegram_base = self._output_changes = 0

    def jump_clock(self, seconds: float) -> None:
        self._clock_ahead_us += round(seconds * 1e6)

    def spoil_checksum(self, message: bytes) -> bytes:
        """CoLa-A has none."""
        binary = message.startswith(4 * STX)
        return message[:-1] + bytes([message[-1] ^ 0xFF]) if binary else message

    def _power_on(self, now_ns: int) -> None:
        self._powered_on_ns = now_ns
        self._clock_ahead_us = 0
        self._boots_until_ns = now_ns + self.setup.boot_ns

    def _turn_from(self, since_ns: int) -> None:
        """Measure again: scan numbers start over, telegram numbers go on."""
        self._telegram_base += self._next_scan
        self._turning_since_ns = since_ns
        self._standby = False
        self._next_scan = 0

    def _period_ns(self) -> float:
        return 1e11 / self._scan.frequency_chz / self.setup.motor_speed

    def _first_beam_ns(self, index: int) -> int:
        """When scan `index` passes the angle at which a sweep begins."""
        assert self._turning_since_ns is not None
        return self._turning_since_ns + round(index * self._period_ns())

    def _leaves_ns(self, index: int) -> int:
        """After the sweep; where the zero index comes before it, after the turn, as a recorded LMS511."""
        sweep_e4deg = self._model.last_e4deg - self._model.first_e4deg
        after_e4deg = sweep_e4deg if self._traits.zero_index_after_sweep else FULL_TURN_E4DEG
        sweep_ns = self._period_ns() * after_e4deg / FULL_TURN_E4DEG
        return self._first_beam_ns(index) + round(sweep_ns) + LEAVES_AFTER_SWEEP_NS

    def _scans_complete(self, now_ns: int) -> int:
        """How many scans have been measured since the start."""
        if self._turning_since_ns is None or now_ns < self._leaves_ns(0):
            return 0
        return int((now_ns - self._leaves_ns(0)) / self._period_ns()) + 1

    def _clock_us(self, host_ns: int) -> int:
        assert self._powered_on_ns is not None
        since_us = (host_ns - self._powered_on_ns) * (1.0 + self.setup.clock_drift_ppm * 1e-6) / 1000.0
        return (self.setup.clock_start_us + self._clock_ahead_us + round(since_us)) % (1 << 32)

    def _calendar(self, host_ns: int) -> Calendar:
        assert self._powered_on_ns is not None
        since_us = (host_ns - self._powered_on_ns - CALENDAR_LAG_NS) // 1000 + self._clock_ahead_us
        t = datetime(1970, 1, 1) + timedelta(microseconds=max(0, since_us))
        return Calendar(t.year, t.month, t.day, t.hour, t.minute, t.second, t.microsecond // 1000 * 1000)

    def _measure(self, index: int) -> ScanTelegram:
        """Cast the rays of one scan and write them into a telegram."""
        begins_ns, leaves_ns = self._first_beam_ns(index), self._leaves_ns(index)
        step_e4deg, first_e4deg = self._scan.step_e4deg, self.range.first_e4deg
        beam_count = (self.range.last_e4deg - first_e4deg + step_e4deg // 2) // step_e4deg + 1
        beam_interval_ns = self._period_ns() * step_e4deg / FULL_TURN_E4DEG
        first_ray_ns = begins_ns + round(
            self._period_ns() * (first_e4deg - self._model.first_e4deg) / FULL_TURN_E4DEG
        )
        beams = Beams(
            first_ray_ns,
            round(beam_interval_ns),
            float(np.radians(first_e4deg / 10_000 - 90.0)),
            float(np.radians(exact_step_deg(step_e4deg))),
            beam_count,
        )
        sweep = self._source.sweep(beams)
        after_sweep = self.setup.zero_index_after_sweep
        after_sweep = self._traits.zero_index_after_sweep if after_sweep is None else after_sweep
        zero_ns = leaves_ns - ZERO_TO_SENDING_NS if after_sweep else begins_ns
        sent_ns = leaves_ns + round(self._jitter.uniform(-SENDING_JITTER_NS, SENDING_JITTER_NS))
        error = self.failed or index < FLAGGED_SCANS
        channels_16bit, channels_8bit = channels_of(
            sweep, self.scan_data, first_e4deg, step_e4deg, self.setup.scale, self._reach_m
        )
        number = self._telegram_base + index
        self._last_scan = ScanTelegram(
            serial_number=self.setup.serial_number,
            status=(int(error), {0: 0, 1: 2}.get(self.contamination, 5)),
            telegram_counter=number % 65_536,
            scan_counter=(SCAN_COUNTER_AT_START + index) % 65_536,
            start_us=self._clock_us(zero_ns),
            sent_us=self._clock_us(sent_ns),
            frequency_chz=self._scan.frequency_chz,
            shots_100hz=round(self._scan.frequency_chz * FULL_TURN_E4DEG / step_e4deg / 1e4),
            channels_16bit=channels_16bit,
            channels_8bit=channels_8bit,
            outputs=(1 if error else 4, 0),
            name=DEVICE_NAME if self.scan_data.name else None,
            comment="" if self.scan_data.comment else None,
            position=(0.0,) * 7 if self.scan_data.position else None,
            encoders=((0, 0),) if self.scan_data.encoder else (),
            time=self._calendar(begins_ns) if self.scan_data.time else None,
        )
        return self._last_scan

    def _answer(self, request: Telegram, now_ns: int) -> Telegram:
        self.counters["requests"] += 1
        handlers = {"sRN": self._read, "sWN": self._write, "sMN": self._call, "sEN": self._enable}
        handlers["sRI"] = self._read
        handler = handlers.get(request.kind)
        if handler is None:
            return self._refuse(UNKNOWN_COMMAND)
        try:
            return handler(request, now_ns)
        except ProtocolError:
            return self._refuse(TOO_FEW_PARAMETERS)

    def _refuse(self, code: int) -> Telegram:
        w = writer(self._dialect)
        w.u16(code)
        self.counters["requests_refused"] += 1
        return Telegram(self._dialect, "sFA", "", w.body)

    def _reply(self, kind: str, name: str, write: Callable[[Writer], None] | None = None) -> Telegram:
        w = writer(self._dialect)
        if write is not None:
            write(w)
        empty_ascii = write is None and self._dialect is Dialect.ASCII
        return Telegram(self._dialect, kind, name, None if empty_ascii else w.body)

    def _read(self, request: Telegram, now_ns: int) -> Telegram:
        name = request.name
        if name == "LMDscandata":
            complete = self._scans_complete(now_ns)
            if complete and "LMDscandata" not in self._subscribed:
                self._measure(complete - 1)
            if self._last_scan is None:
                return self._refuse(NOT_NOW)
            return write_scan(self._last_scan, self._dialect, "sRA")
        values = self._variables(now_ns)
        if name.startswith("field") and name[5:].isdigit() and int(name[5:]) < 30:
            return self._reply("sRA", name, lambda w: w.u8(0))
        return self._reply("sRA", name, values[name]) if name in values else self._refuse(UNKNOWN_VARIABLE)

    def _variables(self, now_ns: int) -> dict[str, Callable[[Writer], None]]:
        state = self.state(now_ns)
        calendar = self._calendar(now_ns)
        status = DeviceStatus(
            state,
            False,
            f"{calendar.hour:02}:{calendar.minute:02}:{calendar.second:02}",
            f"{calendar.day:02}.{calendar.month:02}.{calendar.year:04}",
        )

        def ident(w: Writer) -> None:
            w.text(self.setup.ident or self._traits.ident)
            w.text(self.setup.firmware)

        def inputs(w: Writer) -> None:
            w.u16(1)
            w.u32(0)
            w.u8(2, 2, 2, 2)
            w.u16(0)

        output_step_e4deg = self._model.output_step_e4deg or self._scan.step_e4deg
        return {name: lambda w: w.u8(self.echo_filter) for name in self._own_settings} | {
            "SCdevicestate": lambda w: w.u8(2 if self.failed else int(state == STATE_MEASURING)),
            "STlms": lambda w: status.write(w, self._dialect),
            "LMPscancfg": self._scan.write,
            "LMPoutputRange": replace(self.range, step_e4deg=output_step_e4deg).write,
            "LMDscandatacfg": self.scan_data.write,
            "DeviceIdent": ident,
            "0": ident,
            "FirmwareVersion": lambda w: w.text(self.setup.firmware + "  "),
            "SerialNumber": lambda w: w.text(str(self.setup.serial_number)),
            "LocationName": lambda w: w.text(DEVICE_NAME),
            "ODoprh": lambda w: w.u32(1110),
            "ODpwrc": lambda w: w.u32(63),
            "LCMstate": lambda w: w.u8(self.contamination),
            "EIHstCola": lambda w: w.u8(int(self._next_dialect is Dialect.BINARY)),
            "LIDinputstate": inputs,
            "LIDoutputstate": lambda w: self._write_outputs(w, now_ns),
        }

    def _write_outputs(self, w: Writer, now_ns: int) -> None:
        """The LMS1xx's layout: 3 outputs of its own, 8 absent ones."""
        w.u16(1)
        w.u32(self._clock_us(now_ns))
        for state, changes in ((0, 0), (0, 0), (1, self._output_changes), *((2, 0),) * 8):
            w.u8(state)
            w.u32(changes)
        write_calendar(w, self._calendar(now_ns))

    def _output_event(self, now_ns: int) -> bytes:
        return encode(self._reply("sSN", "LIDoutputstate", lambda w: self._write_outputs(w, now_ns)))

    def _write(self, request: Telegram, now_ns: int) -> Telegram:
        name = request.name
        if name not in (*SETTINGS, *self._own_settings):
            return self._refuse(UNKNOWN_VARIABLE)
        if not self._logged_in or name in self.setup.refused:
            return self._refuse(WRITE_DENIED)
        if self._writes_to_refuse:
            self._writes_to_refuse -= 1
            return self._refuse(NOT_NOW)
        r = reader(request)
        if name == "LMPoutputRange":
            wanted = OutputRange.read(r)
            first_e4deg, last_e4deg = self._model.first_e4deg - 100, self._model.last_e4deg + 100
            if not first_e4deg <= wanted.first_e4deg < wanted.last_e4deg <= last_e4deg:
                return self._refuse(NOT_NOW)
            self.range = self.range if name in self.setup.kept else wanted
        elif name == "LMDscandatacfg":
            layout = ScanDataConfig.read(r)
            if not 1 <= layout.echoes <= 3 or layout.interval < 1:
                return self._refuse(NOT_NOW)
            self.scan_data = self.scan_data if name in self.setup.kept else layout
        elif name == "FREchoFilter":
            self.echo_filter = self.echo_filter if name in self.setup.kept else r.u8()
        elif name == "EIHstCola":
            self._next_dialect = Dialect.BINARY if r.u8() else Dialect.ASCII
        return self._reply("sWA", name)

    def _call(self, request: Telegram, now_ns: int) -> Telegram:
        methods: dict[str, Callable[[Reader, int], Callable[[Writer], None]]] = {
            "SetAccessMode": self._set_access_mode,
            "mLMPsetscancfg": self._set_scan_config,
            "LMCstartmeas": self._start,
            "LMCstopmeas": self._stop,
            "LMCstandby": self._stand_by,
            "Run": self._run,
            "mEEwriteall": lambda r, _: lambda w: w.u8(1),
            "LSPsetdatetime": lambda r, _: lambda w: w.u8(1),
            "mDOSetOutput": lambda r, _: lambda w: w.u8(1),
            "mSCreboot": self._reboot,
        }
        method = methods.get(request.name)
        if method is None or (request.name == "mLMPsetscancfg" and self._model.scan_is_fixed):
            return self._refuse(UNKNOWN_METHOD)
        open_to_all = request.name in ("SetAccessMode", "Run", "mDOSetOutput")
        if request.name in self.setup.refused or not (self._logged_in or open_to_all):
            return self._refuse(ACCESS_DENIED)
        return self._reply("sAN", request.name, method(reader(request), now_ns))

    def _set_access_mode(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        level = r.u8()
        self._logged_in = PASSWORDS.get(level) == r.u32()
        return lambda w: w.u8(int(self._logged_in))

    def _set_scan_config(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        wanted = ScanConfig.read(r)
        pair = (wanted.frequency_chz, wanted.step_e4deg)
        rate_hz, step_deg = pair[0] / 100, pair[1] / 10_000
        has_step = step_deg in self._model.steps_deg and self._model.has_time_for(round(rate_hz), step_deg)
        status = 1 if rate_hz not in self._model.rates_hz else 0 if has_step else 2
        if status == 0 and "mLMPsetscancfg" not in self.setup.kept:
            changed = pair != (self._scan.frequency_chz, self._scan.step_e4deg)
            self._scan = wanted = self._scan_config(*pair)
            if changed:
                self.counters["scan_config_changes"] += 1
                if self._turning_since_ns is not None:
                    self._turn_from(now_ns + self.setup.reconfigure_delay_ns)

        def answer(w: Writer) -> None:
            w.u8(status)
            wanted.write(w)

        return answer

    def _start(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        if self._turning_since_ns is None:
            self._turn_from(now_ns + self.setup.start_delay_ns)
        elif now_ns >= self._turning_since_ns:
            self._turn_from(min(now_ns, self._first_beam_ns(self._scans_complete(now_ns))))
        self.counters["starts"] += 1
        return lambda w: w.u8(0)

    def _stop(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        self._telegram_base += self._next_scan
        self._turning_since_ns, self._next_scan = None, 0
        return lambda w: w.u8(0)

    def _stand_by(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        self._standby = True
        return self._stop(r, now_ns)

    def _run(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        self._logged_in = False
        if self._turning_since_ns is None:
            self._turn_from(now_ns + self.setup.start_delay_ns)
        return lambda w: w.u8(1)

    def _reboot(self, r: Reader, now_ns: int) -> Callable[[Writer], None]:
        self._power_on(now_ns)
        self._subscribed.clear()
        self._turn_from(self._boots_until_ns)
        return lambda w: w.u8(1)

    def _enable(self, request: Telegram, now_ns: int) -> Telegram:
        if request.name not in EVENTS:
            return self._refuse(UNKNOWN_EVENT)
        on = reader(request).u8() != 0
        if on:
            self._subscribed.add(request.name)
            if request.name == "LMDscandata":
                self._next_scan = max(self._next_scan, self._scans_complete(now_ns))
        else:
            self._subscribed.discard(request.name)
        return self._reply("sEA", request.name, lambda w: w.u8(int(on)))
