"""A pallet was moved and a doorway closed since the office was mapped: reported there, and only there."""

import math
from dataclasses import replace

import numpy as np
import pytest

from service.mapper.map_changes import MapChanges
from service.mapper.maps.occupancy import rendered_of
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from service.mapper.saved_graph import SavedGraph
from simulators.world import Plan, World, make_world
from simulators.worlds import WORLDS
from simulators.worlds.office import START, office_plan
from tests.service.mapper.offices import outputs_at_once
from tests.simulated import FORWARD, LMS100_50HZ, Drive, Laser, Wheels, drive, run
from tests.soaked import in_soak

SECONDS = 36.0  # from the open plan along the lower corridor into the workshop
PALLET_M = (1.2, 0.8)
WAS, IS = (19.8, 2.4), (20.2, 10.3)  # middle of the pallet when the map was made, and later; m in the plan
DOOR, DOOR_M = (15.85, 3.2), (0.9, 0.12)  # a doorway of the lower corridor, closed later
NEAR_M = 0.25  # of the thing's rim
REPORTED_WITHIN_S = 10.0  # of the first scan that contradicted the map there
ASKED_EVERY_NS = 480_000_000


@pytest.fixture(scope="module", params=[8.0, in_soak(12.5), in_soak(25.0)], ids=["8 Hz", "12.5 Hz", "25 Hz"])
def laser(request: pytest.FixtureRequest) -> Laser:
    return replace(LMS100_50HZ, rate_hz=request.param)


def office(with_change: bool) -> World:
    plan = office_plan()
    plan.box(IS if with_change else WAS, PALLET_M)
    if with_change:
        plan.box(DOOR, DOOR_M)
    return peopled(plan)


def peopled(plan: Plan) -> World:
    """The office with its people and its drive, and other walls."""
    known = WORLDS["office"]()
    walls = make_world("office", plan, (), replace_start(known))
    return replace(walls, people=known.people, drive=known.drive)


def replace_start(known: World):
    """The drive of the office in the coordinates of the plan."""
    return known.drive.seen_from(START.inverse())


@pytest.fixture(scope="module")
def before(laser) -> tuple[Drive, BeginIn]:
    made = drive(office(with_change=False), laser, SECONDS, 3, Wheels())
    mapper = run(mapping_config(), made).mapper
    graph = mapper.finish().update.saved
    assert isinstance(graph, SavedGraph)
    return made, BeginIn(graph, rendered_of(mapper.changed_tiles()))


Driven = tuple[Mapper, dict[int, MapChanges]]  # and what was reported from time to time, by stamp


def driven_again(begin: BeginIn, again: Drive) -> Driven:
    mapper = build_mapper(mapping_config({"mode": "localization"}), {"front": FORWARD}, begin_in=begin)
    facts: dict[int, MapChanges] = {}
    asked_ns = 0
    for output in outputs_at_once(mapper, again.frames):
        if output.stamp_ns >= asked_ns and mapper.map_changes is not None:
            facts[output.stamp_ns], asked_ns = mapper.map_changes, output.stamp_ns + ASKED_EVERY_NS
    return mapper, facts


@pytest.fixture(scope="module")
def after(laser, before) -> Driven:
    return driven_again(before[1], drive(office(with_change=True), laser, SECONDS, 4, Wheels()))


def off_rim_m(xy_plan: np.ndarray, middle: tuple[float, float], size_m: tuple[float, float]) -> np.ndarray:
    """(N,) of points from the rim of a box without a turn."""
    beyond = np.abs(xy_plan - middle) - np.array(size_m) / 2.0
    outside = np.hypot(*np.maximum(beyond, 0.0).T)
    return np.where((beyond < 0.0).all(axis=1), -beyond.max(axis=1), outside)


def in_plan(first: Drive, xy_map: np.ndarray) -> np.ndarray:
    pose = START @ first.world_first
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    return xy_map @ np.array([[c, s], [-s, c]]) + (pose.x_m, pose.y_m)


def test_what_was_moved_and_closed_is_found_and_nothing_else(before, after):
    changes = after[0].map_changes
    assert changes is not None
    xy = in_plan(before[0], changes.xy_map)
    new, gone = xy[changes.is_new], xy[~changes.is_new]
    at_pallet, at_door = off_rim_m(new, IS, PALLET_M) < NEAR_M, off_rim_m(new, DOOR, DOOR_M) < NEAR_M
    assert at_pallet.sum() >= 10
    assert at_door.sum() >= 4
    assert (off_rim_m(gone, WAS, PALLET_M) < NEAR_M).sum() >= 10
    assert (~(at_pallet | at_door)).sum() == 0
    assert (off_rim_m(gone, WAS, PALLET_M) >= NEAR_M).sum() == 0


def test_each_change_is_reported_within_seconds_of_the_first_scan_that_contradicts(before, after):
    mapper, facts = after
    last = mapper.map_changes
    assert last is not None
    for middle, size_m, is_new in ((IS, PALLET_M, True), (DOOR, DOOR_M, True), (WAS, PALLET_M, False)):

        def there(changes: MapChanges, at=middle, size_m=size_m, is_new=is_new) -> np.ndarray:
            near = off_rim_m(in_plan(before[0], changes.xy_map), at, size_m) < NEAR_M
            return near & (changes.is_new == is_new)

        first_ns = int(last.first_ns[there(last)].min())
        reported_ns = min(stamp_ns for stamp_ns, changes in facts.items() if there(changes).any())
        assert 1.0 <= (reported_ns - first_ns) / 1e9 <= REPORTED_WITHIN_S  # not at once: people pass, too
    assert mapper.counters["changed_cells_new"] > 0
    assert mapper.counters["changed_cells_gone"] > 0
    shown = mapper.changes_reported
    assert shown is not None
    assert shown.is_new.sum() == mapper.counters["changed_cells_new"]
    assert (shown.as_grid().cells == 0).sum() == mapper.counters["changed_cells_gone"]


def test_nothing_is_reported_where_only_people_walk(laser, before):
    again = drive(office(with_change=False), laser, SECONDS, 5, Wheels())
    mapper, _ = driven_again(before[1], again)
    changes = mapper.map_changes
    assert changes is not None
    assert len(changes.xy_map) == 0
