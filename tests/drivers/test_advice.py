"""What `corridor doctor` and `corridor init` know of each sensor: its voice, its rate, who it says it is."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import encode_frame
from drivers.registry import SENSOR_KINDS
from drivers.sick_lms100.protocol import Dialect, Telegram
from drivers.sick_lms100.protocol import encode as sopas
from drivers.xsens_mtig.protocol import Mid
from drivers.xsens_mtig.protocol import encode as xbus
from tests.drivers import irobot_bench, lms100, lux, mtig, utm30lx

KINDS = ("sick_lms100", "hokuyo_utm30lx", "ibeo_lux", "xsens_mtig", "irobot_create")
FRAME = encode_frame(STREAM_IDS, dict.fromkeys(STREAM_IDS, 0))
VOICES = [
    *(
        (
            "sick_lms100",
            sopas(Telegram(d, "sRA", "SCdevicestate", b"1")),
            f"a SICK scanner that speaks {d.value}",
        )
        for d in Dialect
    ),
    ("hokuyo_utm30lx", b"\nQT\n00P\n\n", "a Hokuyo laser that speaks SCIP"),
    ("ibeo_lux", lux.wire(lux.scan()), "an IBEO LUX or a SICK LD-MRS"),
    ("xsens_mtig", xbus(Mid.MTDATA2), "an Xsens unit that sends MTData2 (an MTi-G-700 or later)"),
    ("xsens_mtig", xbus(Mid.MTDATA), "an Xsens unit that sends MTData (an MTi-G)"),
    ("xsens_mtig", xbus(Mid.WAKE_UP), "an Xsens unit"),
    ("irobot_create", FRAME[5:] + FRAME * 2, "an iRobot Create or Roomba"),
    (
        "irobot_create",
        b"bl-start\r\nSTR730\r\nbootloader id: #x47186549 82ECCFFF\r\n",
        "an iRobot Create or Roomba",
    ),
]


def advice(kind: str) -> Any:
    return SENSOR_KINDS[kind].advice


@pytest.mark.parametrize(("kind", "sent", "words"), VOICES)
def test_each_device_is_known_by_its_own_driver_alone(kind: str, sent: bytes, words: str):
    recognised = {other: advice(other).recognise(b"garbage" + sent) for other in KINDS}
    assert recognised == dict.fromkeys(KINDS, "") | {kind: words}


@pytest.mark.parametrize("sent", [b"", b"HTTP/1.1 200 OK\r\n\r\n", b"QT\n00Q\n\n", b"\n" * 16_384, FRAME])
def test_what_is_no_device_or_may_be_chance_is_known_by_none(sent: bytes):
    assert not any(advice(kind).recognise(sent) for kind in KINDS)


@pytest.mark.parametrize("kind", KINDS)
@given(st.binary(max_size=16_384))
def test_any_bytes_can_be_judged(kind: str, data: bytes):
    assert isinstance(advice(kind).recognise(data), str)


@pytest.mark.parametrize(
    ("kind", "config", "rate_hz"),
    [
        ("hokuyo_utm30lx", utm30lx.config(), 40.0),
        ("hokuyo_utm30lx", utm30lx.config(skip_scans=3), 10.0),
        ("ibeo_lux", lux.config(mirror_sides="rear"), 12.5),
        ("irobot_create", irobot_bench.CONFIG, 1000 / 15),
        ("irobot_create", irobot_bench.CREATE1, 10.0),
    ],
)
def test_the_rate_is_that_of_model_and_settings(kind: str, config: Any, rate_hz: float):
    assert advice(kind).rate_hz(config) == pytest.approx(rate_hz, abs=0.01)


@pytest.mark.parametrize(
    ("kind", "config", "words"),
    [
        ("sick_lms100", lms100.config(dialect="cola_a", port=2111), ["dialect: cola_b", "port: 2112"]),
        ("sick_lms100", lms100.config(dialect="cola_b", port=4000), ["dialect: cola_a"]),
        ("sick_lms100", lms100.config(dialect="auto", port=2112), ["port: 2111"]),
        ("sick_lms100", lms100.config(dialect="auto", port=4000), []),
        ("xsens_mtig", mtig.config(baud=115_200), ["baud: auto"]),
        ("xsens_mtig", mtig.config(), []),
    ],
)
def test_other_settings_are_those_that_explain_silence(kind: str, config: Any, words: list[str]):
    tried = advice(kind).other_settings(config)
    assert [other.words for other in tried] == words
    for other in tried:
        key, _, value = other.words.partition(": ")
        assert str(getattr(other.config, key)) == value


@pytest.mark.parametrize(
    ("kind", "config", "identity", "words"),
    [
        ("sick_lms100", lms100.config(), {"device": "LMS10x_FieldEval"}, ""),
        ("sick_lms100", lms100.config(), {}, ""),
        ("sick_lms100", lms100.config(), {"device": "TiM551"}, "it calls itself TiM551"),
        ("hokuyo_utm30lx", utm30lx.config(), {"product": "UTM-30LX-EW"}, ""),
        ("hokuyo_utm30lx", utm30lx.config(), {}, ""),
        ("hokuyo_utm30lx", utm30lx.config(), {"product": "UST-10LX"}, "UST-10LX, expected a UTM-30LX"),
        ("hokuyo_utm30lx", utm30lx.config(host="h", model="ust"), {"product": "UST-10LX"}, ""),
        ("xsens_mtig", mtig.config(), {"product": "MTi-G-710-2A5G4"}, ""),
        ("xsens_mtig", mtig.config(), {"product": "MTi-30-2A8G4"}, "which has no GNSS receiver"),
        ("xsens_mtig", mtig.config(gnss=False), {"product": "MTi-30-2A8G4"}, ""),
    ],
)
def test_another_device_than_configured_is_questioned(
    kind: str, config: Any, identity: dict[str, str], words: str
):
    doubt = advice(kind).doubt(config, identity)
    assert words in doubt
    assert bool(doubt) == bool(words)
