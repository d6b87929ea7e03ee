"""The campaign itself, on a device that is quick to simulate: it tells good from bad."""

from dataclasses import replace

from service.located_yaml import load
from tests.chaos.campaign import kinds_for, run_one
from tests.chaos.machine import plan
from tests.drivers.faulty_devices import BENCHES


def test_a_device_that_comes_back_is_well_and_its_faults_are_counted():
    row = run_one("create2", "cut", ["kind: cut, at_s: 7, for_s: 1, every_s: 5, count: 2"], 20.0, 1)
    assert row.defect == ""
    assert (row.times, row.connects) == (2, 3)
    assert 1.0 < row.longest_gap_s < 3.0


def test_a_device_that_stays_away_or_comes_back_slower_is_not():
    assert "frames a second" in run_one("create2", "", ["kind: silence, at_s: 7, for_s: 900"], 20.0, 1).defect
    assert "frames a second" in run_one("create2", "", ["kind: drop, for_s: 900, share: 0.2"], 20.0, 1).defect


def test_a_stamp_that_has_moved_is_not():
    lines = ["kind: delay, at_s: 7, for_s: 900, up_to_ms: 30"]
    assert "stamps are off" in run_one("create1", "", lines, 20.0, 1).defect


def test_an_error_that_the_link_does_not_catch_is_told():
    bench = BENCHES["create2"]
    broken = replace(bench, sessions=lambda now: object)  # which is no session
    BENCHES["broken"] = broken
    try:
        assert run_one("broken", "", ["kind: cut"], 7.0, 1).defect.startswith("AttributeError")
    finally:
        del BENCHES["broken"]


def test_the_plan_for_the_machine_has_every_kind_on_both_devices():
    planned = load(plan(60.0, 1)).value["faults"]
    for device, bench in (("front", "lms100 cola_a"), ("base", "create2")):
        assert [fault["kind"] for fault in planned if fault["device"] == device] == kinds_for(BENCHES[bench])
    assert all(fault.get("at_s", 0.0) + fault["for_s"] < 45.0 for fault in planned if "for_s" in fault)
