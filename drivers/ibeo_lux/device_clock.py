"""The LUX's 64-bit clock to host time.

It counts from 0 at power-up until it is set, then from 1900; in both cases it is one clock against the
host's, so it is mapped by arrivals and never by its value. Setting it is a jump, and so is a restart. A jump
shows in the scan numbers, which go on: between two scans lies the difference of their numbers times the
period.
"""

from drivers.clock import ClockMap, MappedClock
from drivers.ibeo_lux.messages import Scan, ScannerStatus
from drivers.ibeo_lux.protocol import ntp_difference_ns

NUMBER_MODULUS = 1 << 16
NEAR_SCANS = 100  # over more missing scans the period is not known well enough to detect a jump
JUMP_NS = 10_000_000
JUMP_SHARE = 0.03  # of the time between; the mirror's speed is not exact
FAR_NS = 86_400_000_000_000  # another epoch, or a clock just set


class DeviceClock(MappedClock):
    """`observe` each scan, then `to_host_ns` for its stamps."""

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._clock = ClockMap(1.0, None, latency_ns)
        self._earlier_resets = 0
        self._zero_ntp: int | None = None  # the map counts from here, so that its floats stay exact
        self._last: Scan | None = None
        self.jumps = 0  # shown by the scan numbers

    @property
    def resets(self) -> int:
        """Number of jumps and restarts of the device's clock."""
        return self._earlier_resets + self._clock.resets + self.jumps

    @property
    def offset_ns(self) -> int | None:
        """Host minus device clock, which counts from 1900 once set; None before the first scan."""
        offset_ns = self._clock.offset_ns
        if offset_ns is None or self._zero_ntp is None:
            return None
        return offset_ns - (self._zero_ntp * 1_000_000_000 >> 32)

    def observe(self, scan: Scan, period_ns: int, arrived_ns: int) -> None:
        """Take in that `scan`, which ended at its end stamp, was there at `arrived_ns`."""
        if self._zero_ntp is None or self._jumped(scan, period_ns):
            self._earlier_resets += self._clock.resets
            self._clock = ClockMap(1.0, None, self._latency_ns)
            self._zero_ntp = scan.end_ntp
        self._last = scan
        self._clock.observe(ntp_difference_ns(scan.end_ntp, self._zero_ntp), arrived_ns)

    def to_host_ns(self, ntp: int) -> int:
        assert self._zero_ntp is not None
        return self._clock.to_host_ns(ntp_difference_ns(ntp, self._zero_ntp))

    def _jumped(self, scan: Scan, period_ns: int) -> bool:
        last = self._last
        assert last is not None
        went_ns = ntp_difference_ns(scan.end_ntp, last.end_ntp)
        if abs(went_ns) > FAR_NS:
            self.jumps += 1
            return True
        scans = (scan.number - last.number) % NUMBER_MODULUS
        if not scan.status & last.status & ScannerStatus.FREQUENCY_REACHED or not 1 <= scans <= NEAR_SCANS:
            return False
        expected_ns = scans * period_ns
        if abs(went_ns - expected_ns) <= JUMP_NS + JUMP_SHARE * expected_ns:
            return False
        self.jumps += 1
        return True
