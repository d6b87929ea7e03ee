from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.fusion.estimator import Estimator, EstimatorConfig
from service.mapper.components import Components
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from service.mapper.graph.no_graph import NoGraph
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.methods.submap_graph.counted_submaps import CountedSubmaps, CountedSubmapsConfig
from service.mapper.methods.submap_graph.particle_filter import ParticleFilter, ParticleFilterConfig
from service.mapper.pipeline import Mapper
from service.outputs import MapperOutput
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, round_the_room


def mapper(seed: int = 1, particles: int = 8) -> Mapper[CountedSubmaps]:
    return Mapper(
        Components(
            motion_model=Estimator(EstimatorConfig()),
            deskew=DeskewByTwist(BeamsConfig(), {"front": MOUNTING}),
            matcher=ParticleFilter(ParticleFilterConfig(seed=seed)),
            local_map=CountedSubmaps(CountedSubmapsConfig(particles=particles, length_m=2.0)),
            graph=NoGraph(),
            free_space=OccupancyTiles(OccupancyConfig(), 0.05),
        )
    )


@pytest.fixture(scope="module")
def short_drive() -> Drive:
    return drive(ROOM, round_the_room, 4.0)


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
