from service.runtime.host_time import HostTime


def test_a_label_is_the_reading_and_the_offset():
    host_time = HostTime(1_700_000_000_000_000_000)
    assert host_time.unix_ns(12) == 1_700_000_000_000_000_012


def test_the_real_clocks_agree_with_themselves():
    assert abs(HostTime.now().offset_ns - HostTime.now().offset_ns) < 10_000_000
