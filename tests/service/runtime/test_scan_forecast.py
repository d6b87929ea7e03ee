from service.runtime.scan_forecast import ScanForecast

MS = 1_000_000


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


def test_one_late_arrival_does_not_move_the_forecast() -> None:
    assert forecast(front=[0, 20, 40, 75, 80, 100, 120]).pause_ns(121 * MS) == 19 * MS


def test_a_scan_that_is_overdue_may_come_at_any_moment() -> None:
    assert forecast(front=[0, 20, 40]).pause_ns(70 * MS) == 0


def test_nothing_is_expected_of_a_laser_that_is_silent_or_unknown() -> None:
    assert forecast(front=[0, 20, 40]).pause_ns(101 * MS) is None
    assert forecast(front=[40]).pause_ns(41 * MS) is None
    assert forecast(front=[0, 20, 40], rear=[60, 85, 110]).pause_ns(120 * MS) == 15 * MS


def test_a_laser_that_changes_its_rate_is_followed() -> None:
    at_50_hz = [20.0 * k for k in range(20)]
    at_25_hz = [380.0 + 40.0 * k for k in range(1, 10)]
    assert forecast(front=at_50_hz + at_25_hz).pause_ns(741 * MS) == 39 * MS
