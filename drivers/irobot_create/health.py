"""State of the robot by its sensor packets, as text and counts."""

from collections import Counter
from collections.abc import Mapping

from drivers.irobot_create.protocol import Mode, PacketId

CHARGING = (
    "not charging",
    "reconditioning",
    "charging",
    "trickle charging",
    "waiting to charge",
    "charging fault",
)
LOW_BATTERY_SHARE = 0.2
FAULT_RECENT_NS = 10_000_000_000  # so long it is in the status, and so seldom in the log
_WHEEL_DROPS = 0b11100  # right, left, caster (Create 1)
_BUMPS = 0b00011
_CLIFFS = (PacketId.CLIFF_LEFT, PacketId.CLIFF_FRONT_LEFT, PacketId.CLIFF_FRONT_RIGHT, PacketId.CLIFF_RIGHT)
HEALTH_IDS = (
    PacketId.BUMPS_WHEEL_DROPS,
    *_CLIFFS,
    PacketId.CHARGING_STATE,
    PacketId.VOLTAGE,
    PacketId.CURRENT,
    PacketId.TEMPERATURE,
    PacketId.BATTERY_CHARGE,
    PacketId.BATTERY_CAPACITY,
    PacketId.OI_MODE,  # the sessions rely on its being last
)


class RobotHealth:
    """Follows the packets of HEALTH_IDS; counts what begins, and reports what is."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._values: Mapping[int, int] = {}
        self.mode_offset = 0  # 1 on robots that report every mode one too high (seen on a Roomba 690)

    def learn_mode_offset(self, reported_after_start: int) -> bool:
        """After 128 the mode is Passive, so packet 35 shows whether modes are reported one too high."""
        self.mode_offset = int(reported_after_start == Mode.PASSIVE + 1)
        return bool(self.mode_offset)

    def observe(self, values: Mapping[int, int]) -> None:
        """Take in a reading of HEALTH_IDS."""
        before, self._values = self._values or values, values
        for name, now, earlier in (
            ("wheel_drops", _wheel_drops(values), _wheel_drops(before)),
            ("bumps", _bumps(values), _bumps(before)),
            ("cliffs", _cliffs(values), _cliffs(before)),
        ):
            if now and not earlier:
                self._counters[name] += 1
        mode, earlier_mode = self._mode(values), self._mode(before)
        if mode != earlier_mode:
            self._counters["mode_changes"] += 1
            if mode == Mode.PASSIVE and earlier_mode in (Mode.SAFE, Mode.FULL):
                self._counters["fallbacks_to_passive"] += 1

    def words(self) -> str:
        """One line, the worst first; empty before the first reading."""
        if not self._values:
            return ""
        values, parts = self._values, list[str]()
        if _wheel_drops(values):
            parts.append("wheel dropped: is the robot lifted?")
        if _cliffs(values) and not values[PacketId.CHARGING_STATE]:  # on the dock all four see a cliff
            parts.append("cliff ahead")
        if _bumps(values):
            parts.append("bumper pressed")
        parts.append(self._battery_words())
        mode = self._mode(values)
        parts.append(f"mode {mode.name.lower()}" if isinstance(mode, Mode) else f"mode {mode}")
        return ", ".join(parts)

    def _battery_words(self) -> str:
        values = self._values
        volts, state = values[PacketId.VOLTAGE] / 1000.0, values[PacketId.CHARGING_STATE]
        charging = CHARGING[state] if state < len(CHARGING) else f"charging state {state}"
        capacity = values[PacketId.BATTERY_CAPACITY]
        if not capacity:
            return f"battery {volts:.1f} V, {charging}"
        share = min(values[PacketId.BATTERY_CHARGE] / capacity, 1.0)
        low = "low " if share < LOW_BATTERY_SHARE and state == 0 else ""
        return f"{low}battery {100.0 * share:.0f} % ({volts:.1f} V, {charging})"

    def _mode(self, values: Mapping[int, int]) -> Mode | int:
        mode = values[PacketId.OI_MODE] - self.mode_offset
        return Mode(mode) if mode in list(Mode) else mode


class EncoderFaults:
    """Implausible encoder readings: of which wheel, and when to log them."""

    def __init__(self) -> None:
        self._wheel = ""
        self._last_ns = self._logged_ns = -FAULT_RECENT_NS
        self._unsaid = 0

    def add(self, wheel: str, now_ns: int) -> int:
        """Take in a fault of the `left`, the `right` or `both` wheels' encoders. How many to log, this one
        and those since the last time; 0: it is too soon to report it again."""
        self._wheel, self._last_ns = wheel, now_ns
        self._unsaid += 1
        if now_ns - self._logged_ns < FAULT_RECENT_NS:
            return 0
        unsaid, self._unsaid, self._logged_ns = self._unsaid, 0, now_ns
        return unsaid

    def words(self, now_ns: int) -> str:
        """For the status; empty where none was recent."""
        if now_ns - self._last_ns >= FAULT_RECENT_NS:
            return ""
        return "both encoders jump" if self._wheel == "both" else f"{self._wheel} encoder jumps"


def _wheel_drops(values: Mapping[int, int]) -> bool:
    return bool(values[PacketId.BUMPS_WHEEL_DROPS] & _WHEEL_DROPS)


def _bumps(values: Mapping[int, int]) -> bool:
    return bool(values[PacketId.BUMPS_WHEEL_DROPS] & _BUMPS)


def _cliffs(values: Mapping[int, int]) -> bool:
    return any(values[packet_id] for packet_id in _CLIFFS)
