"""The example is valid; what the device cannot do is refused."""

from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from drivers.ibeo_lux.config import IbeoLuxConfig

EXAMPLE = yaml.safe_load((Path(__file__).parents[2] / "config/sensors/ibeo_lux.yaml").read_text())


def config(**changes):
    return IbeoLuxConfig(name="lux", **EXAMPLE | changes)


def test_angles_become_even_ticks():
    odd = config(first_angle_deg=10.03, last_angle_deg=-10.03)  # 320.96 and -320.96 ticks
    assert (odd.first_ticks, odd.last_ticks) == (320, -320)
    assert (config().first_ticks, config().last_ticks) == (1600, -1920)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"hots": "1.2.3.4"}, "hots"),
        ({"scan_rate_hz": 40}, "must be 12.5, 25 or 50, not 40"),
        ({"angle_step_deg": 0.1}, "must be 0.125, 0.25 or 0.5"),
        ({"first_angle_deg": -10.0, "last_angle_deg": 10.0}, "sweeps from left to right"),
        ({"first_angle_deg": 51.0}, "first_angle_deg"),
        ({"last_angle_deg": -60.5}, "last_angle_deg"),
        ({"range_min_m": 3.0, "range_max_m": 2.0}, "must be below range_max_m"),
        ({"layers": []}, "layers"),
        ({"layers": [4]}, "layers"),
        ({"layers": [1, 1]}, "names one twice"),
        ({"layer_choice": "best"}, "layer_choice"),
        ({"echo": "all"}, "echo"),
        ({"discard": ["fog"]}, "discard"),
        ({"resolution": "fine"}, "resolution"),
        ({"sync_angle_deg": 180.0}, "sync_angle_deg"),
        ({"height_m": 0.0}, "height_m"),
        ({"mounting": {"pitch_deg": 1.0}}, "mounting"),
    ],
)
def test_setting_the_device_cannot_have_is_refused_in_words(wrong, words):
    with pytest.raises(ValidationError, match=words):
        config(**wrong)
