import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from drivers.irobot_create.config import IrobotCreateConfig


def config(**settings: Any) -> IrobotCreateConfig:
    return IrobotCreateConfig(name="base", device="/dev/null", **settings)


def test_models_bring_their_geometry_and_baud():
    create2, create1 = config(), config(model="create1")
    assert (create2.baud, create2.wheel_base_m) == (115_200, 0.235)
    assert create2.left_m_per_count == pytest.approx(0.444565e-3, abs=1e-9)  # the manual's figure
    assert (create1.baud, create1.wheel_base_m, create1.firmware_wheel_base_m) == (57_600, 0.258, 0.258)
    assert config(model="roomba").right_m_per_count == create2.right_m_per_count


def test_measured_values_override_the_models():
    measured = config(wheel_base_m=0.2301, wheel_diameter_m=0.0715, left_scale=1.01, baud=57_600)
    assert measured.wheel_base_m == 0.2301
    assert measured.baud == 57_600
    assert measured.left_m_per_count == pytest.approx(math.pi * 0.0715 / 508.8 * 1.01)
    assert measured.right_m_per_count == pytest.approx(math.pi * 0.0715 / 508.8)
    assert config(model="create1", wheel_base_m=0.26).firmware_wheel_base_m == 0.258


@pytest.mark.parametrize(
    ("settings", "diagnostic"),
    [
        ({"baud": 9600}, "too slow for a frame every 15 ms"),
        ({"baud": 115_201}, "none of the robot's rates"),
        ({"model": "create3"}, "'create1', 'create2' or 'roomba'"),
        ({"model": ["create2"]}, "'create1', 'create2' or 'roomba'"),
        ({"model": "create1", "wheel_diameter_m": 0.078}, "means nothing to a create1"),
        ({"model": "create1", "counts_per_revolution": 508.8}, "left_scale, right_scale and wheel_base_m"),
        ({"mounting": {"x_m": 0.1}}, "Extra inputs"),
        ({"wheel_base_m": 0.0}, "greater than 0"),
        ({"wheel_base_mm": 235}, "Extra inputs"),
        ({"left_scale": 3.0}, "less than or equal to 2"),
        ({"poll_interval_ms": 15}, "greater than or equal to 50"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], diagnostic: str):
    with pytest.raises(ValidationError, match=diagnostic):
        config(**settings)


def test_example_in_the_repository_is_valid():
    example = yaml.safe_load((Path(__file__).parents[2] / "config/sensors/irobot_create.yaml").read_text())
    assert IrobotCreateConfig(name="base", **example) == IrobotCreateConfig(
        name="base", device="/dev/corridor/create", model="create2"
    )
