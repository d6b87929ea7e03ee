"""Settings that a device could never follow die at the start, with words."""

import pytest
from pydantic import ValidationError

from tests.drivers.utm30lx import config


@pytest.mark.parametrize(
    ("changes", "complaint"),
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
def test_settings_no_device_can_follow_are_refused(changes, complaint):
    with pytest.raises(ValidationError, match=complaint):
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
