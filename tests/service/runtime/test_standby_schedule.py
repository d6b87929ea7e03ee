"""When a stand-by is forked: in the pauses of the lasers, as the process tells it of their scans."""

from service.runtime.standby_schedule import INTERVAL_NS, OVERDUE_NS, ScanForecast, StandbySchedule

MS = 1_000_000
TOOK_NS = 8 * MS
DUE_NS = 1000 * MS + INTERVAL_NS
LATE_NS = 1000 * MS + OVERDUE_NS


def schedule(until_ns: int = DUE_NS) -> StandbySchedule:
    """A laser of 50 Hz, its last scan at that moment, and a stand-by made at 1 s, which took 8 ms."""
    made = StandbySchedule()
    made.made(1000 * MS, TOOK_NS)
    for k in range(10, -1, -1):
        made.arrived("front", until_ns - 20 * MS * k)
    return made


def test_the_first_is_due_at_once_and_the_next_after_the_interval() -> None:
    assert StandbySchedule().is_due(5, is_waiting=False)
    assert not schedule(DUE_NS - 1).is_due(DUE_NS - 1, is_waiting=False)
    assert schedule().is_due(DUE_NS, is_waiting=False)


def test_it_is_made_where_the_pause_to_the_next_scan_is_as_long_as_a_fork() -> None:
    assert schedule().is_due(DUE_NS + 12 * MS, is_waiting=False)
    assert not schedule().is_due(DUE_NS + 13 * MS, is_waiting=False)
    assert not schedule().is_due(DUE_NS + 30 * MS, is_waiting=False)  # a scan is overdue
    assert schedule().is_due(DUE_NS + 200 * MS, is_waiting=False)  # the laser is silent


def test_it_is_not_made_while_items_wait_until_it_is_overdue() -> None:
    assert not schedule().is_due(DUE_NS, is_waiting=True)
    late = schedule(LATE_NS - 30 * MS)
    assert not late.is_due(LATE_NS - 1, is_waiting=True)
    assert late.is_due(LATE_NS, is_waiting=True)


def test_where_the_newest_is_gone_the_next_is_due_at_once() -> None:
    made = schedule(1500 * MS)
    assert not made.is_due(1500 * MS, is_waiting=False)
    made.make_next_at_once()
    assert made.is_due(1500 * MS, is_waiting=False)


def forecast(**arrivals_ms: list[float]) -> ScanForecast:
    made = ScanForecast()
    for sensor, times in arrivals_ms.items():
        for at_ms in times:
            made.arrived(sensor, round(at_ms * MS))
    return made


def test_the_pause_lasts_until_the_first_laser_is_due() -> None:
    two = forecast(front=[0, 20, 40, 60], rear=[5, 30, 55])
    assert two.pause_ns(62 * MS) == 18 * MS  # both are due at 80 ms
    assert two.pause_ns(79 * MS) == 1 * MS
    assert two.pause_ns(81 * MS) == 0
    three = forecast(front=[0, 20, 40], rear=[0, 25, 50])
    assert three.pause_ns(51 * MS) == 9 * MS  # the front one at 60 ms, the rear one at 75 ms


def test_nothing_is_expected_of_a_laser_that_is_silent_or_unknown() -> None:
    assert forecast(front=[0, 20, 40]).pause_ns(101 * MS) is None
    assert forecast(front=[40]).pause_ns(41 * MS) is None
    assert forecast(front=[0, 20, 40], rear=[60, 85, 110]).pause_ns(120 * MS) == 15 * MS


def test_a_laser_that_changes_its_rate_is_followed() -> None:
    at_50_hz = [20.0 * k for k in range(20)]
    at_25_hz = [380.0 + 40.0 * k for k in range(1, 10)]
    assert forecast(front=at_50_hz + at_25_hz).pause_ns(741 * MS) == 39 * MS
