import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.maps.submaps import SubmapsConfig, SurfelSubmaps
from service.outputs import State
from tests.service.mapper.maps.points import match_at, points_of, square


def submaps(**changes: float) -> SurfelSubmaps:
    config = SubmapsConfig.model_validate({"first_scans": 1, "keyframe_distance_m": 0.5, **changes})
    return SurfelSubmaps(config)


def insert(chain: SurfelSubmaps, x_m: float, state: State = "ok", theta_rad: float = 0.0) -> int | None:
    points = square()
    candidates = chain.candidates
    submap = candidates[0].number if state != "lost" and candidates else None
    return chain.insert(points, match_at(SE2(x_m, 0.0, theta_rad), points, state, submap)).closed_submap


def surfel_count(chain: SurfelSubmaps, candidate: int = 0) -> float:
    """Points held by a candidate."""
    grid = chain.candidates[candidate].grid()
    slots = grid.tiles.slots[grid.tiles.slots >= 0]
    return float(grid.surfels[slots, :, :, :, 0].sum())


def test_before_the_first_scan_there_is_nothing_to_match_to() -> None:
    assert submaps().candidates == []


def test_the_older_of_two_is_matched_to_and_the_younger_takes_over() -> None:
    chain = submaps(spacing_m=2.0)
    numbers, closed = [], []
    for k in range(17):
        closed.append(insert(chain, 0.5 * k))
        numbers.append(chain.candidates[0].number)
    assert numbers == [0] * 8 + [1] * 4 + [2] * 4 + [3]
    assert [(k, number) for k, number in enumerate(closed) if number is not None] == [
        (8, 0),
        (12, 1),
        (16, 2),
    ]


def test_at_the_hand_over_the_new_one_is_already_filled() -> None:
    chain = submaps(spacing_m=2.0)
    for k in range(9):
        insert(chain, 0.5 * k)
    assert chain.candidates[0].number == 1
    assert chain.candidates[0].scan_count == 5
    assert surfel_count(chain) > 1000.0


def test_tiles_of_retired_submaps_go_back_to_the_pool() -> None:
    chain = submaps(spacing_m=2.0)
    counts = []
    for k in range(200):
        insert(chain, 0.5 * k)
        counts.append(chain.tile_count)
    assert max(counts[100:]) <= max(counts[:40])


def test_scans_between_key_frames_are_left_out() -> None:
    chain = submaps()
    insert(chain, 0.0)
    before = surfel_count(chain)
    insert(chain, 0.3)
    assert surfel_count(chain) == before
    insert(chain, 0.3, theta_rad=0.06)
    assert surfel_count(chain) > before


def test_a_young_map_takes_its_first_scans_even_standing() -> None:
    chain = submaps(first_scans=4)
    for _ in range(10):
        insert(chain, 0.0)
    assert chain.candidates[0].scan_count == 4


def test_a_lost_scan_goes_to_a_detached_submap_that_a_fit_drops() -> None:
    chain = submaps()
    insert(chain, 0.0)
    before = surfel_count(chain)
    insert(chain, 1.0, state="lost")
    assert [c.number for c in chain.candidates] == [0, 1]
    assert surfel_count(chain) == before
    assert surfel_count(chain, candidate=1) > 0.0
    tiles = chain.tile_count
    insert(chain, 1.2)
    assert [c.number for c in chain.candidates] == [0]
    assert chain.tile_count < tiles


def test_a_place_that_only_the_detached_submap_knows_replaces_the_old_one() -> None:
    chain = submaps()
    insert(chain, 0.0)
    insert(chain, 50.0, state="lost")
    points = square()
    change = chain.insert(points, match_at(SE2(50.6, 0.0, 0.0), points, "ok", submap=1))
    assert change.closed_submap == 0
    assert [c.number for c in chain.candidates] == [1]
    assert chain.candidates[0].scan_count == 2


def test_a_scan_without_returns_changes_nothing() -> None:
    chain = submaps()
    nothing = points_of(np.empty((0, 2)))
    for state in ("ok", "lost"):
        chain.insert(nothing, match_at(SE2(), nothing, state))  # type: ignore[arg-type]
    assert chain.candidates == []


@pytest.mark.parametrize("place", [(0.0, 0.0), (-1234.5, 876.5), (-0.05, -0.05)])
def test_a_room_is_the_same_wherever_it_stands(place: tuple[float, float]) -> None:
    chain = submaps()
    points = square()
    chain.insert(points, match_at(SE2(*place, 0.0), points))
    grid = chain.candidates[0].grid()
    found = []
    for row, column in np.argwhere(grid.tiles.slots >= 0):
        tile = grid.surfels[grid.tiles.slots[row, column]]
        for r, c, side in np.argwhere(tile[:, :, :, 0] > 0.0):
            x = ((column + grid.tiles.origin[1]) * 32 + c + 0.5) * 0.1 + tile[r, c, side, 1] - place[0]
            y = ((row + grid.tiles.origin[0]) * 32 + r + 0.5) * 0.1 + tile[r, c, side, 2] - place[1]
            found.append(max(abs(x), abs(y)))
    np.testing.assert_allclose(found, 2.0, atol=1e-5)
    assert len(found) > 100


def test_what_was_moved_away_is_forgotten_and_tiles_handed_back_know_nothing() -> None:
    chain = submaps(first_scans=20, spacing_m=0.5, keyframe_distance_m=0.01)
    room = square().xy_base
    box = np.where((np.abs(np.arctan2(room[:, 1], room[:, 0])) < 0.3)[:, None], 0.5 * room, room)
    for k, xy in enumerate([box] * 4 + [room] * 4):
        points = points_of(xy, stamp_ns=k * 50_000_000)
        chain.insert(points, match_at(SE2(), points, "ok", 0))
    grid = chain.candidates[0].grid()
    slots = grid.tiles.slots
    held = grid.surfels[slots[slots >= 0]][..., 0].sum()
    off = chain.candidates[0].weighed(points_of(box), np.ones((len(box), 3)), np.zeros(3))[:, 2]
    is_box = np.hypot(*box.T) < 1.5
    assert off[is_box].max() < 0.2 * off[~is_box].mean()
    assert 0 < held <= 8 * np.count_nonzero(~is_box) + 4 * np.count_nonzero(is_box)  # the box itself is gone
    oldest = chain.candidates[0]
    oldest.release()
    for sighted in chain._pool.arrays[2:]:
        assert not sighted[slots[slots >= 0]].any()


def test_where_all_is_rough_thicker_walls_will_do_and_else_they_will_not() -> None:
    """The same corner of noisy boxes, alone and with three clean walls beside it."""
    xy = square().xy_base
    noise = 0.03 * np.random.default_rng(3).standard_normal(len(xy))
    bearing = np.arctan2(xy[:, 1], xy[:, 0])
    rough = np.abs(bearing) < 2.4
    noisy = xy * (1.0 + np.where(rough, noise, 0.0) / np.hypot(xy[:, 0], xy[:, 1]))[:, None]
    strict = submaps(least_planar=0.0)

    def planar_share(chain: SurfelSubmaps, xy_base: np.ndarray) -> float:
        return float((chain.normals_of(points_of(xy_base))[:, 2] >= 1.0).mean())

    assert planar_share(strict, noisy[rough]) < 0.3
    assert planar_share(submaps(), noisy[rough]) > planar_share(strict, noisy[rough]) + 0.1
    assert planar_share(strict, noisy) > 0.3
    assert planar_share(submaps(), noisy) == planar_share(strict, noisy)
