from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.fusion.estimator import Estimator, EstimatorConfig
from service.fusion.motion import Prediction
from service.geometry.se2 import SE2
from service.mapper.components import Components
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.graph.no_graph import NoGraph
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.methods.submap_graph.counted_submaps import CountedSubmaps, CountedSubmapsConfig
from service.mapper.methods.submap_graph.particle_filter import ParticleFilter, ParticleFilterConfig
from service.mapper.pipeline import Mapper
from service.outputs import MapperOutput
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, round_the_room
from tests.service.mapper.maps.points import square


def mapper(
    seed: int = 1, particles: int = 8, draw: Literal["laid", "around_scan"] = "laid"
) -> Mapper[CountedSubmaps]:
    return Mapper(
        Components(
            motion_model=Estimator(EstimatorConfig()),
            deskew=DeskewByTwist(BeamsConfig(), {"front": MOUNTING}),
            matcher=ParticleFilter(ParticleFilterConfig(seed=seed, draw=draw)),
            local_map=CountedSubmaps(CountedSubmapsConfig(particles=particles, length_m=2.0)),
            graph=NoGraph(),
            free_space=OccupancyTiles(OccupancyConfig(), 0.05),
        )
    )


@pytest.fixture(scope="module")
def short_drive() -> Drive:
    return drive(ROOM, round_the_room, 4.0, every=2)


def outputs_of(made: Mapper[CountedSubmaps], what: Drive) -> list[MapperOutput]:
    return [output for frame in what.frames if (output := made.process(frame)) is not None]


# D1, D2, D5
def test_a_room_is_followed_over_several_sub_maps(short_drive: Drive) -> None:
    outputs = outputs_of(mapper(), short_drive)
    away = [short_drive.truth[o.stamp_ns].inverse() @ o.pose_map_base for o in outputs]
    assert max(np.hypot(e.x_m, e.y_m) for e in away) < 0.05
    assert max(abs(e.theta_rad) for e in away) < 0.02
    assert {o.state for o in outputs} == {"ok"}
    assert all((np.linalg.eigvalsh(o.covariance) > 0.0).all() for o in outputs[1:])


def test_the_seed_decides_and_nothing_else(short_drive: Drive) -> None:
    first, again, other = (
        [o.pose_odom_base for o in outputs_of(mapper(seed, 4), short_drive)] for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other


# D2
def test_where_a_map_says_nothing_particles_are_drawn_from_motion_and_weigh_alike() -> None:
    matcher = ParticleFilter(ParticleFilterConfig(draw="around_scan"))
    submaps = CountedSubmaps(CountedSubmapsConfig(particles=200))
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.002], [0.0, 0.002, 0.01]])
    for particle in submaps.particles:
        particle.pose[2] = 0.7
    still = Prediction(SE2(), (0.0, 0.0, 0.0), covariance, covariance, np.zeros((3, 3)), 0.1, 0.0, True)
    matcher._move(SE2(0.1, 0.0, 0.0), covariance, submaps)
    matcher._lay(square(), still, submaps)
    weights = submaps.log_weights
    np.testing.assert_allclose(weights, weights[0], atol=1e-6)
    poses = np.array([particle.pose for particle in submaps.particles])
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(np.cov(poses.T), turn @ covariance @ turn.T, atol=0.015)
    np.testing.assert_allclose(poses.mean(axis=0), [0.1 * c, 0.1 * s, 0.7], atol=0.05)


# D2
def test_drawn_around_the_scan_a_room_is_followed_as_well(short_drive: Drive) -> None:
    outputs = outputs_of(mapper(draw="around_scan"), short_drive)
    away = [short_drive.truth[o.stamp_ns].inverse() @ o.pose_map_base for o in outputs]
    assert max(np.hypot(e.x_m, e.y_m) for e in away) < 0.05
    assert {o.state for o in outputs} == {"ok"}


# D1
def test_a_room_is_followed_without_wheels() -> None:
    what = drive(ROOM, round_the_room, 3.0, wheel_scale=None)
    outputs = outputs_of(mapper(particles=4), what)
    last = what.truth[outputs[-1].stamp_ns].inverse() @ outputs[-1].pose_map_base
    assert np.hypot(last.x_m, last.y_m) < 0.05
    assert abs(last.theta_rad) < 0.02


def test_wheels_that_say_forwards_for_backwards_are_found_out() -> None:
    what = drive(ROOM, round_the_room, 4.0, wheel_scale=-1.0)
    scans = [frame for frame in what.frames if isinstance(frame, LaserScan)][::12]
    wheels = [frame for frame in what.frames if isinstance(frame, OdometrySample)]
    few = replace(what, frames=sorted([*wheels, *scans], key=lambda frame: frame.arrived_ns))
    outputs = outputs_of(mapper(particles=4), few)
    last = what.truth[outputs[-1].stamp_ns].inverse() @ outputs[-1].pose_map_base
    assert np.hypot(last.x_m, last.y_m) < 0.10
    assert abs(last.theta_rad) < 0.05


def test_a_scan_without_returns_is_lost_and_draws_nothing(short_drive: Drive) -> None:
    made = mapper(particles=4)
    seen = outputs_of(made, short_drive)[-1]
    last = next(frame for frame in reversed(short_drive.frames) if isinstance(frame, LaserScan))
    blind = replace(
        last,
        stamp_ns=last.stamp_ns + 20_000_000,
        arrived_ns=last.arrived_ns + 20_000_000,
        range_m=np.full_like(last.range_m, np.nan),
    )
    drawn = made.counters["keyframes"]
    output = made.process(blind)
    assert output is not None
    assert output.state == "lost"
    assert "0 of" in output.reason
    moved = seen.pose_odom_base.inverse() @ output.pose_odom_base
    assert np.hypot(moved.x_m, moved.y_m) < 0.05
    assert made.counters["keyframes"] == drawn
