import numpy as np
import pytest

from simulators.world import World
from simulators.worlds import WORLDS, build_world
from tests.simulated import begun_at

VEHICLE_RADIUS_M = 0.3
PEOPLED = ("crowd", "mall", "office")


@pytest.fixture(scope="module", params=sorted(WORLDS))
def world(request: pytest.FixtureRequest) -> World:
    return build_world(request.param)


def test_drive_starts_at_the_origin_and_goes_on_for_ever(world: World):
    np.testing.assert_allclose(world.drive.poses(np.zeros(1)), 0.0, atol=1e-12)
    assert world.drive.repeats


def test_people_walk_as_in_the_world():
    assert {name for name in WORLDS if build_world(name).people} == set(PEOPLED)


@pytest.mark.parametrize("name", PEOPLED)
def test_people_keep_clear_of_the_vehicle(name: str):
    world = build_world(name)
    time_s = np.arange(-10.0, 2 * world.drive.duration_s, 0.2)
    places = world.drive.poses(time_s)[:, :2]
    for person in world.people:
        gap = np.array([person.place(t) for t in time_s]) - places
        assert np.hypot(*gap.T).min() - person.radius_m > VEHICLE_RADIUS_M + 0.3


def test_building_is_closed(world: World):
    angles = np.linspace(-np.pi, np.pi, 50)
    for x, y in world.drive.poses(np.linspace(0.0, world.drive.duration_s, 40))[:, :2]:
        rays = np.column_stack([np.full(50, x), np.full(50, y), angles, np.zeros(50)])
        range_m, _ = world.cast(rays, np.empty((0, 5)), 500.0)
        assert np.isfinite(range_m).all(), (x, y)


def test_office_is_shown_in_a_minute():
    office = build_world("office")
    width, height = np.ptp(office.segments.reshape(-1, 2), axis=0)
    assert 280.0 < width * height < 340.0
    assert 45.0 < office.drive.duration_s < 58.0
    assert len(office.people) >= 3


def test_mall_has_twelve_thousand_square_metres():
    width, height = np.ptp(build_world("mall").segments.reshape(-1, 2), axis=0)
    assert width * height == pytest.approx(12000.0, rel=0.03)


def test_unknown_world_is_refused_with_the_known_names():
    with pytest.raises(ValueError, match=r"no world 'moon'; there are corridor100, crowd, .*, ring"):
        build_world("moon")


@pytest.mark.parametrize("turned_rad", [0.0, 2.0])
def test_crowd_stays_within_three_metres_while_the_vehicle_drives(turned_rad):
    crowd = begun_at(build_world("crowd"), turned_rad)
    time_s = np.arange(0.0, crowd.drive.duration_s - 40.0, 0.5)
    here = crowd.drive.poses(time_s)[:, :2]
    gaps_m = [np.hypot(*(np.array([p.place(t) for t in time_s]) - here).T) for p in crowd.people]
    assert len(gaps_m) == 5
    assert np.max(gaps_m) < 3.0
    assert np.min(gaps_m) > 0.6  # of the vehicle
