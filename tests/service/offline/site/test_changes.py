"""Changes between sessions by the walls of each: a room of 10 m as evidence."""

import numpy as np
import pytest

from service.kernels.occupancy import GRID_TILE_CELLS
from service.mapper.components import RenderedMap
from service.mapper.maps.occupancy import EVIDENCE
from service.offline.site.changes import (
    FREE,
    MIN_CELLS,
    MIN_LOG_ODDS,
    OCCUPIED,
    Change,
    Layers,
    _Grid,
    log_odds_elsewhere,
)

CELL_M = 0.05
SIDE = 4 * GRID_TILE_CELLS  # cells, of four by four tiles around the origin
NO_TILES = np.zeros(0, np.int64)
CRATE = (slice(60, 70), slice(122, 134))  # rows and columns, across the edge of two tiles


def session(*walls: tuple[slice, slice], unknown: tuple[slice, slice] | None = None) -> RenderedMap:
    """Free ground within outer walls, and what stands on it."""
    evidence = np.full((SIDE, SIDE), FREE, np.int8)
    evidence[:3] = evidence[-3:] = evidence[:, :3] = evidence[:, -3:] = EVIDENCE.most
    for wall in walls:
        evidence[wall] = OCCUPIED
    if unknown is not None:
        evidence[unknown] = 0
    tiles = evidence.reshape(4, GRID_TILE_CELLS, 4, GRID_TILE_CELLS).swapaxes(1, 2).reshape(16, 64, 64)
    row, column = np.divmod(np.arange(16), 4)
    return RenderedMap(row - 2, column - 2, np.ascontiguousarray(tiles))


def layers_of(*sessions: RenderedMap) -> Layers:
    layers = Layers(CELL_M)
    for number, seen in enumerate(sessions):
        layers.add(number, seen, layers.compare(seen))
    return layers


def in_short(change: Change) -> tuple[bool, tuple[int, int], int]:
    return change.is_new, change.seen, change.session


def test_a_crate_that_was_put_down_and_taken_away_is_two_changes_with_their_sessions():
    layers = layers_of(session(), session(), session(CRATE), session(CRATE), session())
    assert [in_short(change) for change in layers.changes] == [(True, (0, 1), 2), (False, (2, 3), 4)]
    rows, columns = layers.changes[0].cells.T
    assert (rows.min(), rows.max()) == (60 - SIDE // 2, 69 - SIDE // 2)
    assert (columns.min(), columns.max()) == (122 - SIDE // 2, 133 - SIDE // 2)


def test_evidence_is_near_within_two_cells_also_across_tiles_and_nowhere_else():
    random = np.random.default_rng(3)
    tiles = np.array([(-3, 5), (-3, 6), (-2, 5), (-1, 7)])
    evidence = np.where(random.random((4, GRID_TILE_CELLS, GRID_TILE_CELLS)) < 0.02, OCCUPIED, FREE)
    grid = _Grid(tiles, evidence.astype(np.int8), tiles.min(axis=0), tiles.max(axis=0))
    low, high = tiles.min(axis=0) - 1, tiles.max(axis=0) + 2
    cells = random.integers(low * GRID_TILE_CELLS, high * GRID_TILE_CELLS, (4000, 2))
    corners = tiles[:, None] * GRID_TILE_CELLS + [(0, -1), (63, 64), (-2, 0), (-3, 0), (65, 66)]
    cells = np.concatenate((cells, corners.reshape(-1, 2)))
    away = np.abs(cells[:, None] - grid.walls).max(axis=2).min(axis=1)
    np.testing.assert_array_equal(grid.is_near(cells, OCCUPIED), away <= 2)


def test_a_session_that_saw_nothing_changes_nothing():
    nothing = RenderedMap(NO_TILES, NO_TILES, np.zeros((0, GRID_TILE_CELLS, GRID_TILE_CELLS), np.int8))
    layers = layers_of(nothing, session(), nothing, session(CRATE))
    assert [in_short(change) for change in layers.changes] == [(True, (1, 1), 3)]


def test_a_session_that_did_not_look_there_changes_nothing():
    around = (slice(50, 80), slice(112, 144))
    layers = layers_of(session(CRATE), session(unknown=around), session(CRATE))
    assert layers.changes == []
    layers = layers_of(session(CRATE), session(unknown=around), session())
    assert [in_short(change) for change in layers.changes] == [(False, (0, 0), 2)]


@pytest.mark.parametrize(("rows", "changes"), [(slice(61, 71), 0), (slice(62, 72), 0), (slice(66, 76), 2)])
def test_a_thing_within_two_cells_of_where_it_stood_is_the_same_one(rows, changes):
    thin = (slice(60, 61), CRATE[1])
    moved = (slice(rows.start, rows.start + 1), CRATE[1])
    assert len(layers_of(session(thin), session(moved)).changes) == changes


def test_a_face_that_beams_passed_along_without_seeing_behind_it_was_not_free():
    face, behind = (slice(60, 61), CRATE[1]), (slice(61, 71), slice(118, 138))
    assert layers_of(session(unknown=behind), session(face)).changes == []
    assert len(layers_of(session(), session(face)).changes) == 1


@pytest.mark.parametrize("length", [MIN_CELLS - 1, MIN_CELLS])
def test_what_is_smaller_than_a_changed_place_is_none(length):
    layers = layers_of(session(), session((slice(60, 61), slice(100, 100 + length))))
    assert len(layers.changes) == (length >= MIN_CELLS)


def test_the_map_shows_the_newest_state_whoever_drew_last():
    layers = layers_of(session(CRATE), session())
    shown = session(CRATE)
    np.testing.assert_array_equal(layers.newest(shown).evidence, session().evidence)
    layers = layers_of(session(), session(CRATE))
    np.testing.assert_array_equal(layers.newest(session()).evidence, session(CRATE).evidence)


def boxes(shift: int, every: int = 1) -> list[tuple[slice, slice]]:
    """One in each place of 4 m, or in every so many, all moved by as many cells."""
    corners = [(row, column) for row in range(24, SIDE, 80) for column in range(24, SIDE, 80)]
    return [
        (slice(row, row + 6), slice(column + shift, column + shift + 6)) for row, column in corners[::every]
    ]


def test_places_are_counted_by_what_is_gone_and_what_is_new():
    layers = layers_of(session(*boxes(0)))
    compared = layers.compare(session(*boxes(-12, every=3)))
    assert (compared.places_gone, compared.places_new) == (9, 3)
    assert layers.compare(session(*boxes(1))).counts | {"places": 0} == {"places": 0, "gone": 0, "new": 0}


@pytest.mark.parametrize(
    ("places", "gone", "new", "is_elsewhere"),
    [
        (89, 27, 23, True),  # two floors of one plan
        (38, 0, 5, False),  # intel
        (18, 3, 2, False),  # fr079
        (80, 70, 0, False),  # all doors shut, a store that was emptied
        (80, 9, 9, False),  # some pallets moved
        (6, 2, 2, False),  # too little that both saw
        (0, 0, 0, False),
    ],
)
def test_another_floor_lacks_walls_and_has_others(places, gone, new, is_elsewhere):
    assert (log_odds_elsewhere(places, gone, new) >= MIN_LOG_ODDS) == is_elsewhere
