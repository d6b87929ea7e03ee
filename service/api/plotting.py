"""Map and trajectory as a picture by matplotlib, which is an extra."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from service.errors import CorridorError
from service.extras import install_command
from service.offline.score.trajectory import Trajectory
from service.outputs import STATES, UNKNOWN, Grid, State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: dict[State, str] = {"ok": "#0f766e", "degraded": "#d97706", "lost": "#b3261e"}


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
