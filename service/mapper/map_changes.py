"""Changes since a map was stored, detected by a vehicle that only localises in it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry.groups import groups_of
from service.geometry.se2 import SE2
from service.kernels.map_changes import CELL_FREE, CELL_UNKNOWN, CELL_WALL, ChangeVotes, Moment, weigh_changes
from service.mapper.components import Points, RenderedMap
from service.mapper.maps.occupancy import FREE_EVIDENCE
from service.outputs import FREE as GRID_FREE
from service.outputs import OCCUPIED as GRID_OCCUPIED
from service.outputs import UNKNOWN as GRID_UNKNOWN
from service.outputs import Grid

Rows = npt.NDArray[np.int64]
COARSER = 2  # cells of the map per edge of a cell here: 0.1 m
WALL_EVIDENCE = 13  # log-odds in steps of 0.05: 66 %
MAX_RANGE_M = 12.0  # returns farther away are ignored
CHANGE_STEP_M, CHANGE_STEP_RAD = 0.3, 0.2  # between poses that count as different
USED_EVERY_M, USED_EVERY_RAD, USED_EVERY_NS = 0.1, 0.05, 200_000_000  # scans between these are skipped
MIN_POSES, MIN_VOTES, MIN_MS = 3, 5, 1000  # contradicting poses, scans and time before a cell is reported
MIN_CHANGED_SHARE = 0.8  # of the scans that observed the cell since then
MIN_CELLS = 4  # connected: a single cell is the edge of an unchanged object
NOTHING_CHANGED = Grid(0, COARSER * 0.05, 0.0, 0.0, np.empty((0, 0), np.int8))


@dataclass(frozen=True, slots=True, eq=False)
class MapChanges:
    """Cells that differ from the stored map, of cell_m. Rows of the arrays are cells."""

    cell_m: float
    xy_map: npt.NDArray[np.float64]  # (N, 2) m, their centres
    is_new: npt.NDArray[np.bool_]  # (N,) occupied now; else the stored object is gone
    first_ns: npt.NDArray[np.int64]  # (N,) stamps of the first and the last scan that contradicts the map
    last_ns: npt.NDArray[np.int64]
    scans: npt.NDArray[np.int64]  # (N,) number of these scans

    def as_grid(self) -> Grid:
        """The smallest grid with all changes: OCCUPIED where something is new, FREE where something is gone,
        UNKNOWN where the map is unchanged. 0 x 0 cells without changes.
        """
        if not len(self.xy_map):
            return NOTHING_CHANGED
        cells = np.floor(self.xy_map / self.cell_m).astype(np.int64)
        low = cells.min(axis=0)
        width, height = cells.max(axis=0) - low + 1
        picture = np.full((height, width), GRID_UNKNOWN, np.int8)
        column, row = (cells - low).T
        picture[row, column] = np.where(self.is_new, GRID_OCCUPIED, GRID_FREE)
        x_min_m, y_min_m = low * self.cell_m
        return Grid(0, self.cell_m, float(x_min_m), float(y_min_m), picture)

    def has_same_cells(self, other: "MapChanges | None") -> bool:
        """Whether the same cells have changed in the same direction."""
        return (
            other is not None
            and np.array_equal(self.xy_map, other.xy_map)
            and np.array_equal(self.is_new, other.is_new)
        )

    def as_dict(self) -> dict[str, int | float]:
        """Counts, for JSON."""
        return {
            "cells_new": int(self.is_new.sum()),
            "cells_gone": int((~self.is_new).sum()),
            "cell_m": self.cell_m,
        }


class ChangeWatch:
    """Compares scans at confirmed poses with the stored map; reports what several poses contradict.

    Does not change the map. Raises ValueError if the map has no cells.
    """

    def __init__(self, shown: RenderedMap, cell_m: float) -> None:
        if not len(shown.tile_row):
            raise ValueError("the stored map shows nothing; there is nothing that could have changed")
        stored, first_row, first_column = _stored(shown)
        shape = stored.shape
        self.votes = ChangeVotes(
            stored,
            changed=np.zeros(shape, np.uint8),
            same=np.zeros(shape, np.uint8),
            poses=np.zeros(shape, np.uint8),
            last_pose=np.zeros(shape, np.int32),
            first_ms=np.zeros(shape, np.int32),
            last_ms=np.zeros(shape, np.int32),
            hit=np.zeros(shape, np.int32),
            passed=np.zeros(shape, np.int32),
            first_row=first_row,
            first_column=first_column,
            cell_m=COARSER * cell_m,
        )
        self._began_ns: int | None = None
        self._used: tuple[SE2, int] | None = None  # pose and stamp of the newest scan evaluated
        self._counted: SE2 | None = None
        self._scans = self._poses = 0

    def add(self, points: Points, pose_map_base: SE2, stamp_ns: int) -> None:
        """Evaluate a scan, unless pose and time have hardly changed since the last one."""
        if self._began_ns is None:
            self._began_ns = stamp_ns
        if self._used is not None:
            pose, used_ns = self._used
            is_far = pose_map_base.is_step_from(pose, USED_EVERY_M, USED_EVERY_RAD)
            if not is_far and stamp_ns - used_ns < USED_EVERY_NS:
                return
        if self._counted is None or pose_map_base.is_step_from(self._counted, CHANGE_STEP_M, CHANGE_STEP_RAD):
            self._counted = pose_map_base
            self._poses += 1
        self._used = pose_map_base, stamp_ns
        self._scans += 1
        sensor = points.sensor_base
        weigh_changes(
            points.xy_base,
            np.array([sensor.x_m, sensor.y_m]),
            np.array(pose_map_base),
            MAX_RANGE_M,
            self.votes,
            Moment(self._scans, self._poses, (stamp_ns - self._began_ns) // 1_000_000),
        )

    def changes(self) -> MapChanges:
        """Cells whose change is certain by now."""
        votes = self.votes
        at = np.flatnonzero(votes.poses >= MIN_POSES)  # few cells; only these are evaluated
        changed, same = (of.ravel()[at].astype(np.int64) for of in (votes.changed, votes.same))
        is_sure = (
            (changed >= MIN_VOTES)
            & (votes.last_ms.ravel()[at] - votes.first_ms.ravel()[at] >= MIN_MS)
            & (changed >= MIN_CHANGED_SHARE * (changed + same))
        )
        at, changed = at[is_sure], changed[is_sure]
        row, column = np.divmod(at, votes.stored.shape[1])
        is_new = votes.stored.ravel()[at] == CELL_FREE
        is_reported = np.zeros(len(at), np.bool_)
        for alike in (is_new, ~is_new):
            is_reported[alike] = group_sizes(row[alike], column[alike]) >= MIN_CELLS
        at, row, column = at[is_reported], row[is_reported], column[is_reported]
        began_ns = self._began_ns or 0
        cells = np.column_stack((column + votes.first_column, row + votes.first_row)).astype(np.float64)
        return MapChanges(
            votes.cell_m,
            (cells + 0.5) * votes.cell_m,
            is_new[is_reported],
            began_ns + votes.first_ms.ravel()[at].astype(np.int64) * 1_000_000,
            began_ns + votes.last_ms.ravel()[at].astype(np.int64) * 1_000_000,
            changed[is_reported],
        )


def _stored(shown: RenderedMap) -> tuple[npt.NDArray[np.uint8], int, int]:
    """State of each coarser cell (CELL_UNKNOWN ...), and row and column of the first one."""
    edge = shown.evidence.shape[1]
    low_row, low_column = int(shown.tile_row.min()), int(shown.tile_column.min())
    height = (int(shown.tile_row.max()) - low_row + 1) * edge
    width = (int(shown.tile_column.max()) - low_column + 1) * edge
    fine = np.zeros((height, width), np.int8)
    for row, column, evidence in zip(shown.tile_row, shown.tile_column, shown.evidence, strict=True):
        r, q = (int(row) - low_row) * edge, (int(column) - low_column) * edge
        fine[r : r + edge, q : q + edge] = evidence
    blocks = fine.reshape(height // COARSER, COARSER, width // COARSER, COARSER)
    stored = np.full((height // COARSER, width // COARSER), CELL_UNKNOWN, np.uint8)
    stored[(blocks <= FREE_EVIDENCE).all(axis=(1, 3))] = CELL_FREE
    stored[(blocks >= WALL_EVIDENCE).any(axis=(1, 3))] = CELL_WALL
    return stored, low_row * edge // COARSER, low_column * edge // COARSER


def group_sizes(row: Rows, column: Rows) -> Rows:
    """(N,) size of the 8-connected group that each cell belongs to.

    row, column   (N,) without duplicates; sorted by rows, then by columns
    """
    if not len(row):
        return np.empty(0, np.int64)
    stride = int(column.max()) + 2  # the last column is no neighbour of the next row's first one
    cell = row * stride + column
    pairs = []  # indices of each two neighbours
    for step in (1, stride - 1, stride, stride + 1):
        index = np.minimum(np.searchsorted(cell, cell + step), len(cell) - 1)
        touches = np.flatnonzero(cell[index] == cell + step)
        pairs.append(np.column_stack((touches, index[touches])))
    group = groups_of(len(cell), np.concatenate(pairs))
    return np.bincount(group, minlength=len(cell))[group]
