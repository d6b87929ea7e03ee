"""A unit that refuses a setting, has no receiver, or no time: samples come all the same, and it is named."""

import struct

import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.xsens_mtig.protocol import Mid
from simulators.inertial import Place
from tests.drivers.mtig import PLACE, Swing, legacy, mtdata2, samples, talk

REFUSED = "error 0x21: parameter invalid or out of range"


@pytest.mark.parametrize("baud", [115_200, 460_800])
def test_unit_without_a_receiver_is_an_error_that_says_gnss_false(baud):
    device = mtdata2(product="MTi-30-2A5G4", baud=baud)
    with pytest.raises(DeviceError, match=r"MTi-30-2A5G4 has no GNSS receiver: .*; write gnss: false for"):
        talk(device).run(3.0)
    t = talk(device, gnss=False)
    t.now_ns += 10_000_000_000
    assert samples(t.run(3.0).frames)
    assert "configured" not in t.session.status


def test_unit_that_refuses_every_output_is_known_by_its_product_code():
    device = mtdata2(product="MTi-30-2A5G4", fixed=frozenset({Mid.OUTPUT_CONFIGURATION}))
    with pytest.raises(DeviceError, match="write gnss: false"):
        talk(device).run(3.0)


def test_output_that_it_refuses_is_used_as_it_is_set_where_it_holds_samples():
    device = mtdata2(fixed=frozenset({Mid.OUTPUT_CONFIGURATION}))
    device.settings.output = [(0x1060, 0xFFFF), (0x4020, 100), (0x8020, 100), (0xE010, 0xFFFF)]
    t = talk(device, gnss=False).run(3.0)
    assert len(samples(t.frames)) > 200
    assert f"; configured output not taken: {REFUSED}; " in t.session.status
    assert "; rate of turn at 100 Hz, configured 200 Hz; " in t.session.status
    with pytest.raises(DeviceError, match=r"needed are 8020.*configured output not taken: error 0x21"):
        talk(mtdata2(fixed=frozenset({Mid.OUTPUT_CONFIGURATION})), gnss=False).run(3.0)


def test_rate_that_it_rounds_is_the_one_that_was_asked_for():
    device = mtdata2()
    talk(device).run(1.0)
    device.settings.output = [(i, 199 if rate == 200 else rate) for i, rate in device.settings.output]
    t = talk(device)
    t.now_ns += 10_000_000_000
    t.run(2.0)
    assert t.session.counters["settings_written"] == 0
    assert "configured" not in t.session.status


def sent_utc_alone(make, before, place: Place | None):
    """A unit whose only time is UTC, over USB; 100 Hz."""
    device = make(baud=None, utc_before_fix=before)
    device.source = Swing(place)
    device.settings.output = [(0x1010, 0xFFFF), (0x4020, 100), (0x8020, 100)]
    if make is legacy:
        device.settings.write(Mid.OUTPUT_MODE, struct.pack(">H", 0x0002))
        device.settings.write(Mid.OUTPUT_SETTINGS, struct.pack(">I", 2))
    return device


@pytest.mark.parametrize("make", [mtdata2, legacy])
@pytest.mark.parametrize("before", ["absent", "no_date", "stands"])
def test_unit_whose_only_time_is_utc_is_stamped_by_arrival_before_its_first_fix(make, before):
    device = sent_utc_alone(make, before, None)
    t = talk(device, configure=False, device="usb", gnss=False).run(3.0)
    early = samples(t.frames)
    assert len(early) == t.session.counters["samples_received"] > 280
    assert t.session.counters["samples_stamped_by_arrival"] >= len(early) - 1
    assert "stamped by arrival" in t.session.status
    assert t.session.clock_sigma_ns is None
    assert all(0 <= s.arrived_ns - s.stamp_ns < 1_000_000 for s in early)
    device.source = Swing(PLACE)
    t.run(3.0)
    assert len(samples(t.frames)) == t.session.counters["samples_received"] > 580
    assert "stamped by arrival" not in t.session.status
    assert min(np.diff([s.stamp_ns for s in samples(t.frames)])) > 0


def test_unit_that_sends_no_time_at_all_is_stamped_by_arrival():
    device = mtdata2()
    device.settings.output = [(0x4020, 100), (0x8020, 100)]
    t = talk(device, configure=False, gnss=False).run(3.0)
    assert len(samples(t.frames)) > 250
    assert "stamped by arrival" in t.session.status


@pytest.mark.parametrize(("force_hz", "rate_hz"), [(100, 200), (200, 100), (50, 200)])
def test_rate_of_turn_and_acceleration_of_different_rates_lose_no_sample(force_hz, rate_hz):
    device = mtdata2()
    device.settings.output = [(0x1060, 0xFFFF), (0x4020, force_hz), (0x8020, rate_hz)]
    t = talk(device, configure=False, gnss=False).run(4.0)
    taken = samples(t.frames)
    assert len(taken) == pytest.approx(4 * 200, abs=60)
    assert np.diff([s.stamp_ns for s in taken[400:]]) == pytest.approx(5_000_000, abs=50_000)
    assert t.session.counters["samples_missed"] == 0
    assert t.session.counters["messages_without_samples"] <= 4
    assert f"acceleration at {force_hz} Hz" in t.session.status
