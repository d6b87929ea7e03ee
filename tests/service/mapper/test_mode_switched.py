"""A vehicle that maps is only localised for a while: the map stays as it is, and nothing jumps."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from drivers.frames import LaserScan
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.mapper.saved_graph import SavedGraph
from service.outputs import MapperOutput, TileUpdate
from tests.service.mapper.offices import through
from tests.simulated import FORWARD, Drive

LOCALIZED_NS, MAPPED_NS, SECONDS = 5_000_000_000, 10_000_000_000, 13.0


@dataclass
class Switched:
    outputs: list[MapperOutput]
    answers: list[tuple[int, dict[str, Any], list[TileUpdate], int]]  # stamp, answer, map, key frames stored
    shown: list[TileUpdate]
    stored: SavedGraph


def stored_now(session: MappingSession) -> int:
    """Key frames, were it stored now."""
    session.request("checkpoint", {})
    session.apply_result()
    assert isinstance(session.saved, SavedGraph)
    return len(session.saved)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return through("office", SECONDS, 3)


@pytest.fixture(scope="module")
def switched(drive: Drive) -> Switched:
    session = MappingSession(lambda: build_mapper(mapping_config(), {"front": FORWARD}), ["front"], None)
    outputs, answers = [], []
    due = [(LOCALIZED_NS, "localization"), (MAPPED_NS, "mapping")]
    for frame in drive.frames:
        if due and isinstance(frame, LaserScan) and frame.stamp_ns >= due[0][0]:
            stored = stored_now(session)
            assert session.request("set_mode", {"mode": due.pop(0)[1]}) is None
            session.apply_result()
            (edited,) = session.take_edited()
            answers.append((frame.stamp_ns, dict(edited.reply), session.tiles(), stored))
        if (output := session.process(frame)) is not None:
            outputs.append(output)
        while session.work_ready:
            session.apply_result()
    finished = session.finish().update.saved
    assert isinstance(finished, SavedGraph)
    return Switched(outputs, answers, session.tiles(), finished)


def cells(tiles: list[TileUpdate]) -> dict[tuple[int, int], bytes]:
    return {(tile.ix, tile.iy): tile.cells.tobytes() for tile in tiles}


def test_the_map_stays_as_it_is_until_it_is_mapped_again(switched: Switched):
    (_, localizing, before, stored_before), (_, mapped, after, stored_after) = switched.answers
    assert (localizing["mode"], mapped["mode"]) == ("localization", "mapping")
    assert cells(before) == cells(after)
    assert stored_before == stored_after > 10
    assert cells(switched.shown) != cells(after)
    assert len(switched.stored) > stored_after
    switched.stored.checked()


def test_the_vehicle_is_localised_all_along_and_no_pose_jumps(drive: Drive, switched: Switched):
    assert {output.state for output in switched.outputs} == {"ok"}
    map_odom = np.array([(o.pose_map_odom.x_m, o.pose_map_odom.y_m) for o in switched.outputs])
    assert np.hypot(*np.diff(map_odom, axis=0).T).max() < 0.01
    for output in switched.outputs:
        true = drive.truth[output.stamp_ns]
        off_m = math.hypot(output.pose_map_base.x_m - true.x_m, output.pose_map_base.y_m - true.y_m)
        assert off_m < 0.05


def test_a_change_asked_for_before_the_switch_to_localisation_is_applied_is_refused(drive: Drive):
    session = MappingSession(lambda: build_mapper(mapping_config(), {"front": FORWARD}), ["front"], None)
    for frame in drive.frames[:50]:
        session.process(frame)
    wall = {"what": "wall", "corners": [(0.5, 0.2), (1.5, 0.2)]}
    session.request("set_mode", {"mode": "localization"})
    session.request("edit_map", {"change": wall})
    for _ in range(10):  # more than are out
        session.apply_result()
    switched, edited = session.take_edited()
    assert (switched.reply["mode"], switched.error) == ("localization", "")
    assert "only localised" in edited.error
    stored = session.finish().update.saved
    assert isinstance(stored, SavedGraph)
    assert len(stored.by_hand.kind) == 0
