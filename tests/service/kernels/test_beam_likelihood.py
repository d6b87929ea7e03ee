import math

import numpy as np
import pytest

from service.kernels import beam_likelihood
from service.kernels.beam_likelihood import (
    AT_BACK,
    FREE_DENSITY,
    MIN_LOG_RATIO,
    MIN_REMOVED_PROBABILITY,
    ON_POINT,
    ON_WALL,
    POINT_CELL_M,
    POINT_SIGMA_M,
    UNKNOWN_DENSITY,
    WALL_SIGMA_M,
    KnownGround,
    cells_with_walls,
    count_beams_through,
    splat_points,
)
from service.kernels.occupancy import Evidence, trace_scan
from service.kernels.surfels import insert_surfels
from tests.service.kernels.grids import empty_grid, empty_occupancy
from tests.service.kernels.inner import from_python

weigh_ends = from_python(beam_likelihood.weigh_ends)
weigh_paths = from_python(beam_likelihood.weigh_paths)

EVIDENCE = Evidence(hit=24, miss=-10, least=-70, most=70)
CELL_M = 0.1
WALL_X_M = 3.05  # in the middle of a cell
SENSOR = (0.0, 0.0)
FIRST = -200  # row and column of the cells of points: 10 m to each side


def mapped(seen_through: bool = False) -> KnownGround:
    """A wall across x = 3.05 m from y = -1.5 to 1.5 m, seen from the origin; later beams pass through it."""
    y = np.arange(-1.5, 1.5, 0.002)
    xy = np.column_stack((np.full(len(y), WALL_X_M), y))
    walls, ground = empty_grid(), empty_occupancy(CELL_M)
    insert_surfels(xy, np.tile([-1.0, 0.0, 1.0], (len(y), 1)), np.zeros(3), walls, 50.0, 1.0, np.zeros(2), -1)
    trace_scan(xy, np.zeros(2), np.zeros(3), ground, EVIDENCE, 20.0, np.uint16(1))
    points = np.zeros((400, 400), np.uint8)
    splat_points(xy, FIRST, FIRST, points)
    through_count = np.zeros(walls.surfels.shape[:4], np.float32)
    visited = np.zeros(walls.surfels.shape[:3], np.int32)
    known = KnownGround(
        walls, cells_with_walls(walls), through_count, ground, -10, points, FIRST, FIRST, visited
    )
    if seen_through:
        beyond = np.column_stack((np.full(401, 4.5), np.linspace(-2.0, 2.0, 401)))
        for _ in range(10):
            count_beams_through(beyond, np.zeros(2), walls, 1.0, through_count)
    return known


def ratios(ends, known: KnownGround, pose=(0.0, 0.0, 0.0), sensor=SENSOR, normal=(-1.0, 0.0), number=1):
    """Of beams from one sensor to some ends, all as the map has them; from a base with a pose in it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    here = (np.atleast_2d(ends) - pose[:2]) @ turn
    sensors = np.tile((np.array(sensor) - pose[:2]) @ turn, (len(here), 1))
    normals = np.tile([*(np.array(normal) @ turn), 1.0], (len(here), 1))
    at_end, along_beam = np.empty(len(here)), np.empty(len(here))
    weigh_ends(here, normals, np.array(pose), known, at_end)
    total = weigh_paths(here, sensors, np.array(pose), known, number, -math.inf, along_beam)
    assert total == pytest.approx(along_beam.sum())
    assert (along_beam <= 0.0).all()
    return at_end + along_beam


def ratio_by_hand(off_m: float, ground: float, on_points: float) -> float:
    wall = ON_WALL * math.exp(-0.5 * (off_m / WALL_SIGMA_M) ** 2) / (math.sqrt(2.0 * math.pi) * WALL_SIGMA_M)
    points = ON_POINT * on_points / (math.sqrt(2.0 * math.pi) * POINT_SIGMA_M)
    return math.log((ground + wall + points) / UNKNOWN_DENSITY)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.7, -0.4, 2.2)])
@pytest.mark.parametrize("off_m", [0.003, 0.02, -0.04])
def test_a_beam_that_ends_on_a_wall_has_the_likelihood_of_its_noise(off_m, pose):
    known = mapped()
    end = WALL_X_M + off_m, 0.325
    cell = [math.floor(value / POINT_CELL_M) - FIRST for value in end]
    on_points = known.points[cell[1], cell[0]] / 255.0
    assert ratios(end, known, pose)[0] == pytest.approx(
        ratio_by_hand(off_m, UNKNOWN_DENSITY, on_points), abs=0.02
    )


@pytest.mark.parametrize(
    ("end", "density"),
    [((-2.0, 0.0), UNKNOWN_DENSITY), ((1.55, 0.05), FREE_DENSITY), ((WALL_X_M - 0.1, 0.0), UNKNOWN_DENSITY)],
)
def test_a_beam_that_ends_on_no_wall_has_the_density_of_the_ground(end, density):
    ratio = ratios(end, mapped(), normal=(0.0, 1.0))[0]
    assert ratio == pytest.approx(math.log(density / UNKNOWN_DENSITY), abs=0.1)
    assert (ratio < MIN_LOG_RATIO) == (density == FREE_DENSITY)


def test_a_wall_seen_from_its_other_side_may_be_as_thick_as_walls_are():
    known = mapped()
    for thick_m, is_likely in ((0.02, True), (0.09, True), (0.45, False)):
        end = WALL_X_M + thick_m, 0.0
        ratio = ratios(end, known, sensor=(6.0, 0.0), normal=(1.0, 0.0))[0]
        assert (ratio > math.log(1.0 + AT_BACK / UNKNOWN_DENSITY) - 0.1) == is_likely


@pytest.mark.parametrize(("sensor", "end"), [((0.0, 0.0), (4.5, 0.0)), ((6.0, 0.05), (-2.0, 0.05))])
def test_no_beam_goes_through_a_wall_from_whichever_side(sensor, end):
    ratio = ratios(end, mapped(), sensor=sensor)[0]
    assert ratio == pytest.approx(math.log(MIN_REMOVED_PROBABILITY), abs=0.02)


def test_a_removed_wall_counts_once_for_all_beams():
    known = mapped()
    one = ratios((4.5, 0.0), known, number=1)
    many = ratios([(4.5, 0.001 * k) for k in range(10)], known, number=2)
    assert many.sum() == pytest.approx(one.sum())
    assert ratios((4.5, 0.0), known, number=3) == pytest.approx(one)  # at another pose it counts again


def test_a_beam_through_a_wall_that_the_map_saw_removed_costs_little():
    known = mapped(seen_through=True)
    assert -1.5 < ratios((4.5, 0.0), known)[0] < -0.05
    assert ratios((4.5, 0.0), mapped())[0] < -3.0
