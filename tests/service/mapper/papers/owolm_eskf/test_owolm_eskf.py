"""The profile `owolm_eskf` as a whole, on small drives whose truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import Frame, ImuSample, OdometrySample
from service.geometry.se2 import SE2
from tests.service.mapper.drives import (
    CORRIDOR,
    MOUNTING,
    ROOM,
    down_the_corridor,
    drive,
    errors,
    mapper_of,
    outputs_of,
    round_the_room,
    scans_of,
)

IMU_NS = 5_000_000


def with_imu(frames: list[Frame], motion, seconds: float, start_ns: int = 1_000_000_000) -> list[Frame]:
    """Rates and forces of a motion by differences, with noise and biases; what wheels say is left out."""
    noise = np.random.default_rng(7)
    samples: list[Frame] = []
    for stamp_ns in range(start_ns - 500_000_000, start_ns + round(seconds * 1e9), IMU_NS):
        t = (stamp_ns - start_ns) * 1e-9
        before, here, after = (motion(max(t + shift, 0.0)) for shift in (-0.005, 0.0, 0.005))
        ax, ay = (
            (after.x_m - 2 * here.x_m + before.x_m) / 25e-6,
            (after.y_m - 2 * here.y_m + before.y_m) / 25e-6,
        )
        c, s = math.cos(here.theta_rad), math.sin(here.theta_rad)
        rate = (before.inverse() @ after).theta_rad / 0.01 + 0.001 + 0.003 * noise.standard_normal()
        force = np.array([c * ax + s * ay + 0.01, c * ay - s * ax, 9.81]) + 0.02 * noise.standard_normal(3)
        samples.append(ImuSample("imu", stamp_ns, stamp_ns, (0.0, 0.0, rate), tuple(force.tolist())))
    return sorted([*scans_of(frames), *samples], key=lambda frame: frame.arrived_ns)


@pytest.fixture(scope="module")
def room_drive():
    return drive(ROOM, round_the_room, 4.0)


def test_the_map_lies_along_the_walls_and_odom_at_the_start(room_drive):  # B3 B18
    """Turning the laser's mounting in the config is the same as starting at an angle."""
    for turn_rad in (0.0, 0.5):
        mounting = SE2(MOUNTING.x_m, MOUNTING.y_m, MOUNTING.theta_rad + turn_rad)
        mapper = mapper_of("owolm_eskf", mounting)
        first = outputs_of(mapper, room_drive.frames[:30])[0]
        assert first.pose_odom_base == SE2()
        local_map = mapper.components.local_map
        assert local_map.pose_axes_odom.theta_rad == pytest.approx(-turn_rad, abs=0.006)


def test_along_a_bare_corridor_wheels_and_imu_say_how_far_it_was_and_the_state_says_so():  # B14 B33
    """Wheels 1 % off; the dots of the walls, which every scan sees alike, would hold the pose back."""
    long = drive(CORRIDOR, down_the_corridor, 6.0)
    wheels = [frame for frame in long.frames if isinstance(frame, OdometrySample)]
    frames = [*with_imu(long.frames, down_the_corridor, 6.0), *wheels]
    outputs = outputs_of(mapper_of("owolm_eskf"), sorted(frames, key=lambda frame: frame.arrived_ns))
    away = errors(outputs, long.truth)
    path_length_m = long.truth[outputs[-1].stamp_ns].x_m
    assert np.abs(away[:, 0]).max() < 0.02 * path_length_m
    assert np.abs(away[:, 1]).max() < 0.03
    assert outputs[-1].state == "degraded"
    assert "does not fix the position along the direction" in outputs[-1].reason


def test_levels_differ_by_the_ratio_and_all_take_every_scan(room_drive):  # B16 B17
    for ratio in (2, 4, 5):
        mapper = mapper_of("owolm_eskf", settings={"local_map": {"ratio": ratio}})
        outputs_of(mapper, room_drive.frames[:10])
        layers = mapper.components.local_map.search_layers()
        assert [round(layer.cell_m / 0.025) for layer in layers] == [1, ratio, ratio**2]
        assert all(layer.cells.max() > 0 for layer in layers)


def test_the_pyramid_finds_a_start_that_is_far_off(room_drive):  # B16
    scans = scans_of(room_drive.frames)
    wide = {"least_window_m": 0.6, "least_window_rad": 0.3}
    mapper = mapper_of("owolm_eskf", settings={"matcher": wide})
    outputs_of(mapper, scans[:2])
    components = mapper.components
    predicted = components.motion_model.predict(scans[2].stamp_ns)
    off = replace(predicted, pose_odom_base=predicted.pose_odom_base @ SE2(0.45, -0.4, 0.2))
    match = components.matcher.match(components.deskew(scans[2], predicted), off, components.local_map)
    away = room_drive.truth[scans[2].stamp_ns].inverse() @ match.motion.pose_odom_base
    assert math.hypot(away.x_m, away.y_m) < 0.03
    assert abs(away.theta_rad) < 0.01
