"""A drive through the office and its map, made once for all tests that begin with one."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from drivers.frames import Frame
from service.geometry.poses import Floats, points_from
from service.geometry.se2 import SE2
from service.mapper.maps.occupancy import rendered_of
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, mapping_config
from service.mapper.saved_graph import SavedGraph, small_arrays
from service.outputs import MapperOutput
from simulators.world import World, make_world
from simulators.worlds import WORLDS
from simulators.worlds.office import START, office_plan
from tests.simulated import LMS100_50HZ, Drive, Laser, Wheels, drive, run

LASER = replace(LMS100_50HZ, rate_hz=12.5)
COARSE = replace(
    LASER, beams=136, step_deg=2.0
)  # a quarter of the beams, for what searches with each of them
MAPPED_S = 30.0


def through(world: str, seconds: float, seed: int, stand_s: float = 0.5, laser: Laser = LASER) -> Drive:
    """The path of a world from its start on, or from a later moment where stand_s is below 0."""
    return drive(WORLDS[world](), laser, seconds, seed, Wheels(), stand_s=stand_s)


@cache
def mapped_office() -> tuple[Drive, BeginIn]:
    """Half a lap, and its map. No one can write into the arrays of its graph."""
    made = through("office", MAPPED_S, 3)
    mapper = run(mapping_config(), made).mapper
    graph = mapper.finish().update.saved
    assert isinstance(graph, SavedGraph)
    for array in (*small_arrays(graph).values(), graph.xy_base, graph.normals):
        array.flags.writeable = False
    return made, BeginIn(graph, rendered_of(mapper.changed_tiles()))


def office_with_box(middle: tuple[float, float], size_m: tuple[float, float]) -> World:
    """The office with one more box, its people and its drive; m in the plan."""
    plan, known = office_plan(), WORLDS["office"]()
    plan.box(middle, size_m)
    walls = make_world("office", plan, (), known.drive.seen_from(START.inverse()))
    return replace(walls, people=known.people, drive=known.drive)


def pose_plan_map() -> SE2:
    """Of the map of `mapped_office`."""
    return START @ mapped_office()[0].world_first


def in_plan(xy_map: Floats) -> Floats:
    return points_from(np.array(pose_plan_map()), xy_map)


def outputs_at_once(mapper: Mapper, frames: Iterable[Frame]) -> Iterator[MapperOutput]:
    """Results of the back end are applied before the next frame."""
    for frame in frames:
        output = mapper.process(frame)
        while mapper.graph.waiting:
            mapper.apply_result()
        if output is not None:
            yield output
