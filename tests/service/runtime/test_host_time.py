from service.runtime.host_time import HostTime


def test_the_quickest_reading_is_taken():
    monotonic = iter([0, 100, 1_000, 1_010, 2_000, 2_400, 3_000, 3_300, 4_000, 4_500])
    unix = iter([7_050, 7_999, 9_300, 9_900, 10_000])
    assert HostTime.now(lambda: next(monotonic), lambda: next(unix)) == HostTime(7_999 - 1_005)


def test_labels_go_there_and_back():
    host_time = HostTime(1_700_000_000_000_000_000)
    assert host_time.unix_ns(12) == 1_700_000_000_000_000_012
    assert host_time.monotonic_ns(host_time.unix_ns(12)) == 12


def test_a_step_is_told_from_jitter_and_slewing():
    start = HostTime(1_000_000_000)
    assert start.step_ns(HostTime(1_000_000_000 + 99_999_999)) == 0
    assert start.step_ns(HostTime(1_000_000_000 - 3_600_000_000_000)) == -3_600_000_000_000


def test_the_real_clocks_agree_with_themselves():
    assert abs(HostTime.now().offset_ns - HostTime.now().offset_ns) < 10_000_000
