"""The campaign itself, on a device that is quick to simulate: it tells good from bad."""

from dataclasses import replace

from tests.chaos.drivers import run_one
from tests.drivers.faulty_devices import BENCHES


def test_a_device_that_comes_back_has_no_defect_and_its_faults_are_counted():
    row = run_one("create2", "cut", ["kind: cut, at_s: 7, for_s: 1, every_s: 5, count: 2"], 20.0, 1)
    assert row.defect == ""
    assert (row.times, row.connects) == (2, 3)
    assert 1.0 < row.longest_gap_s < 3.0


def test_a_device_that_stays_away_or_comes_back_slower_has_a_defect():
    assert "frames a second" in run_one("create2", "", ["kind: silence, at_s: 7, for_s: 900"], 20.0, 1).defect
    assert "frames a second" in run_one("create2", "", ["kind: drop, for_s: 900, share: 0.2"], 20.0, 1).defect


def test_a_stamp_that_has_moved_is_a_defect():
    lines = ["kind: delay, at_s: 7, for_s: 900, up_to_ms: 30"]
    assert "stamps are off" in run_one("create1", "", lines, 20.0, 1).defect


def test_an_error_that_the_link_does_not_catch_is_reported():
    bench = BENCHES["create2"]
    broken = replace(bench, sessions=lambda now: object)  # which is no session
    BENCHES["broken"] = broken
    try:
        assert run_one("broken", "", ["kind: cut"], 7.0, 1).defect.startswith("AttributeError")
    finally:
        del BENCHES["broken"]
