"""A drive through the office and its map, made once for all tests that begin with one."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache

from drivers.frames import Frame
from service.mapper.maps.occupancy import rendered_of
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, mapping_config
from service.mapper.saved_graph import SavedGraph, small_arrays
from service.outputs import MapperOutput
from simulators.worlds import WORLDS
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


def outputs_at_once(mapper: Mapper, frames: Iterable[Frame]) -> Iterator[MapperOutput]:
    """Results of the back end are applied before the next frame."""
    for frame in frames:
        output = mapper.process(frame)
        while mapper.graph.waiting:
            mapper.apply_result()
        if output is not None:
            yield output
