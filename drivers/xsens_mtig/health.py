"""State of the device as text: status bits, GNSS, errors, warnings."""

from collections import Counter

from drivers.counted import counted

SELFTEST_OK, FILTER_VALID, GNSS_FIX = 0x1, 0x2, 0x4
NO_ROTATION_SHIFT = 3
NO_ROTATION = {  # bits 0x08 and 0x10, by Xsens' xsstatusflag.h
    1: "learning the gyro bias, some samples rejected: keep still",
    2: "gyro bias not learnt, it moved",
    3: "learning the gyro bias: keep still",
}
CLIPPED = {
    0x0700: "samples_clipped_acceleration",
    0x3800: "samples_clipped_rate",
    0x1_C000: "samples_clipped_magnetic",
}
FIXES = {
    0: "no GNSS fix",
    1: "GNSS dead reckoning",
    2: "GNSS 2D fix",
    3: "GNSS 3D fix",
    4: "GNSS 3D fix with dead reckoning",
    5: "GNSS time only",
}
FORGET_NS = 10_000_000_000  # how long an error or a warning is shown


class DeviceHealth:
    """Collects while a stream is read; `words` is for the health line."""

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._status: int | None = None
        self._words = "waiting for samples"
        self._gnss = ""
        self._reported = ""
        self._reported_ns = 0

    def observe_status(self, status: int) -> None:
        """Status byte or status word; the lower byte means the same in both."""
        for bits, name in CLIPPED.items():
            if status & bits:
                self._counters[name] += 1
        if status == self._status:
            return
        self._status = status
        words = ["filter valid" if status & FILTER_VALID else "filter not settled"]
        if not status & SELFTEST_OK:
            words.insert(0, "self-test failed: have it repaired")
        if text := NO_ROTATION.get(status >> NO_ROTATION_SHIFT & 3):
            words.append(text)
        self._words = ", ".join(words)

    def observe_gnss(self, fix: int, good: bool, satellites: int) -> None:
        text = FIXES.get(fix, f"GNSS fix of unknown kind {fix}")
        if fix and not good:
            text += " not good enough"
        self._gnss = f"{text} ({counted(satellites, 'satellite')})"

    def observe_gnss_words(self, text: str) -> None:
        self._gnss = text

    def say(self, text: str, now_ns: int) -> None:
        """Note an error or a warning of the device."""
        self._reported, self._reported_ns = text, now_ns

    def newest(self, now_ns: int) -> str:
        """The newest error or warning, while it is new."""
        return self._reported if now_ns - self._reported_ns < FORGET_NS else ""

    def words(self, now_ns: int) -> str:
        """The state as one line, the worst first."""
        status = self._words if self._status is not None else ""
        return ", ".join(text for text in (self.newest(now_ns), status, self._gnss) if text)
