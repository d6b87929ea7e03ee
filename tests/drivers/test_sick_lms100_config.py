"""The example is valid; what the device cannot do is refused."""

from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from drivers.sick_lms100.config import Lms100Config

EXAMPLE = yaml.safe_load((Path(__file__).parents[2] / "config/sensors/sick_lms100.yaml").read_text())


def config(**changes):
    return Lms100Config(name="front", **EXAMPLE | changes)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"hots": "1.2.3.4"}, "hots"),
        ({"scan_rate_hz": 40}, "scan_rate_hz"),
        ({"scan_rate_hz": 100}, "must be 25 or 50, not 100"),
        ({"angle_step_deg": 0.25}, "needs scan_rate_hz 25"),
        ({"angle_step_deg": 0.1, "scan_rate_hz": 25}, "must be 0.25 or 0.5"),
        ({"first_angle_deg": 10.0, "last_angle_deg": 10.0}, "must lie below"),
        ({"first_angle_deg": -180.0}, "first_angle_deg"),
        ({"range_min_m": 3.0, "range_max_m": 2.0}, "must be below range_max_m"),
        ({"port": 0}, "port"),
        ({"password_hash": "main"}, "password_hash"),
        ({"intensity_bits": 12}, "intensity_bits"),
        ({"echo": "all"}, "echo"),
        ({"mounting": {"x": 1.0}}, "mounting"),
    ],
)
def test_setting_the_device_cannot_have_is_refused_in_words(wrong, words):
    with pytest.raises(ValidationError, match=words):
        config(**wrong)
