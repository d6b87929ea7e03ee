"""A bin was put down and a box taken away since the office was mapped: reported there, and only there."""

from dataclasses import replace

import numpy as np

from service.geometry.se2 import SE2
from service.kernels.occupancy import GRID_TILE_CELLS
from service.mapper.components import RenderedMap
from service.mapper.map_changes import MapChanges
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from tests.service.mapper.offices import (
    LASER,
    in_plan,
    mapped_office,
    office_with_box,
    outputs_at_once,
    pose_plan_map,
)
from tests.simulated import FORWARD, Wheels, drive

BIN, BOX = (9.0, 3.4), (11.0, 4.6)  # middle, in the plan
EDGE_M = 0.5
NEAR_M = 0.6  # of the middle
REPORTED_WITHIN_S = 10.0  # of the first scan that contradicted the map there


def with_box(shown: RenderedMap) -> RenderedMap:
    """The shown map with BOX, which no scan saw."""
    at = pose_plan_map().inverse() @ SE2(*BOX)
    rows, columns = (np.arange(EDGE_M / 0.05, dtype=int) + round((m - EDGE_M / 2) / 0.05) for m in at[1::-1])
    evidence = shown.evidence.copy()
    for row, column in np.stack(np.meshgrid(rows, columns), -1).reshape(-1, 2).tolist():
        is_tile = (shown.tile_row == row // GRID_TILE_CELLS) & (
            shown.tile_column == column // GRID_TILE_CELLS
        )
        evidence[is_tile, row % GRID_TILE_CELLS, column % GRID_TILE_CELLS] = 60
    return replace(shown, evidence=evidence)


def off_m(changes: MapChanges, middle: tuple[float, float]) -> np.ndarray:
    return np.hypot(*(in_plan(changes.xy_map) - middle).T)


def test_what_was_put_down_and_taken_away_is_reported_within_seconds_and_nothing_else():
    """People walk there, too."""
    _, begin = mapped_office()
    again = drive(office_with_box(BIN, (EDGE_M, EDGE_M)), LASER, 16.0, 4, Wheels(), stand_s=-2.0)
    begin = BeginIn(begin.graph, with_box(begin.shown))
    mapper = build_mapper(mapping_config({"mode": "localization"}), {"front": FORWARD}, begin_in=begin)
    reported_ns: dict[bool, int] = {}
    for output in outputs_at_once(mapper, again.frames):
        if mapper.map_changes is not None:
            for is_new in mapper.map_changes.is_new.tolist():
                reported_ns.setdefault(is_new, output.stamp_ns)
    changes = mapper.map_changes
    assert changes is not None
    for middle, is_new in ((BIN, True), (BOX, False)):
        there = changes.is_new == is_new
        assert there.sum() >= 8
        assert off_m(changes, middle)[there].max() < NEAR_M
        after_s = (reported_ns[is_new] - int(changes.first_ns[there].min())) / 1e9
        assert 1.0 <= after_s <= REPORTED_WITHIN_S  # not at once: people pass, too
    shown = mapper.changes_reported
    assert shown is not None
    assert shown.is_new.sum() == mapper.counters["changed_cells_new"] > 0
    assert (shown.as_grid().cells == 0).sum() == mapper.counters["changed_cells_gone"] > 0
