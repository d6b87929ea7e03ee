"""The profile `owolm_eskf` as a whole, on small drives whose truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import MapperOutput
from tests.service.mapper.drives import (
    CORRIDOR,
    MOUNTING,
    ROOM,
    down_the_corridor,
    drive,
    round_the_room,
)
from tests.soaked import in_soak

IMU_NS = 5_000_000


def new_mapper(**settings: dict) -> Mapper:
    return build_mapper(mapping_config({"profile": "owolm_eskf", "settings": settings}), {"front": MOUNTING})


def run(frames: list[Frame], mapper: Mapper) -> list[MapperOutput]:
    return [output for frame in frames if (output := mapper.process(frame)) is not None]


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
    scans = [frame for frame in frames if isinstance(frame, LaserScan)]
    return sorted([*scans, *samples], key=lambda frame: frame.arrived_ns)


def errors(outputs: list[MapperOutput], truth: dict[int, SE2]) -> np.ndarray:
    away = [truth[o.stamp_ns].inverse() @ o.pose_map_base for o in outputs]
    return np.array([(e.x_m, e.y_m, e.theta_rad) for e in away])


@pytest.fixture(scope="module")
def room_drive():
    return drive(ROOM, round_the_room, 4.0)


@pytest.mark.parametrize("source", ["imu", in_soak("wheels"), "nothing"])
def test_a_drive_round_a_room_is_followed_to_centimetres(room_drive, source):  # B14 B33
    frames = {
        "imu": with_imu(room_drive.frames, round_the_room, 4.0),
        "wheels": room_drive.frames,
        "nothing": [frame for frame in room_drive.frames if isinstance(frame, LaserScan)],
    }[source]
    outputs = run(frames, new_mapper())
    away = errors(outputs, room_drive.truth)
    assert {o.state for o in outputs} == {"ok"}
    assert np.hypot(away[:, 0], away[:, 1]).max() < 0.06
    assert np.degrees(np.abs(away[:, 2]).max()) < 0.5


def test_the_map_lies_along_the_walls_and_odom_at_the_start(room_drive):  # B3 B18
    """Turning the laser's mounting in the config is the same as starting at an angle."""
    for turn_rad in (0.0, 0.5):
        mounting = SE2(MOUNTING.x_m, MOUNTING.y_m, MOUNTING.theta_rad + turn_rad)
        mapper = build_mapper(mapping_config({"profile": "owolm_eskf"}), {"front": mounting})
        first = run(room_drive.frames[:30], mapper)[0]
        assert first.pose_odom_base == SE2()
        local_map = mapper.components.local_map
        assert local_map.pose_axes_odom.theta_rad == pytest.approx(-turn_rad, abs=0.006)


def test_levels_differ_by_the_ratio_and_all_take_every_scan(room_drive):  # B16 B17
    for ratio in (2, 4, 5):
        mapper = new_mapper(local_map={"ratio": ratio})
        run(room_drive.frames[:10], mapper)
        layers = mapper.components.local_map.search_layers()
        assert [round(layer.cell_m / 0.025) for layer in layers] == [1, ratio, ratio**2]
        assert all(layer.cells.max() > 0 for layer in layers)


def test_the_pyramid_finds_a_start_that_is_far_off(room_drive):  # B16
    scans = [frame for frame in room_drive.frames if isinstance(frame, LaserScan)]
    wide = {"least_window_m": 0.6, "least_window_rad": 0.3}
    mapper = new_mapper(matcher=wide)
    run(scans[:2], mapper)
    components = mapper.components
    predicted = components.motion_model.predict(scans[2].stamp_ns)
    off = replace(predicted, pose_odom_base=predicted.pose_odom_base @ SE2(0.45, -0.4, 0.2))
    match = components.matcher.match(components.deskew(scans[2], predicted), off, components.local_map)
    away = room_drive.truth[scans[2].stamp_ns].inverse() @ match.motion.pose_odom_base
    assert math.hypot(away.x_m, away.y_m) < 0.03
    assert abs(away.theta_rad) < 0.01


def test_segments_weigh_more_than_the_rest(room_drive):  # B22 B26 B27
    def mass(**local_map) -> float:
        mapper = new_mapper(local_map=local_map)
        run(room_drive.frames[:30], mapper)
        return float(mapper.components.local_map.occupied()[1].sum())

    assert mass() > 1.5 * mass(weigh_segments=False)


def test_along_a_bare_corridor_wheels_and_imu_say_how_far_it_was_and_the_state_says_so():
    """Wheels 1 % off; the dots of the walls, which every scan sees alike, would hold the pose back."""
    long = drive(CORRIDOR, down_the_corridor, 6.0)
    wheels = [frame for frame in long.frames if isinstance(frame, OdometrySample)]
    frames = [*with_imu(long.frames, down_the_corridor, 6.0), *wheels]
    outputs = run(sorted(frames, key=lambda frame: frame.arrived_ns), new_mapper())
    away = errors(outputs, long.truth)
    path_length_m = long.truth[outputs[-1].stamp_ns].x_m
    assert np.abs(away[:, 0]).max() < 0.02 * path_length_m
    assert np.abs(away[:, 1]).max() < 0.03
    assert outputs[-1].state == "degraded"
    assert "does not fix the position along the direction" in outputs[-1].reason


@pytest.mark.parametrize("source", [in_soak("imu"), in_soak("wheels"), "nothing"])
def test_along_a_bare_corridor_the_state_is_not_ok_and_the_covariance_covers_the_error(source):
    """Without a second witness of the motion the dots of the walls may still hold the pose back."""
    long = drive(CORRIDOR, down_the_corridor, 6.0)
    frames = {
        "imu": with_imu(long.frames, down_the_corridor, 6.0),
        "wheels": long.frames,
        "nothing": [frame for frame in long.frames if isinstance(frame, LaserScan)],
    }[source]
    outputs = run(frames, new_mapper())
    away = errors(outputs, long.truth)
    is_off = np.abs(away[:, 0]) > 0.15
    assert not any(o.state == "ok" for o, off in zip(outputs, is_off, strict=True) if off)
    along = np.array([math.sqrt(o.covariance[0, 0]) for o in outputs])
    assert np.all(np.abs(away[:, 0]) < 3.0 * along + 0.05)
    assert "ok" not in {o.state for o in outputs[100:]}


def test_a_laser_covered_for_a_moment_is_degraded_and_the_imu_goes_on(room_drive):  # B13
    frames = with_imu(room_drive.frames, round_the_room, 4.0)
    stamps = sorted(room_drive.truth)
    dark = set(stamps[100:115])
    frames = [
        replace(f, range_m=np.full_like(f.range_m, np.nan))
        if isinstance(f, LaserScan) and f.stamp_ns in dark
        else f
        for f in frames
    ]
    outputs = run(frames, new_mapper())
    blank = [o for o in outputs if o.state == "degraded"]
    assert {o.stamp_ns for o in blank} == dark
    assert "0 of 541 beams returned" in blank[0].reason
    away = errors(outputs, room_drive.truth)
    assert np.hypot(away[:, 0], away[:, 1]).max() < 0.08
    assert outputs[-1].state == "ok"


def test_the_same_frames_give_the_same_bits(room_drive):
    frames = with_imu(room_drive.frames, round_the_room, 4.0)[:400]
    one, other = (run(frames, new_mapper()) for _ in range(2))
    assert [o.pose_odom_base for o in one] == [o.pose_odom_base for o in other]
    assert all(a.covariance.tobytes() == b.covariance.tobytes() for a, b in zip(one, other, strict=True))
