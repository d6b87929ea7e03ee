from service.runtime.host_time import HostTime


def test_labels_go_there_and_back():
    host_time = HostTime(1_700_000_000_000_000_000)
    assert host_time.unix_ns(12) == 1_700_000_000_000_000_012
    assert host_time.monotonic_ns(host_time.unix_ns(12)) == 12


def test_the_real_clocks_agree_with_themselves():
    assert abs(HostTime.now().offset_ns - HostTime.now().offset_ns) < 10_000_000
