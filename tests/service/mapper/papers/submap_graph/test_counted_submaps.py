import numpy as np

from service.geometry.se2 import SE2
from service.mapper.papers.submap_graph.counted_submaps import (
    CountedChange,
    CountedSubmaps,
    CountedSubmapsConfig,
)
from service.outputs import State
from tests.service.mapper.maps.points import match_at, points_of

CONFIG = CountedSubmapsConfig(
    particles=3, length_m=4.0, overlap_m=1.0, keyframe_distance_m=0.5, first_scans=1, cell_m=0.1
)
WALL = np.stack((np.full(41, 3.0), np.linspace(-2.0, 2.0, 41)), axis=1)


def drive(submaps: CountedSubmaps, x_m: float, stamp_ns: int = 0, state: State = "ok") -> CountedChange:
    """Every particle at the same place, and a wall 3 m ahead of it."""
    for particle in submaps.particles:
        particle.pose[:] = x_m, 0.0, 0.0
    points = points_of(WALL, stamp_ns)
    return submaps.insert(points, match_at(SE2(x_m, 0.0, 0.0), points, state))


# D4
def test_a_sub_map_is_closed_each_so_many_metres_and_the_next_begins_with_its_end() -> None:
    submaps = CountedSubmaps(CONFIG)
    changes = [drive(submaps, 0.5 * k, k) for k in range(20)]
    closed = [change.closed for change in changes if change.closed is not None]
    assert [one.number for one in closed] == [0, 1]
    np.testing.assert_allclose(closed[0].track[:, 0], np.arange(0.0, 4.5, 0.5))
    assert closed[0].carried == 0
    assert closed[1].carried == 3  # those of the last metre
    np.testing.assert_allclose(closed[1].track[:3, 0], [3.0, 3.5, 4.0])
    assert [scan.stamp_ns for scan in closed[1].scans] == list(range(6, 17))
    assert closed[1].track[-1, 0] == 8.0


# D2, D5
def test_a_particle_that_takes_over_has_the_map_and_the_path_of_the_other() -> None:
    submaps = CountedSubmaps(CONFIG)
    drive(submaps, 0.0)
    for k, particle in enumerate(submaps.particles):
        particle.pose[:] = 0.6, 0.2 * k, 0.0
    points = points_of(WALL, 1)
    submaps.insert(points, match_at(SE2(), points))
    submaps.take_over(np.array([0, 2, 2]))
    paths = [np.array(particle.track)[:, 1].tolist() for particle in submaps.particles]
    assert sorted(paths) == [[0.0, 0.0], [0.0, 0.4], [0.0, 0.4]]
    heir, other = (p for p in submaps.particles if p.track[-1][1] == 0.4)
    grids = [particle.map.grid() for particle in (heir, other)]
    slots = [np.array(particle.map.tiles())[:, 2] for particle in (heir, other)]
    np.testing.assert_array_equal(grids[0].hits[slots[0]], grids[1].hits[slots[1]])
    assert not set(slots[0].tolist()) & set(slots[1].tolist())
    heir.map.insert(WALL, np.zeros(2), np.array([1.0, 0.0, 0.0]))
    assert (grids[0].hits[slots[0]] != grids[1].hits[slots[1]]).any()  # from now on independent


# D8
def test_memory_stays_that_of_one_sub_map() -> None:
    submaps = CountedSubmaps(CONFIG)
    used = []
    for k in range(200):
        drive(submaps, 0.5 * k, k)
        used.append(submaps.tile_count)
    assert max(used[100:]) <= max(used[:20])
