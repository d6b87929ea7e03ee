"""The map is changed by hand while it is made: nothing else of the session changes by it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.frames import LaserScan
from service.geometry.polygons import is_inside
from service.mapper.by_hand import ERASED_AS_SEEN
from service.mapper.components import GraphRequestError
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.mapper.saved_graph import SavedGraph
from service.outputs import MapperOutput, TileUpdate
from tests.service.mapper.offices import through
from tests.simulated import FORWARD, Drive

EDITED_NS, SECONDS = 6_000_000_000, 9.0
TAKEN_OVER_NS = 1_000_000_000  # at most, of the drive
AREA = [(0.5, -1.6), (3.0, -1.6), (3.0, 1.6), (0.5, 1.6)]  # behind the vehicle: walls, and the floor between
WALL, FREE = 50, 50  # per cent: above, below

Cells = dict[tuple[int, int], int]  # row and column of those that are known: per cent


@dataclass
class Mapped:
    """A drive with changes during it: their answers, and the shown map when the last one was applied."""

    outputs: list[MapperOutput]
    shown: list[TileUpdate]
    applied_ns: int  # after the request
    answers: list[dict[str, Any]]
    session: MappingSession

    def cells(self, is_within: bool) -> Cells:
        """Those within the area, or all others."""
        cells: Cells = {}
        for tile in self.shown:
            edge = len(tile.cells)
            place = np.argwhere(tile.cells >= 0)
            cell = place + np.array([tile.iy * edge, tile.ix * edge])
            is_meant = is_inside((cell[:, ::-1] + 0.5) * tile.cell_m, np.array(AREA)) == is_within
            values = tile.cells[tuple(place[is_meant].T)].tolist()
            cells.update(zip(map(tuple, cell[is_meant].tolist()), values, strict=True))
        return cells


def new_session() -> MappingSession:
    return MappingSession(lambda: build_mapper(mapping_config(), {"front": FORWARD}), ["front"])


def mapped(drive: Drive, *changes: dict[str, Any], shown_ns: int = 0) -> Mapped:
    """Requests the changes at EDITED_NS. shown_ns: without changes, the moment of the shown map."""
    session, outputs, answers = new_session(), [], []
    shown: list[TileUpdate] = []
    applied_ns = 0
    is_requested = False
    for frame in drive.frames:
        if isinstance(frame, LaserScan) and frame.stamp_ns >= EDITED_NS and not is_requested:
            is_requested = True
            for change in changes:
                assert session.request("edit_map", {"change": change}) is None
        output = session.process(frame)
        if output is None:
            continue
        outputs.append(output)
        answers += [dict(one.reply) for one in session.take_edited()]
        after_ns = frame.stamp_ns - EDITED_NS
        if not shown and (len(answers) == len(changes) if changes else after_ns >= shown_ns):
            applied_ns, shown = after_ns, session.tiles()
    return Mapped(outputs, shown, applied_ns, answers, session)


def erase(becomes: str = "as_seen") -> dict[str, Any]:
    return {"what": "erase", "corners": AREA, "becomes": becomes}


@pytest.fixture(scope="module")
def drive() -> Drive:
    return through("office", SECONDS, 3)


@pytest.fixture(scope="module")
def erased(drive: Drive) -> Mapped:
    return mapped(drive, erase())


@pytest.fixture(scope="module")
def stored(erased: Mapped) -> SavedGraph:
    graph = erased.session.finish().update.saved
    assert isinstance(graph, SavedGraph)
    return graph


@pytest.fixture(scope="module")
def untouched(drive: Drive, erased: Mapped) -> Mapped:
    """The same drive without a change, shown at the same moment."""
    return mapped(drive, shown_ns=erased.applied_ns)


def test_poses_and_states_are_those_of_the_drive_without_the_change(erased: Mapped, untouched: Mapped):
    assert erased.applied_ns < TAKEN_OVER_NS
    for one, other in zip(erased.outputs, untouched.outputs, strict=True):
        assert one.pose_map_base == other.pose_map_base
        assert (one.state, one.reason) == (other.state, other.reason) == ("ok", other.reason)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_outside_the_area_the_map_is_that_of_the_drive_without_the_change(erased: Mapped, untouched: Mapped):
    assert erased.cells(is_within=False) == untouched.cells(is_within=False)


def test_walls_are_gone_and_floor_that_beams_pass_over_stays_free(erased: Mapped, untouched: Mapped):
    before, after = untouched.cells(is_within=True), erased.cells(is_within=True)
    assert sum(value > WALL for value in before.values()) > 30
    assert not [place for place, value in after.items() if value > WALL]
    floor = [place for place, value in before.items() if value < FREE]
    assert sum(after.get(place, 100) < FREE for place in floor) > 0.95 * len(floor)


def test_the_mapping_goes_on_and_the_change_is_stored_with_the_map(
    erased: Mapped, stored: SavedGraph, untouched: Mapped
):
    whole = untouched.session.finish().update.saved
    assert isinstance(whole, SavedGraph)
    np.testing.assert_array_equal(stored.map, whole.map)
    assert stored.stamp_ns[-1] > EDITED_NS + TAKEN_OVER_NS
    assert stored.by_hand.kind.tolist() == [ERASED_AS_SEEN]
    gone = int(whole.point_count.sum() - stored.point_count.sum())
    assert erased.answers[0]["done"] == f"erased 8.00 m2 about (1.75, 0.00) m: {gone} points gone"


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        ({"change": {"what": "erase", "corners": [[0, 0], [1, 0], [2, 0]]}}, "enclose no area"),
        ({"change": {"what": "erase", "corners": [[0, 0], [200, 0], [200, 100]]}}, "more than 10000 m2"),
        ({"change": {"what": "erase", "corners": [[0, 0], [1, 0]]}}, "3 corners or more, not 2"),
        ({"change": {"what": "wall", "corners": []}}, "2 points or more, not 0"),
        ({"change": {"what": "wall", "corners": [[0, 0]] * 501}}, "corners: 501 points, at most 500"),
        ({"change": {"what": "add-pair", "pairs": []}}, "change.add-pair.pairs"),
        ({"change": {"what": "sell"}}, "change: "),
        ({"who": "ada"}, "change: "),
    ],
)
def test_invalid_requests_are_refused_at_once(payload: dict[str, Any], words: str):
    with pytest.raises(GraphRequestError, match=words):
        new_session().request("edit_map", payload)
