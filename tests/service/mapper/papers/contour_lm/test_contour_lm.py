"""The profile contour_lm as a whole, with a laser alone."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from drivers.frames import Frame
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import MapperOutput
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, round_the_room

ROOT = Path(__file__).parents[5]
CONFIG = mapping_config({"profile": "contour_lm"})


@pytest.fixture(scope="module")
def room_drive() -> Drive:
    return drive(ROOM, round_the_room, 4.0, wheel_scale=None, every=2)


def mapped(frames: list[Frame]) -> list[MapperOutput]:
    mapper = build_mapper(CONFIG, {"front": MOUNTING})
    return [output for frame in frames if (output := mapper.process(frame)) is not None]


@pytest.fixture(scope="module")
def outputs(room_drive: Drive) -> list[MapperOutput]:
    return mapped(room_drive.frames)


def test_a_drive_round_a_room_is_followed_with_the_laser_alone(  # A1 A8
    room_drive: Drive, outputs: list[MapperOutput]
) -> None:
    away = [room_drive.truth[o.stamp_ns].inverse() @ o.pose_map_base for o in outputs]
    assert {o.state for o in outputs} == {"ok"}
    assert np.sqrt(np.mean([e.x_m**2 + e.y_m**2 for e in away])) < 0.02
    assert max(abs(np.degrees(e.theta_rad)) for e in away) < 0.6


def test_the_same_frames_give_the_same_poses(room_drive: Drive, outputs: list[MapperOutput]) -> None:
    again = mapped(room_drive.frames[:40])
    assert len(again) == 40
    assert [o.pose_odom_base for o in again] == [o.pose_odom_base for o in outputs[:40]]


def test_the_example_names_every_parameter_with_its_default() -> None:
    example = yaml.safe_load((ROOT / "config/profiles/contour_lm.yaml").read_text())
    defaults = CONFIG.model_dump()
    assert example == {key: defaults[key] for key in ("profile", "cell_m", "settings")}


def test_every_parameter_of_its_own_stages_is_documented() -> None:
    page = (ROOT / "docs/profiles/contour_lm.md").read_text()

    def keys(settings: dict) -> list[str]:
        return [k for name, v in settings.items() for k in ([name] if not isinstance(v, dict) else keys(v))]

    settings = CONFIG.model_dump()["settings"]
    for key in keys(settings["matcher"]) + keys(settings["local_map"]):
        assert f"`{key}`" in page, key
