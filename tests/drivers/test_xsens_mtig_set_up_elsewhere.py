"""A unit that another program set up (configure: false): what it sends, lacks, and knows of its place."""

import pytest

from drivers.xsens_mtig.mtdata import Mode
from drivers.xsens_mtig.protocol import Mid
from tests.drivers.mtig import Swing, fixes, legacy, mtdata2, talk

BOTH = pytest.mark.parametrize("make", [mtdata2, legacy])
PLACES = pytest.mark.parametrize("places", [Mode.POSITION, Mode.RAW_GPS])


def unconfigured(mode: int, source: Swing, **changes):
    """Talk with an MTi-G that was set up elsewhere to send this output mode."""
    device = legacy(baud=None)
    device.source = source
    device.settings.write(Mid.OUTPUT_MODE, mode.to_bytes(2, "big"))
    return talk(device, configure=False, device="usb", **changes)


@PLACES
def test_without_a_status_it_is_not_known_whether_an_mti_g_has_a_fix(places):
    t = unconfigured(Mode.CALIBRATED | places, Swing(None)).run(2.0)
    assert t.session.status == (
        "streaming; set up elsewhere (configure: false), it does not send its status; "
        "not known whether there is a GNSS fix"
    )
    assert fixes(t.frames) == []
    assert t.session.counters["fixes_without_status"] == t.session.counters["fixes_received"] > 0
    assert t.session.counters["fixes_none"] == 0


@PLACES
def test_an_mti_g_that_loses_its_fix_says_so_at_once(places):
    t = unconfigured(Mode.CALIBRATED | Mode.STATUS | places, Swing()).run(2.0)
    assert t.session.status == "streaming; filter valid, GNSS fix"
    t.device.source = Swing(None)
    t.run(0.1)
    assert t.session.status == "streaming; filter valid, no GNSS fix"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "places (gnss: true)"),
        ({"orientation": True}, "places (gnss: true), orientation (orientation: true)"),
        ({"gnss": False, "orientation": True}, "orientation (orientation: true)"),
        ({"gnss": False}, ""),
    ],
)
@BOTH
def test_what_a_unit_that_was_set_up_elsewhere_does_not_send_is_reported(make, changes, words):
    if make is legacy:
        t = unconfigured(Mode.CALIBRATED | Mode.STATUS, Swing(None), **changes)
    else:
        device = make(baud=None)
        device.settings.output = [(0x1060, 0xFFFF), (0x4020, 100), (0x8020, 100), (0xE010, 0xFFFF)]
        t = talk(device, configure=False, device="usb", **changes)
    t.run(2.0)
    facts = f"set up elsewhere (configure: false), it does not send {words}; " if words else ""
    assert t.session.status == f"streaming; {facts}filter valid"
    assert fixes(t.frames) == []
