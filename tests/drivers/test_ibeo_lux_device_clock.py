"""Jumps of the device's clock are distinguished from late messages; the era ends and nothing happens."""

from drivers.ibeo_lux.device_clock import DeviceClock
from tests.drivers.lux import ntp, scan
from tests.drivers.virtual_time import SECOND_NS

PERIOD_NS = 40_000_000


def test_missing_scans_and_late_ones_are_no_jump():
    clock = DeviceClock(0)
    for k in (*range(20), *range(27, 60), *range(150, 200)):
        start_ns = 10 * SECOND_NS + k * PERIOD_NS
        late_ns = 90_000_000 * (k % 5 == 0)
        clock.observe(scan(number=k, start_ns=start_ns), PERIOD_NS, start_ns + 67 * SECOND_NS + late_ns)
    assert clock.resets == 0


def test_clock_that_is_set_while_scans_are_missing_is_learnt_again_at_once():
    clock = DeviceClock(0)
    for k in (*range(20), *range(500, 520)):
        set_ns = 3_900_000_000 * SECOND_NS if k >= 500 else 0
        made = scan(number=k, start_ns=10 * SECOND_NS + k * PERIOD_NS + set_ns)
        clock.observe(made, PERIOD_NS, 77 * SECOND_NS + k * PERIOD_NS)
        assert abs(clock.to_host_ns(made.end_ntp) - 77 * SECOND_NS - k * PERIOD_NS) < 10
    assert clock.resets == clock.jumps == 1


def test_mirror_that_comes_up_to_speed_is_no_jump():
    clock = DeviceClock(0)
    for k in range(40):
        start_ns = 10 * SECOND_NS + k * (PERIOD_NS + 20_000_000 // (k + 1))
        made = scan(number=k, start_ns=start_ns, status=0x0303)
        clock.observe(made, PERIOD_NS, 77 * SECOND_NS + k * PERIOD_NS + 1_000_000)
    assert clock.jumps == 0


def test_end_of_the_era_is_no_jump():
    clock = DeviceClock(0)
    era_ns = 2**32 * SECOND_NS

    def at_ns(k):
        return era_ns - SECOND_NS + k * PERIOD_NS

    for k in range(60):
        made = scan(number=k, start_ns=0)
        start, end = ntp(at_ns(k)) % 2**64, ntp(at_ns(k) + 12_000_000) % 2**64
        made = type(made)(k, 0x030B, start, end, 1600, -1920, made.points)
        clock.observe(made, PERIOD_NS, 77 * SECOND_NS + k * PERIOD_NS)
        assert abs(clock.to_host_ns(end) - 77 * SECOND_NS - k * PERIOD_NS) < 10
    assert clock.resets == 0
