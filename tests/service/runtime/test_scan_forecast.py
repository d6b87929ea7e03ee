from service.runtime.scan_forecast import ScanForecast

MS = 1_000_000


def forecast(**arrivals_ms: list[float]) -> ScanForecast:
    made = ScanForecast()
    for sensor, times in arrivals_ms.items():
        for at_ms in times:
            made.arrived(sensor, round(at_ms * MS))
    return made


def test_nothing_is_expected_of_a_laser_that_is_silent_or_unknown() -> None:
    assert forecast(front=[0, 20, 40]).pause_ns(101 * MS) is None
    assert forecast(front=[40]).pause_ns(41 * MS) is None
    assert forecast(front=[0, 20, 40], rear=[60, 85, 110]).pause_ns(120 * MS) == 15 * MS
