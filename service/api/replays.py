"""A recording through the mapper, and what came out of it."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from service.api.configs import CompileNotice, stored_folder
from service.api.mapper import trajectory_of
from service.api.poses import Pose, pose_of
from service.api.recordings import AnyPath, Topics, choice_of, one_drive
from service.compile.cache import ensure_cache_dir
from service.errors import CorridorError
from service.extras import install_command
from service.mapstore.tiles import grid_of_tiles
from service.offline.replay.replay import COMPILING
from service.offline.replay.replay import replay as replay_recording
from service.offline.replay.result import Replay, write_replay
from service.offline.replay.setup import ReplayOptions, refuse_contradictions
from service.offline.score.trajectory import Trajectory
from service.outputs import STATES, UNKNOWN, Grid, State

if TYPE_CHECKING:
    from matplotlib.axes import Axes


COLOURS: dict[State, str] = {"ok": "#0f766e", "degraded": "#d97706", "lost": "#b3261e"}


class Result:
    """What came out of a replay.

    summary            figures and warnings, as summary.json of `corridor replay` has them
    trajectory         the base in the map at every scan, corrected by all that was known in the end
    trajectory_live    each pose as it would have been published, so by the past alone
    lasers             whose scan each pose answers
    """

    def __init__(self, done: Replay) -> None:
        self._done = done
        self.summary: Mapping[str, Any] = done.summary
        self.trajectory: Trajectory = trajectory_of(done.outputs, done.poses_map_base)
        self.trajectory_live: Trajectory = trajectory_of(
            done.outputs, [output.pose_map_base for output in done.outputs]
        )
        self.lasers: Sequence[str] = done.lasers

    @cached_property
    def poses(self) -> Sequence[Pose]:
        """Those of trajectory_live, with covariance and state."""
        return [pose_of(output) for output in self._done.outputs]

    @cached_property
    def map(self) -> Grid:
        """The map at the end. Raises StorageError beyond 410 m square at 5 cm."""
        return grid_of_tiles(self._done.tiles)

    def save(self, folder: AnyPath) -> None:
        """Write the files of `corridor replay --out`: trajectories, states, summary, map.yaml and map.pgm for
        nav2, and the stored map in map/. Raises StorageError.
        """
        write_replay(self._done, Path(folder))

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw map and trajectory in metres, into these axes or new ones; which are given back.

        Raises CorridorError where matplotlib is not installed.
        """
        from service.api.replays import plot

        return plot(self.map, self.trajectory, [output.state for output in self._done.outputs], axes)


def replay(
    path: AnyPath | Sequence[AnyPath],
    *,
    config: AnyPath | None = None,
    profile: str | None = None,
    map: AnyPath | None = None,
    version: int | None = None,
    localize: bool = False,
    from_raw: bool = False,
    **topics: Unpack[Topics],
) -> Result:
    """Map a recording as `corridor replay` does: same input, same output, bit for bit.

    path       as of read
    config     a YAML file whose sensors and mapping replace those of the recording
    profile    map with this profile
    map        folder of a stored map to begin in; version: of it, None: the newest
    localize   only localise in it: it stays as it is
    from_raw   map what the drivers make of the recorded bytes

    Raises InputError, ConfigError, UsageError for settings that do not go together, and StorageError.
    """
    options = ReplayOptions(
        config=None if config is None else Path(config),
        profile=profile,
        map=stored_folder(map, version),
        version=version,
        localize=localize,
        choice=choice_of(topics),
        from_raw=from_raw,
    )
    refuse_contradictions(options)
    notice = CompileNotice()
    ensure_cache_dir()
    return Result(
        replay_recording(
            one_drive(path), options, lambda share, phase: notice() if phase == COMPILING else None
        )
    )


def plot(grid: Grid, trajectory: Trajectory, states: Sequence[State], axes: "Axes | None") -> "Axes":
    """The map in grey, and where each pose is, in the colour of its state."""
    if axes is None:
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise CorridorError(
                f"plot() needs matplotlib, which is not installed: {install_command('plot')}"
            ) from error
        axes = pyplot.figure().add_subplot()
    height, width = grid.cells.shape
    x_max_m, y_max_m = grid.x_min_m + width * grid.cell_m, grid.y_min_m + height * grid.cell_m
    axes.imshow(
        np.ma.masked_equal(grid.cells, UNKNOWN),
        cmap="Greys",
        vmin=0,
        vmax=100,
        origin="lower",
        extent=(grid.x_min_m, x_max_m, grid.y_min_m, y_max_m),
    )
    state = np.array(states)
    for name in STATES:
        x_m, y_m = trajectory.pose[state == name, :2].T
        if len(x_m):
            axes.plot(x_m, y_m, ".", markersize=2.0, color=COLOURS[name], label=name)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.legend(loc="upper right")
    return axes
