"""Posts: their middle is the same from all sides, and a wood is mapped by them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.geometry.se2 import SE2
from service.mapper.components import Points
from service.mapper.profiles import mapping_config
from service.mapper.scan_match.posts import posts_of, walls_seen
from simulators.trajectory import Follow, plan_drive
from simulators.truth import LMS100
from simulators.world import Plan, World, make_world
from tests.simulated import Laser, Wheels, drive, run

FIRST_RAD, STEP_RAD, BEAMS = -2.0, math.radians(0.5), 459
FAR_M = 15.0
SIGMA_M = 0.012


def seen(posts: list[tuple[float, float, float]], wall_m: float = math.inf) -> Points:
    """What stands at the origin sees of circles (x, y, radius) m, and of a wall across at x = wall_m."""
    noise = np.random.default_rng(3)
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    c, s = np.cos(angle), np.sin(angle)
    range_m = np.where(c > 0.0, wall_m / np.maximum(c, 1e-9), math.inf)
    for x, y, radius in posts:
        ahead, beside = c * x + s * y, -s * x + c * y
        hit = (np.abs(beside) < radius) & (ahead > 0.0)
        front = ahead - np.sqrt(np.maximum(radius**2 - beside**2, 0.0))
        range_m = np.where(hit & (front < range_m), front, range_m)
    range_m = range_m + SIGMA_M * noise.standard_normal(BEAMS)
    beam = np.flatnonzero(range_m < FAR_M).astype(np.int32)
    xy = np.column_stack((range_m * c, range_m * s))[beam]
    scan = LaserScan(
        "front", 0, 0, 0, 20_000_000, FIRST_RAD, STEP_RAD, 0.05, FAR_M,
        np.where(range_m < FAR_M, range_m, np.nan).astype(np.float32), NO_INTENSITY,
    )  # fmt: skip
    return Points(xy, xy, np.zeros(len(xy)), beam, SE2(), scan, SIGMA_M)


def found(points: Points) -> np.ndarray:
    has_posts = walls_seen(points, np.zeros(1)).has_posts
    return posts_of(points).xy_raw if has_posts else np.zeros((0, 2))


@pytest.mark.parametrize("radius_m", [0.06, 0.12, 0.25])
@pytest.mark.parametrize("bearing_deg", [-90.0, 0.0, 40.0])
def test_the_middle_of_a_post_is_found_from_every_side(radius_m: float, bearing_deg: float):
    bearing = math.radians(bearing_deg)
    middle = 4.0 * math.cos(bearing), 4.0 * math.sin(bearing)
    (xy,) = found(seen([(*middle, radius_m)]))
    assert math.hypot(xy[0] - middle[0], xy[1] - middle[1]) < 0.03


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_stands_half_behind_another_or_at_the_edge_of_the_view_is_left_out(side: float):
    whole = [(3.0 * math.cos(bearing), 3.0 * math.sin(bearing), 0.2) for bearing in (-1.2, -0.6, 0.0, 0.6)]
    behind = (6.0, side * 0.35, 0.2)
    edge_rad = FIRST_RAD if side > 0.0 else FIRST_RAD + STEP_RAD * (BEAMS - 1)
    edge = (4.0 * math.cos(edge_rad), 4.0 * math.sin(edge_rad), 0.2)
    xy = found(seen([*whole, behind, edge]))
    assert xy == pytest.approx(np.array(whole)[:, :2], abs=0.03)


def test_returns_that_are_missing_here_and_there_do_not_divide_a_post():
    whole = [(3.0 * math.cos(bearing), 3.0 * math.sin(bearing), 0.3) for bearing in (-1.2, -0.6, 0.0, 0.6)]
    points = seen(whole)
    is_kept = points.beam % 7 != 0
    points = points._replace(
        xy_raw=points.xy_raw[is_kept],
        xy_base=points.xy_base[is_kept],
        beam_time_s=points.beam_time_s[is_kept],
        beam=points.beam[is_kept],
    )
    assert found(points) == pytest.approx(np.array(whole)[:, :2], abs=0.06)


def on_each_second_beam(points: Points) -> Points:
    """As a LUX has it, which reduces its layers to a grid twice as fine as it measures."""
    scan = points.scan
    range_m = np.full(2 * len(scan.range_m) - 1, np.nan, np.float32)
    range_m[::2] = scan.range_m
    scan = replace(scan, angle_step_rad=scan.angle_step_rad / 2.0, range_m=range_m)
    return points._replace(beam=2 * points.beam, usual_gap=2, scan=scan)


def test_a_wall_seen_on_each_second_beam_is_no_row_of_posts():
    assert not walls_seen(on_each_second_beam(seen([], wall_m=3.0)), np.zeros(1)).has_posts


def wood() -> World:
    """Trunks on 70 x 30 m, and a drive of 40 m between them."""
    rng = np.random.default_rng(4)
    plan, standing = Plan(), 0
    while standing < 150:
        x, y = rng.uniform((-15.0, -15.0), (55.0, 15.0))
        if abs(y) > 1.2:
            plan.post((float(x), float(y)), float(rng.uniform(0.06, 0.25)))
            standing += 1
    return make_world("wood", plan, [], plan_drive(SE2(), [Follow([(40.0, 0.0)])]))


def test_a_wood_is_mapped_by_its_trunks():
    laser = Laser(LMS100, 541, 5.0, -135.0, 0.5)
    poor = Wheels(scale=1.05, turn_scale=0.95, sigma_m_per_sqrt_m=0.03, sigma_rad_per_sqrt_m=0.02)
    made = drive(wood(), laser, 41.0, 12, poor)
    done = run(mapping_config(), made)
    assert done.position_rmse_m < 0.05  # 0.016; without posts 0.26, and 0.59 of the scans ok
    assert np.mean([output.state == "ok" for output in done.outputs]) > 0.9
    curve_m = done.mapper.components.matcher.bias_m(laser.name)
    assert np.abs(curve_m).max() < 0.002  # the ranges are right; by the chords of trunks 6 mm are learnt


def test_where_walls_are_in_view_posts_are_not_asked():
    assert len(found(seen([(2.0, 0.5, 0.15)], wall_m=3.0))) == 0
