"""The example is valid; settings that a device could never follow die at the start, with words."""

from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from drivers.hokuyo_utm30lx.advice import ADVICE
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.registry import SENSOR_KINDS
from tests.drivers.utm30lx import config

EXAMPLE = yaml.safe_load((Path(__file__).parents[2] / "config/sensors/hokuyo_utm30lx.yaml").read_text())


def test_the_registry_knows_the_sensor_by_its_type():
    kind = SENSOR_KINDS[EXAMPLE["type"]]
    assert kind.config is HokuyoUtm30lxConfig
    assert kind.advice is ADVICE
    sessions = kind.session_maker(config())
    assert sessions() is not sessions()


@pytest.mark.parametrize(
    ("changes", "diagnostic"),
    [
        ({"device": None}, "either device"),
        ({"device": "/dev/ttyACM0", "host": "192.168.0.10"}, "not both"),
        ({"echo": "last"}, "needs a UTM-30LX-EW"),
        ({"first_angle_deg": 10.0, "last_angle_deg": 10.0}, "must lie below"),
        ({"range_min_m": 5.0, "range_max_m": 4.0}, "must be below"),
        ({"cluster": 0}, "cluster"),
        ({"cluster": 100}, "cluster"),
        ({"skip_scans": 10}, "skip_scans"),
        ({"serial_number": ""}, "serial_number"),
        ({"baud": 115200}, "baud"),
    ],
)
def test_settings_no_device_can_follow_are_refused(changes, diagnostic):
    with pytest.raises(ValidationError, match=diagnostic):
        config(**changes)


@pytest.mark.parametrize(
    ("changes", "command"),
    [
        ({}, "MD"),
        ({"intensity": True}, "ME"),
        ({"host": "h"}, "MD"),
        ({"host": "h", "echo": "last"}, "ND"),
        ({"host": "h", "echo": "last", "intensity": True}, "NE"),
        ({"host": "h", "echo": "strongest"}, "NE"),
    ],
)
def test_the_stream_asked_for_holds_what_is_wanted_and_no_more(changes, command):
    assert config(**changes).scan_command == command


def test_the_doctor_knows_the_rate_the_voice_and_the_name():
    assert ADVICE.rate_hz(config()) == 40.0
    assert ADVICE.rate_hz(config(skip_scans=3)) == 10.0
    assert "SCIP" in ADVICE.recognise(b"noise\nQT\n00P\n\n")
    for stranger in (
        b"",
        b"\x02sRA SCdevicestate 1\x03",
        b"HTTP/1.1 200 OK\r\n\r\n",
        b"QT\n00Q\n\n",
        b"\n" * 16_384,
    ):
        assert ADVICE.recognise(stranger) == ""
    assert ADVICE.doubt(config(), {"product": "UTM-30LX-EW"}) == ADVICE.doubt(config(), {}) == ""
    assert "UST-10LX, expected a UTM-30LX" in ADVICE.doubt(config(), {"product": "UST-10LX"})
    assert ADVICE.doubt(config(host="h", model="ust"), {"product": "UST-10LX"}) == ""
    assert "URG-04LX, expected a UTM-30LX" in ADVICE.doubt(config(), {"product": "URG-04LX"})
