import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, plan_drive
from simulators.world import Plan, World, make_world, walk

NO_PEOPLE = np.empty((0, 5))


def world_of(plan: Plan, people=()) -> World:
    return make_world("test", plan, people, plan_drive(SE2(), []))


def range_along(world: World, x_m: float, y_m: float, angle_deg: float) -> float:
    ray = np.array([[x_m, y_m, math.radians(angle_deg), 0.0]])
    return float(world.cast(ray, NO_PEOPLE, 100.0)[0][0])


def test_wall_has_two_faces_and_a_gap():
    plan = Plan()
    plan.wall((5, -3), (5, 3), gaps=[(2.5, 3.5)], thickness=0.2)
    world = world_of(plan)
    assert range_along(world, 0, 2, 0) == pytest.approx(4.9)
    assert range_along(world, 10, 2, 180) == pytest.approx(4.9)
    assert range_along(world, 0, 0, 0) == math.inf
    assert range_along(world, 5, 0, 90) == pytest.approx(0.5)  # the jamb


def test_sunk_door_recedes_to_the_left():
    plan = Plan()
    plan.sunk_doors((0, 2), (10, 2), [4.0], depth=0.25, width=1.0)
    world = world_of(plan)
    assert range_along(world, 4.5, 0, 90) == pytest.approx(2.25)
    assert range_along(world, 3.5, 0, 90) == pytest.approx(2.0)


def test_turned_box_and_post_stand_where_they_were_put():
    plan = Plan()
    plan.box((4, 0), (1.0, 1.0), turn_deg=45.0)
    plan.post((0, 4), 0.5)
    world = world_of(plan)
    assert range_along(world, 0, 0, 0) == pytest.approx(4 - math.sqrt(0.5))
    assert range_along(world, 0, 0, 90) == pytest.approx(3.5)


def test_world_is_in_the_frame_of_the_start_of_the_drive():
    plan = Plan()
    plan.line((10, 0), (10, 5))
    start = SE2(7.0, 2.0, math.pi / 2)
    person = walk([(7.0, 4.0), (9.0, 4.0)], 20.0)
    world = make_world("test", plan, [person], plan_drive(start, [Follow([(7, 4)])]))
    np.testing.assert_allclose(world.drive.poses(np.zeros(1)), 0.0, atol=1e-12)
    assert range_along(world, 0, 0, -90) == pytest.approx(3.0)
    np.testing.assert_allclose(world.discs(0.0, 0.02)[0, :2], [2.0, 0.0], atol=1e-12)


def test_person_who_begins_later_stands_at_the_first_place_before():
    person = walk([(0, 0), (4, 0)], 6.0, speed_mps=2.0)
    later = person.later(5.0)
    assert person.place(-0.5) == later.place(-0.5) == later.place(4.9) == (0.0, 0.0)
    assert later.place(6.0) == person.place(1.0) == (2.0, 0.0)
    assert later.period_s == 11.0


def test_discs_move_with_their_people():
    world = world_of(plan_with_a_wall(), people=[walk([(0, 0), (4, 0)], 20.0, speed_mps=2.0)])
    np.testing.assert_allclose(world.discs(1.0, 0.015), [[2.0, 0.0, 2.0, 0.0, 0.25]])


def test_walk_longer_than_its_period_is_refused():
    with pytest.raises(ValueError, match=r"takes 22\.0 s, its period is 20\.0 s"):
        walk([(0, 0), (10, 0)], 20.0)


def plan_with_a_wall() -> Plan:
    plan = Plan()
    plan.line((-9, 9), (9, 9))
    return plan
