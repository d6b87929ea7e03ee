"""The profile `owolm_eskf` as a whole, on small drives whose truth is known."""

import math

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


def test_a_drive_round_a_room_is_followed_with_an_imu(room_drive):  # B14 B33
    outputs = outputs_of(mapper_of("owolm_eskf"), with_imu(room_drive.frames, round_the_room, 4.0))
    away = errors(outputs, room_drive.truth)
    assert {o.state for o in outputs} == {"ok"}
    assert np.hypot(away[:, 0], away[:, 1]).max() < 0.06
    assert np.degrees(np.abs(away[:, 2]).max()) < 0.5


def test_the_map_lies_along_the_walls_and_odom_at_the_start(room_drive):  # B3 B18
    """Turning the laser's mounting in the config is the same as starting at an angle."""
    for turn_rad in (0.0, 0.5):
        mounting = SE2(MOUNTING.x_m, MOUNTING.y_m, MOUNTING.theta_rad + turn_rad)
        mapper = mapper_of("owolm_eskf", mounting)
        first = outputs_of(mapper, room_drive.frames[:30])[0]
        assert first.pose_odom_base == SE2()
        local_map = mapper.components.local_map
        assert local_map.pose_axes_odom.theta_rad == pytest.approx(-turn_rad, abs=0.006)


def test_along_a_bare_corridor_wheels_and_imu_say_how_far_it_was_and_the_state_says_so():
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
