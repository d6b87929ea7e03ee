"""A session that begins in the map of another: found, followed, and nothing of the stored map touched."""

import math
from dataclasses import replace

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.by_hand import DRAWN_WALL, ERASED
from service.mapper.components import GraphRequestError, WallToRender
from service.mapper.graph.edit.editing import with_area_erased, with_wall
from service.mapper.graph.relocalise import known_map
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.localisation import UNPROVEN
from service.mapper.maps.occupancy import cells_of_wall
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from service.mapper.saved_graph import SavedGraphError
from service.outputs import MapperOutput, TileUpdate
from tests.service.mapper.offices import COARSE, mapped_office, outputs_at_once, through
from tests.service.mapstore.tile_makers import graph_of
from tests.simulated import FORWARD, Drive

LATER_S, SECONDS = 12.0, 10.0


@pytest.fixture(scope="module")
def first() -> tuple[Drive, BeginIn]:
    return mapped_office()


@pytest.fixture(scope="module")
def second() -> Drive:
    """The same path from LATER_S on, with other noise."""
    return through("office", SECONDS, 4, stand_s=-LATER_S)


@pytest.fixture
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a vehicle that stays lost: the result does not depend on the number of candidates."""
    monkeypatch.setattr(known_map, "MAX_CANDIDATES", 4)


def new_mapper(begin: BeginIn, mode: str = "localization") -> Mapper:
    return build_mapper(mapping_config({"mode": mode}), {"front": FORWARD}, begin_in=begin)


def off_m(first: Drive, second: Drive, output: MapperOutput) -> float:
    true = first.world_first.inverse() @ second.world_first @ second.truth[output.stamp_ns]
    away = true.inverse() @ output.pose_map_base
    return math.hypot(away.x_m, away.y_m)


@pytest.fixture(scope="module")
def localized(first, second) -> tuple[Mapper, list[MapperOutput]]:
    """A second session in the map of the first, over."""
    mapper = new_mapper(first[1])
    assert len(mapper.changed_tiles()) > 0
    return mapper, list(outputs_at_once(mapper, second.frames))


def test_a_vehicle_is_localised_and_tracked(first, second, localized):
    first_drive, outputs = first[0], localized[1]
    assert outputs[0].state == "lost"
    placed = [output for output in outputs if output.state != "lost"]
    assert 1e-9 * (placed[0].stamp_ns - outputs[0].stamp_ns) < 1.0
    assert placed[0].reason == UNPROVEN  # seen from one spot: rooms look alike
    assert placed[-1].state == "ok"
    assert max(off_m(first_drive, second, output) for output in placed) < 0.05


def test_a_known_pose_cannot_be_set(localized):
    with pytest.raises(GraphRequestError, match="the map confirms it"):
        localized[0].graph.request("set_pose", {"x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0})


def test_localisation_does_not_change_the_stored_map(first, localized):
    """Nor the arrays of its graph, which cannot be written to."""
    stored, mapper = first[1].graph, localized[0]
    saved = mapper.finish().update.saved
    assert mapper.changed_tiles() == []
    assert saved is not None
    np.testing.assert_array_equal(saved.map[: len(stored)], stored.map)


def test_manual_edits_withstand_the_beams_of_a_later_session(first, second):
    """A wall across the path of the second session, and points that were erased elsewhere."""
    first_drive, begin = first
    at = SE2(*begin.graph.map[len(begin.graph) // 2].tolist())
    line = np.array([(pose.x_m, pose.y_m) for pose in (at @ SE2(0.0, -0.4), at @ SE2(0.0, 0.4))])
    area = begin.graph.map[5, :2] + np.array([(-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)])
    graph, gone = with_area_erased(with_wall(begin.graph, line), area, "unknown")
    assert gone > 0
    shown = replace(begin.shown, wall_cells=cells_of_wall(WallToRender(line), 0.05))
    mapper = new_mapper(BeginIn(graph, shown), "mapping")
    outputs = list(outputs_at_once(mapper, second.frames))
    assert outputs[-1].state == "ok"
    assert off_m(first_drive, second, outputs[-1]) < 0.05
    assert shown_at(mapper.tiles(), at) == 97
    saved = mapper.finish().update.saved
    assert shown_at(mapper.tiles(), at) == 97
    assert saved is not None
    assert saved.by_hand.kind.tolist() == [DRAWN_WALL, ERASED]
    assert saved.by_hand.until.tolist() == [0, len(graph)]


def test_erased_points_do_not_localise(first, second):
    _, begin = first
    everywhere = 100.0 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    graph, gone = with_area_erased(begin.graph, everywhere, "free")
    assert gone == len(begin.graph.xy_base)
    mapper = new_mapper(BeginIn(graph.checked(), begin.shown))
    few = [frame for frame in second.frames if frame.stamp_ns < 3_000_000_000]
    assert {output.state for output in outputs_at_once(mapper, few)} == {"lost"}
    assert mapper.finish().update.saved is not None


def shown_at(tiles: list[TileUpdate], pose: SE2) -> int:
    row, column = int(np.floor(pose.y_m / 0.05)), int(np.floor(pose.x_m / 0.05))
    tile = next(t for t in tiles if (t.iy, t.ix) == (row // 64, column // 64))
    return int(tile.cells[row % 64, column % 64])


def test_the_operator_can_set_the_pose(first, second):
    first_drive, begin = first
    mapper = new_mapper(begin)
    frames = second.frames
    true = first_drive.world_first.inverse() @ second.world_first
    mapper.graph.request("set_pose", {"x_m": true.x_m + 0.5, "y_m": true.y_m, "theta_rad": true.theta_rad})
    few = [frame for frame in frames if frame.stamp_ns < 200_000_000]
    last = list(outputs_at_once(mapper, few))[-1]
    assert last.state == "degraded"
    assert off_m(first_drive, second, last) < 0.05


@pytest.mark.usefixtures("few_candidates")
def test_a_set_pose_that_does_not_fit_is_given_up_and_reported(first):
    """The vehicle is in another building."""
    elsewhere = through("library", 3.5, 1, laser=COARSE)
    mapper = new_mapper(first[1])
    mapper.graph.request("set_pose", {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5})
    outputs = list(outputs_at_once(mapper, elsewhere.frames))
    assert {output.state for output in outputs} == {"lost"}  # also in all searches after that
    reasons = [output.reason for output in outputs]
    assert "stored map" in reasons[0]
    assert not reasons[0].startswith("the pose set")
    assert reasons[-1].startswith("the pose set at (1.0, 2.0) m is rejected: no scan matches the map there; ")
    assert mapper.counters["set_pose_given_up"] == 1
    assert mapper.pose_refused == (1.0, 2.0, 0.5)
    mapper.graph.request("set_pose", {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5})
    mapper.apply_result()
    assert mapper.pose_refused is None


def test_a_place_other_than_the_set_pose_is_reported(first, second):
    first_drive, begin = first
    mapper = new_mapper(begin)
    true = first_drive.world_first.inverse() @ second.world_first
    away = (true.x_m - 8.0, true.y_m + 3.0, 2.0)
    mapper.graph.request("set_pose", dict(zip(("x_m", "y_m", "theta_rad"), away, strict=True)))
    last = list(outputs_at_once(mapper, second.frames))[-1]
    assert off_m(first_drive, second, last) < 0.05
    assert last.reason == ""
    assert mapper.counters["set_pose_given_up"] == 1


def test_a_profile_without_stored_maps_is_refused(first):
    config = mapping_config({"profile": "contour_lm"})
    with pytest.raises(ValueError, match="contour_lm cannot begin in a stored map"):
        build_mapper(config, {"front": SE2()}, begin_in=first[1])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"path_length_m": np.zeros(3)}, "path_length_m has the shape"),
        ({"loop_ends": np.array([(0, 4)])}, "key frames that are not among"),
        ({"map": np.full((4, 3), np.nan)}, "is not finite"),
    ],
)
def test_arrays_that_are_no_graph_are_refused_by_name(fields, words):
    with pytest.raises(SavedGraphError, match=words):
        replace(graph_of(4), **fields).checked()


def test_a_contradicted_place_is_revoked_and_found_again(first, second, monkeypatch):
    """The first place is off by 3 m, as if another place had looked the same: nothing may be `ok` there."""
    first_drive, begin = first
    mapper = new_mapper(begin)
    best_of, wrongly = DetachedSearch.best_of, []

    def find_wrongly(search, found, prior=None):
        best = best_of(search, found, prior)
        if best is None or wrongly:
            return best
        at, loop = best
        wrongly.append(at)
        shift = np.array([3.0, 0.0, 0.0])
        return se2.compose(at, shift), replace(loop, measured=se2.compose(loop.measured, shift))

    monkeypatch.setattr(DetachedSearch, "best_of", find_wrongly)
    outputs = list(outputs_at_once(mapper, second.frames))
    states = [output.state for output in outputs]
    off = [off_m(first_drive, second, output) for output in outputs]
    placed = next(k for k, state in enumerate(states) if state != "lost")
    assert off[placed] > 2.0
    assert states[placed] == "degraded"  # one look is no proof
    assert not any(state == "ok" and away > 0.3 for state, away in zip(states, off, strict=True))
    assert "lost" in states[placed:]  # it was revoked
    assert states[-1] != "lost"
    assert off[-1] < 0.05
