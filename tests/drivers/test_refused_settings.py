"""A device that does not take a setting: what it sends is used as it is, and the status names the setting."""

from typing import Any

import pytest

from drivers.errors import DeviceError, TransportError
from drivers.frames import GnssFix
from drivers.ibeo_lux.messages import Command, Parameter
from drivers.sick_lms100.protocol import Dialect
from drivers.sick_lms100.telegrams import OutputRange, ScanConfig
from drivers.xsens_mtig.mtdata2 import Kind
from drivers.xsens_mtig.protocol import Mid
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.ibeo_lux import LuxSetup
from simulators.sick_setup import Lms100Setup
from tests.drivers import lms100, lux, mtig, utm30lx
from tests.drivers.mtig import legacy, mtdata2

HALF = {"first_angle_deg": -90.0, "last_angle_deg": 90.0}
RANGE, RATE, DATA = (frozenset({name}) for name in ("LMPoutputRange", "mLMPsetscancfg", "LMDscandatacfg"))
WIDE = (
    "scans at 50 Hz and 0.5 deg from -135 to 135 deg, configured 50 Hz and 0.5 deg from -90 to 90 deg, "
    "cut to these angles by the driver; configured field of view -90 to 90 deg not taken: "
)
SLOW = (
    "scans at 25 Hz and 0.5 deg from -135 to 135 deg, configured 50 Hz and 0.5 deg from -135 to 135 deg; "
    "configured 50 Hz and 0.5 deg not taken: "
)
DENIED = "refused 2 times: error A: write access denied: not logged in, or read-only"
UNCHANGED = "both echoes, intensity_bits 8, every scan not taken: "
EW = {"host": "192.168.0.10"}
READY = {0x1012: 0xFFEE, 0x1102: 6400}
NARROW = {"first_angle_deg": 30.0, "last_angle_deg": -20.0}
FREQUENCY = frozenset({Parameter.SCAN_FREQUENCY})
ANGLES = frozenset({Parameter.START_ANGLE, Parameter.END_ANGLE})
LUX_WIDE = (
    "scans at 25 Hz from 50 to -60 deg, configured 25 Hz from 30 to -20 deg, cut to these angles by the "
    "driver; configured first_angle_deg 30 deg not taken: "
)
LUX_SLOW = (
    "scans at 12.5 Hz from 50 to -60 deg, configured 25 Hz from 50 to -60 deg; "
    "configured scan_rate_hz 25 Hz not taken: "
)
REFUSED = "error 0x21: parameter invalid or out of range"


def unit(*refused: str, **setup: Any) -> Utm30lxSetup:
    return Utm30lxSetup(refused=frozenset(refused), **setup)


LMS100 = [
    (Lms100Setup(refused=RANGE, firmware="V1.23"), HALF, f"{WIDE}LMPoutputRange {DENIED}"),
    (
        Lms100Setup(kept=RANGE, dialect=Dialect.BINARY),
        HALF,
        f"{WIDE}after LMPoutputRange was accepted it has -135 to 135 deg",
    ),
    (
        Lms100Setup(scan=ScanConfig(2500, 5000), refused=RATE),
        {},
        f"{SLOW}mLMPsetscancfg refused 2 times: error 1: method access denied: log in with a higher level",
    ),
    (
        Lms100Setup(scan=ScanConfig(2500, 5000), kept=RATE),
        {},
        f"{SLOW}45 s after mLMPsetscancfg was accepted it has 25 Hz and 0.5 deg",
    ),
    (
        Lms100Setup(refused=DATA),
        {"echo": "last", "intensity_bits": 8},
        f"configured {UNCHANGED}LMDscandatacfg {DENIED}",
    ),
    (
        Lms100Setup(kept=DATA),
        {"echo": "last", "intensity_bits": 8},
        f"configured {UNCHANGED}after LMDscandatacfg was accepted it has first echo, intensity_bits 0,",
    ),
    (
        Lms100Setup(),
        HALF | {"password_hash": "00000000"},
        f"{WIDE}login as authorised client refused (hash 00",
    ),
]
UTM30LX = [
    (unit("ME"), {"intensity": True}, "configured intensity not taken: ME refused (status 0E)"),
    (
        unit("ND", wire="ethernet"),
        EW | {"echo": "last"},
        "configured echo last not taken: ND refused (status 0E)",
    ),
    (unit("cluster"), {"cluster": 3}, "configured cluster 3 not taken: MD refused (status 03)"),
    (unit("skip"), {"skip_scans": 1}, "configured skip_scans 1 not taken: MD refused (status 06)"),
    (unit(last_step=900), {}, "configured last_angle_deg 135 not taken: it sees to 90 deg"),
]
LUX = [
    (LuxSetup(fixed=FREQUENCY), {}, f"{LUX_SLOW}refused 3 times, it has 12.5 Hz; 31 C"),
    (LuxSetup(kept=FREQUENCY), {}, f"{LUX_SLOW}accepted, but it has 12.5 Hz; 31 C"),
    (LuxSetup(unsupported=FREQUENCY), {}, f"{LUX_SLOW}refused 3 times; 31 C"),
    (LuxSetup(refused=frozenset({Command.SET_PARAMETER})), {}, f"{LUX_SLOW}refused 3 times, it has 12.5 Hz"),
    (LuxSetup(parameters=READY, fixed=ANGLES), NARROW, f"{LUX_WIDE}refused 3 times, it has 50 deg"),
    (LuxSetup(parameters=READY, kept=ANGLES), NARROW, f"{LUX_WIDE}accepted, but it has 50 deg"),
    (
        LuxSetup(parameters=READY, fixed=frozenset({Parameter.RESOLUTION})),
        {"resolution": "focused"},
        "configured resolution focused not taken: refused 3 times, it has constant",
    ),
    (
        LuxSetup(parameters=READY, refused=frozenset({Command.SET_NTP, Command.SET_NTP_SECONDS})),
        {},
        "configured set_clock not taken",
    ),
]
OTHERS = [
    (Mid.LEVER_ARM, {"lever_arm_m": (0.25, 0.0, 0.5)}, "lever_arm_m"),
    (Mid.SCENARIO, {"filter_profile": "automotive"}, "filter_profile"),
    (Mid.BAUDRATE, {"store_baud": 460_800}, "store_baud 460800"),
]
MTIG = [
    (
        mtdata2(baud=460_800, unsendable=frozenset({Kind.QUATERNION})),
        {},
        f"configured orientation not taken: {REFUSED}",
    ),
    *(
        (make(fixed=frozenset({mid})), changes, f"configured {words} not taken: {REFUSED}")
        for make in (mtdata2, legacy)
        for mid, changes, words in OTHERS
    ),
    (
        legacy(fixed=frozenset({Mid.PERIOD})),
        {},
        f"samples at 100 Hz, configured 200 Hz; configured rate 200 Hz not taken: {REFUSED}",
    ),
    (
        legacy(fixed=frozenset({Mid.OUTPUT_MODE})),
        {},
        "configured output mode (write gnss: false for a unit without a receiver) not taken",
    ),
]
BEAMS = {WIDE: 361, SLOW: 541, "last_angle_deg 135": 901, "cluster": 1081, LUX_WIDE: 401}
RATES_HZ = {WIDE: 50.0, SLOW: 25.0, "skip_scans": 40.0, LUX_SLOW: 12.5, LUX_WIDE: 25.0}


@pytest.mark.parametrize(
    ("bench", "setup", "changes", "words"),
    [
        (bench, *case)
        for bench, cases in ((lms100, LMS100), (utm30lx, UTM30LX), (lux, LUX), (mtig, MTIG))
        for case in cases
    ],
)
def test_setting_that_it_does_not_take_is_done_without_and_named(
    bench: Any, setup: Any, changes: dict[str, Any], words: str
):
    t = bench.talk(setup, **changes)
    t.run(60.0, until=lambda: words in t.session.status and len(t.frames) > 60)
    assert t.session.status.startswith("streaming; ")
    assert words in t.session.status
    frames = [frame for frame in t.frames if not isinstance(frame, GnssFix)]
    assert len(frames) > 30
    for part, beams in BEAMS.items():
        assert part not in words or len(frames[-1].range_m) == beams
    for part, rate_hz in RATES_HZ.items():
        assert part not in words or frames[-1].scan_period_ns == pytest.approx(1e9 / rate_hz, rel=0.01)
    assert not any(len(getattr(frame, "intensity", ())) for frame in frames)


@pytest.mark.parametrize(
    ("bench", "setup", "first_angle_deg"),
    [
        (lms100, Lms100Setup(refused=RANGE, output_range=OutputRange(-450_000, 450_000)), 100.0),
        (lux, LuxSetup(parameters=READY | {0x1101: 320}, fixed=ANGLES), 0.0),  # 50 to 10 deg
    ],
)
def test_scans_without_a_beam_in_the_configured_field_of_view_are_no_scans(
    bench: Any, setup: Any, first_angle_deg: float
):
    with pytest.raises(TransportError, match="without a beam in the configured field of view; write first_"):
        bench.talk(setup, first_angle_deg=first_angle_deg).run(60.0)


def test_utm30lx_without_further_echoes_gives_the_first_with_its_intensity():
    t = utm30lx.talk(unit("NE", wire="ethernet"), **EW, echo="strongest", intensity=True).run(3.0)
    assert t.session.status == "streaming; configured echo strongest not taken: NE refused (status 0E)"
    assert len(t.frames[-1].intensity) == 1081


def test_utm30lx_that_refuses_all_is_done_with_less_until_nothing_is_left():
    refused = unit("NE", "ME", "cluster", "skip", wire="ethernet")
    t = utm30lx.talk(refused, **EW, echo="last", intensity=True, cluster=2, skip_scans=1).run(4.0)
    assert t.frames
    assert t.session.status.count("not taken") == 4
    with pytest.raises(DeviceError, match=r"MD.* refused \(status 0E\): it does not know the command"):
        utm30lx.talk(unit("MD")).run(4.0)
