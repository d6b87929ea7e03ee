"""A UTM-30LX that does not take a setting: its scans are used without it, and the status names it."""

import numpy as np
import pytest

from drivers.errors import DeviceError
from simulators.hokuyo_setup import Utm30lxSetup
from tests.drivers.utm30lx import talk

EW = {"host": "192.168.0.10"}


def unit(*refused, wire="usb", **setup):
    return Utm30lxSetup(wire=wire, refused=frozenset(refused), **setup)


@pytest.mark.parametrize(
    ("setup", "changes", "words", "rate_hz", "beams"),
    [
        (unit("ME"), {"intensity": True}, "intensity not taken: ME refused (status 0E)", 40, 1081),
        (
            unit("ND", wire="ethernet"),
            EW | {"echo": "last"},
            "echo last not taken: ND refused (status 0E)",
            40,
            1081,
        ),
        (unit("cluster"), {"cluster": 3}, "cluster 3 not taken: MD refused (status 03)", 40, 1081),
        (unit("skip"), {"skip_scans": 1}, "skip_scans 1 not taken: MD refused (status 06)", 40, 1081),
        (unit(last_step=900), {}, "last_angle_deg 135 not taken: it sees to 90 deg", 40, 901),
    ],
)
def test_what_it_refuses_is_done_without_and_named(setup, changes, words, rate_hz, beams):
    t = talk(setup, **changes).run(4.0)
    assert t.session.status == f"streaming; configured {words}"
    assert len(t.frames) > 80
    frame = t.frames[-1]
    assert (len(frame.range_m), len(frame.intensity)) == (beams, 0)
    assert frame.scan_period_ns == pytest.approx(1e9 / rate_hz, rel=0.01)
    assert np.nanmax(frame.range_m) > 1.0


def test_unit_without_further_echoes_gives_the_first_with_its_intensity():
    t = talk(unit("NE", wire="ethernet"), **EW, echo="strongest", intensity=True).run(3.0)
    assert t.session.status == "streaming; configured echo strongest not taken: NE refused (status 0E)"
    assert len(t.frames[-1].intensity) == 1081


def test_unit_that_refuses_all_is_done_with_less_until_nothing_is_left():
    t = talk(
        unit("NE", "ME", "cluster", "skip", wire="ethernet"),
        **EW,
        echo="last",
        intensity=True,
        cluster=2,
        skip_scans=1,
    )
    assert t.run(4.0).frames
    assert t.session.status.count("not taken") == 4
    with pytest.raises(DeviceError, match=r"MD.* refused \(status 0E\): it does not know the command"):
        talk(unit("MD")).run(4.0)
