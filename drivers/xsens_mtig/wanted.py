"""Output to request from the device: as much of the usable data as its line carries. No I/O."""

from dataclasses import dataclass

from drivers.errors import DeviceError
from drivers.rates import same_rate
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.mtdata import PRECISION_SHIFT as SETTINGS_PRECISION_SHIFT
from drivers.xsens_mtig.mtdata import Layout, Mode, Settings
from drivers.xsens_mtig.mtdata2 import EVERY_MESSAGE, KIND_MASK, Kind, item_bytes
from drivers.xsens_mtig.protocol import OVERHEAD_BYTES
from drivers.xsens_mtig.reals import Precision

BITS_A_BYTE = 10  # start and stop bit
USABLE_SHARE = 0.95  # of the line; a fuller one falls behind after any delay
GNSS_HZ = 4
PERIOD_HZ = 115_200  # the legacy output period counts these
PERIODS = range(225, 1153)  # 512 Hz to 100 Hz; slower by skipping

OutputItems = list[tuple[int, int]]  # (id, rate)


@dataclass(frozen=True, slots=True)
class LegacyOutput:
    layout: Layout
    period: int  # in 1 / PERIOD_HZ s
    skip: int  # samples left out between two that are sent

    @property
    def rate_hz(self) -> float:
        return PERIOD_HZ / (self.period * (self.skip + 1))


def line_bits_per_s(items: OutputItems) -> int:
    """Load of an MTData2 configuration: inertial messages at their rate, GNSS messages on their own."""
    fast = [identifier for identifier, rate in items if rate not in (EVERY_MESSAGE, GNSS_HZ)]
    slow = [identifier for identifier, rate in items if rate == GNSS_HZ]
    always = OVERHEAD_BYTES + sum(item_bytes(i) for i, rate in items if rate == EVERY_MESSAGE)
    rate_hz = max((rate for _, rate in items if rate not in (EVERY_MESSAGE, GNSS_HZ)), default=0)
    total = rate_hz * (always + sum(map(item_bytes, fast)))
    if slow:
        total += GNSS_HZ * (always + sum(map(item_bytes, slow)))
    return total * BITS_A_BYTE


def wanted_items(config: XsensMtigConfig, baud: int | None) -> OutputItems:
    """The output configuration of an MTi-G-700/710 on a line of `baud`; None: one without limit.
    Raises DeviceError where the line cannot carry what the config demands.
    """
    precision, rate = config.precision, config.rate_hz
    demanded: OutputItems = [
        (Kind.PACKET_COUNTER, EVERY_MESSAGE),
        (Kind.SAMPLE_TIME_FINE, EVERY_MESSAGE),
        (Kind.ACCELERATION | precision, rate),
        (Kind.RATE | precision, rate),
    ]
    if config.gnss:
        demanded.append((Kind.GNSS_PVT, GNSS_HZ))
    if config.orientation is True:
        demanded.append((Kind.QUATERNION | precision, rate))
    _check(config, line_bits_per_s([*demanded, (Kind.STATUS_BYTE, EVERY_MESSAGE)]), baud)
    options: list[OutputItems] = []
    if config.orientation == "auto":
        options.append([(Kind.QUATERNION | precision, rate), (Kind.STATUS_BYTE, EVERY_MESSAGE)])
    best = [*demanded, (Kind.STATUS_BYTE, EVERY_MESSAGE)]
    for option in options:
        if _carries(baud, line_bits_per_s([*demanded, *option])):
            best = [*demanded, *option]
    richer = [(Kind.STATUS_WORD, r) if i == Kind.STATUS_BYTE else (i, r) for i, r in best]
    return sorted(richer if _carries(baud, line_bits_per_s(richer)) else best)


def wanted_layout(config: XsensMtigConfig, baud: int | None) -> LegacyOutput:
    """Mode, settings and period of an MTi-G on a line of `baud`. Raises DeviceError where the line cannot
    carry what the config demands.
    """
    if config.precision == Precision.FLOAT64:
        raise DeviceError("an MTi-G has no number_format float64; write float32, fp12.20 or fp16.32")
    settings = Settings.SAMPLE_COUNTER | Settings.NO_MAGNETIC_FIELD
    settings |= Settings.NO_ANALOG_1 | Settings.NO_ANALOG_2
    bits = settings | config.precision << SETTINGS_PRECISION_SHIFT
    skip = next(s for s in range(PERIOD_HZ) if PERIOD_HZ // (config.rate_hz * (s + 1)) in PERIODS)
    period = PERIOD_HZ // (config.rate_hz * (skip + 1))

    def load(mode: int) -> int:
        return (Layout(mode, bits).data_bytes + OVERHEAD_BYTES) * BITS_A_BYTE * config.rate_hz

    mode = Mode.CALIBRATED | Mode.STATUS
    if config.orientation is True:
        mode |= Mode.ORIENTATION
    smallest = mode | Mode.POSITION if config.gnss else mode
    _check(config, load(smallest), baud)
    if config.gnss:  # the receiver's own solution tells its accuracy; the filter's position does not
        mode = mode | Mode.RAW_GPS if _carries(baud, load(mode | Mode.RAW_GPS)) else smallest
    if config.orientation == "auto" and _carries(baud, load(mode | Mode.ORIENTATION)):
        mode |= Mode.ORIENTATION
    return LegacyOutput(Layout(mode, bits), period, skip)


def left_out(config: XsensMtigConfig, places: bool, orientation: bool, status: bool) -> str:
    """Data that the config requests and a unit that was set up elsewhere does not send."""
    missing = {
        "places (gnss: true)": config.gnss and not places,
        "orientation (orientation: true)": config.orientation is True and not orientation,
        "its status": not status,
    }
    names = ", ".join(name for name, is_missing in missing.items() if is_missing)
    return f"set up elsewhere (configure: false), it does not send {names}" if names else ""


WORDS = {
    Kind.PACKET_COUNTER: "packet counter",
    Kind.SAMPLE_TIME_FINE: "sample time",
    Kind.ACCELERATION: "acceleration",
    Kind.RATE: "rate of turn",
    Kind.QUATERNION: "orientation",
    Kind.GNSS_PVT: "GNSS fixes (write gnss: false for a unit without a receiver)",
    Kind.STATUS_BYTE: "status",
    Kind.STATUS_WORD: "status",
}
LEGACY_WORDS = {
    Mode.CALIBRATED: "rate of turn and acceleration",
    Mode.ORIENTATION: "orientation",
    Mode.POSITION: "places",
    Mode.RAW_GPS: "GNSS fixes",
    Mode.STATUS: "status",
}


def has_receiver(product: str) -> bool:
    """Whether a unit of this product code receives GNSS: MTi-G-710-2A5G4 and MTi-680G-8A7G6 do, MTi-30-2A5G4
    does not. "" is not known, and may."""
    return not product.startswith("MTi-") or "G" in product.split("-")[1]


def agree(wanted: OutputItems, given: OutputItems) -> bool:
    """The same items, at rates that are those wanted."""
    rates = dict(given)
    return rates.keys() == dict(wanted).keys() and all(
        same_rate(rates[identifier], rate) for identifier, rate in wanted
    )


def difference(wanted: OutputItems, given: OutputItems) -> str:
    """Difference of an MTData2 unit's output from the requested one, as text; "" for none."""
    rates = dict(given)
    missing = [WORDS[Kind(i & KIND_MASK)] for i, _ in wanted if i not in rates]
    texts = [f"configured {', '.join(missing)} not sent"] if missing else []
    texts += [
        f"{WORDS[Kind(i & KIND_MASK)]} at {rates[i]} Hz, configured {rate} Hz"
        for i, rate in wanted
        if rate != EVERY_MESSAGE and not same_rate(rates.get(i, rate), rate)
    ]
    return "; ".join(texts)


def legacy_difference(wanted: LegacyOutput, given: LegacyOutput) -> str:
    """Difference of an MTi-G's output from the requested one, as text; "" for none."""
    lacks = wanted.layout.mode & ~given.layout.mode
    missing = [words for bit, words in LEGACY_WORDS.items() if lacks & bit]
    texts = [f"configured {', '.join(missing)} not sent"] if missing else []
    if not same_rate(given.rate_hz, wanted.rate_hz):
        texts.append(f"samples at {given.rate_hz:g} Hz, configured {wanted.rate_hz:g} Hz")
    return "; ".join(texts)


def _carries(baud: int | None, bits_per_s: int) -> bool:
    return baud is None or bits_per_s <= USABLE_SHARE * baud


def _check(config: XsensMtigConfig, bits_per_s: int, baud: int | None) -> None:
    if not _carries(baud, bits_per_s):
        raise DeviceError(
            f"{config.rate_hz} Hz in {config.number_format} with gnss {config.gnss} and orientation "
            f"{config.orientation} makes {bits_per_s / 1000:.1f} kbit/s, the line at {baud} baud takes "
            f"{USABLE_SHARE:.0%} of {(baud or 0) / 1000:.1f}; write store_baud: 460800 with baud: auto, "
            "a lower rate_hz, or less of it"
        )
