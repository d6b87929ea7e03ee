"""The corner that is meant by a click near it; what is no corner is none."""

import math
from itertools import product

import numpy as np

from tests.browser.test_edit import click_map, offset_of, pick_at, unchanged, unchanged_view  # noqa: F401 - fixtures

NOISE_M = 0.008
AT = np.array([3.0, -2.0])
FAR_AWAY = AT + np.array([2.0, 2.0])


def wall(angle_rad, from_m=0.05, to_m=0.5, step_m=0.03):
    """Points of a wall that leads away from AT, beginning from_m from it."""
    distance_m = np.arange(from_m, to_m, step_m)[:, None]
    return AT + distance_m * np.array([math.cos(angle_rad), math.sin(angle_rad)])


def corner_of(page, points, about=AT):
    noise = np.random.default_rng(1).normal(0.0, NOISE_M, points.shape)
    return page.of_module("corners.js", "m.cornerNear(...a)", (points + noise).tolist(), about.tolist())


def test_two_walls_meet_where_no_point_lies(still):
    off_m = {}
    for turn_rad, angle_deg in product((0.0, 1.0), (90, 50, 140, -75)):
        angle_rad = math.radians(angle_deg)
        points = np.concatenate((wall(turn_rad), wall(turn_rad + angle_rad), [FAR_AWAY]))
        corner = corner_of(still, points, AT + 0.3 * np.array([math.cos(turn_rad), math.sin(turn_rad)]))
        assert corner is not None, (turn_rad, angle_deg)
        off_m[turn_rad, angle_deg] = np.hypot(*(np.array(corner) - AT)) * abs(math.sin(angle_rad))
    assert {case: off for case, off in off_m.items() if off >= 0.02} == {}


ROUND_RAD = np.linspace(0.0, math.pi, 30)[:, None]
NO_CORNERS = {
    "straight": np.concatenate((wall(0.0), wall(math.pi))),
    "hardly bent": np.concatenate((wall(0.0), wall(math.pi - math.radians(20)))),
    "walls apart": np.concatenate((wall(0.0), wall(math.pi / 2, from_m=0.3))),
    "one wall": wall(0.0),
    "three points": wall(0.0)[:3],
    "a column": AT + 0.25 * np.hstack((np.cos(ROUND_RAD), np.sin(ROUND_RAD))),
    "a bush": np.random.default_rng(3).uniform(-0.4, 0.4, (40, 2)) + AT,
}


def test_what_is_no_corner_is_none(still):
    found = {name: corner_of(still, points) for name, points in NO_CORNERS.items()}
    assert found == dict.fromkeys(NO_CORNERS)


def test_a_click_beside_a_corner_means_the_corner_and_one_on_a_wall_a_point(unchanged, bent):  # noqa: F811
    page, k, corner, beside = unchanged, 40, np.array([15.0, -1.0]), np.array([14.92, -0.9])
    pick_at(page, bent, k)
    page.look_at(*corner, 150.0)
    dx, dy = offset_of(page, *beside)
    page.pointer().move_to_element_with_offset(page.element("map"), dx, dy).perform()
    assert page.run("return corridor.edit.tool.aimed.isCorner")
    begin = int(bent.graph.point_count[:k].sum())
    points = bent.graph.xy_base[begin : begin + int(bent.graph.point_count[k])] + bent.graph.map[k, :2]
    on_wall = next(p for p in points if abs(p[1] + 1.0) < 0.03 and 13.0 < p[0] < 14.0)
    for clicked, meant, is_corner in ((beside, corner, True), (on_wall, on_wall, False)):
        click_map(page, *clicked)
        picked = page.run("return corridor.edit.tool.found.a")
        assert picked["isCorner"] is is_corner
        assert np.hypot(*(np.array(picked["at"]) - meant)) < 0.02
        page.run("corridor.edit.tool.back()")
