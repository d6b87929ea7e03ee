"""The map with the path in the colours of its sigma, as one figure that scales."""

import math
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapstore.annotated import known_part, scale_bar_m
from service.mapstore.picture import GREY_UNKNOWN, Picture, Pixels
from service.mapstore.png import png_bytes
from service.offline.past.moments import thinned
from service.offline.replay.states_file import States
from service.offline.report.content import Content
from service.offline.report.markup import Markup, joined, tag
from service.offline.score.trajectory import Trajectory

MAX_PIXELS = 3000  # of a side, bounded for browsers
MAX_POINTS = 4000  # of the path
CLASSES_M = (0.01, 0.02, 0.05, 0.10, 0.20)  # upper ends of the classes of sigma; the last has none
GRID_SHARE = 0.2  # of the longer side: about how far grid lines lie apart
BAR_SHARE = 0.25


@dataclass(frozen=True, slots=True)
class _Frame:
    """The sheet, in m of the map."""

    x_min_m: float
    y_min_m: float
    width_m: float
    height_m: float

    def at(self, xy_map: Floats) -> Floats:
        """m in the map -> m from the upper left corner."""
        return np.column_stack((xy_map[:, 0] - self.x_min_m, self.y_min_m + self.height_m - xy_map[:, 1]))


def map_figure(content: Content) -> Markup:
    shown = _coarser(known_part(content.picture))
    frame = _Frame(shown.x_min_m, shown.y_min_m, shown.width * shown.cell_m, shown.height * shown.cell_m)
    png = b64encode(png_bytes(shown, GREY_UNKNOWN)).decode("ascii")
    image = tag(
        "image", href=f"data:image/png;base64,{png}", width=f"{frame.width_m:.4f}",
        height=f"{frame.height_m:.4f}", class_="cells", preserve_aspect_ratio="none",
    )  # fmt: skip
    step_m = scale_bar_m(max(frame.width_m, frame.height_m), GRID_SHARE)
    drawing = tag(
        "svg",
        tag("title", "Map with the path driven"),
        image,
        tag("path", class_="grid", d=_grid(frame, step_m)),
        _loops(content, frame),
        _path(content.states, content.trajectory, frame) if content.trajectory is not None else None,
        view_box=f"0 0 {frame.width_m:.4f} {frame.height_m:.4f}",
        role="img",
    )
    bar_m = scale_bar_m(frame.width_m, BAR_SHARE)
    bar = tag("div", f"{bar_m:g} m", class_="scale_bar", style=f"width:{100 * bar_m / frame.width_m:.3f}%")
    turn_deg = 0.0 if content.geo is None else np.degrees(content.geo.pose_enu_map.theta_rad)
    north = tag(
        "div", tag("span", "↑", style=f"transform:rotate({turn_deg:.2f}deg)"),
        "N" if content.geo is not None else "y", class_="north",
    )  # fmt: skip
    shape = f"aspect-ratio:{frame.width_m:.4f}/{frame.height_m:.4f};"
    shape += f"max-width:calc(80vh*{frame.width_m / frame.height_m:.4f})"
    figure = tag("div", drawing, _coordinates(frame, step_m), bar, north, class_="map", style=shape)
    return tag("figure", figure, _legend(content))


def _coarser(picture: Picture) -> Picture:
    """With several cells in a pixel where it has too many; a wall in one of them fills it."""
    k = -(-max(picture.width, picture.height) // MAX_PIXELS)
    if k <= 1:
        return picture
    width, height = -(-picture.width // k), -(-picture.height // k)

    def bands() -> Iterator[Pixels]:
        waiting = np.empty((0, picture.width), np.uint8)
        for band in picture.bands():
            waiting = np.concatenate((waiting, band))
            whole = len(waiting) // k * k
            if whole:
                yield _smallest(waiting[:whole], k)
            waiting = waiting[whole:]
        if len(waiting):
            yield _smallest(waiting, k)

    cell_m = k * picture.cell_m
    y_min_m = picture.y_min_m + picture.height * picture.cell_m - height * cell_m
    return Picture(width, height, cell_m, picture.x_min_m, y_min_m, bands)


def _smallest(pixels: Pixels, k: int) -> Pixels:
    """Smallest value of each k x k pixels, incomplete blocks at the right and the bottom included."""
    rows = np.minimum.reduceat(pixels, np.arange(0, pixels.shape[0], k), axis=0)
    return np.minimum.reduceat(rows, np.arange(0, pixels.shape[1], k), axis=1)


def _path(states: States, trajectory: Trajectory, frame: _Frame) -> Markup:
    """Stretches of one class each, below them halos where the state was not ok; begin and end."""
    poses = trajectory.pose
    rows = np.array(thinned(poses[:, :2], frame.width_m / MAX_POINTS, MAX_POINTS))
    at = frame.at(poses)
    row_of = np.searchsorted(states.stamp_ns, trajectory.stamp_ns).clip(0, len(states.stamp_ns) - 1)
    classes = np.digitize(states.sigma[row_of, :2].max(axis=1), CLASSES_M)  # the worse direction
    elements = []
    for state in ("degraded", "lost"):
        is_so = (np.array(states.state) == state)[row_of]
        elements += [
            tag("polyline", class_=f"halo {state}", points=_points(at[begin:end]))
            for begin, end in _runs(is_so)
        ]
    worst = np.maximum.reduceat(classes, rows)  # between two points that are plotted, the worst counts
    for begin, end in _stretches(worst):
        points = _points(at[rows[begin : min(end, len(rows) - 1) + 1]])
        elements.append(tag("polyline", class_=f"path s{worst[begin]}", points=points))
    for name, place in (("begin", at[0]), ("end", at[-1])):
        elements.append(
            tag("path", tag("title", name), class_=f"mark {name}", d=f"M{place[0]:.3f} {place[1]:.3f}h0")
        )
    return joined(elements)


def _runs(is_so: npt.NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and last + 1 of each stretch that is so, with the pose on either side."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], is_so.astype(np.int8), [0]))))
    for begin, end in edges.reshape(-1, 2).tolist():
        yield max(begin - 1, 0), end + 1


def _stretches(values: npt.NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """First and last + 1 of each stretch of equal values."""
    edges = np.flatnonzero(np.diff(values)) + 1
    yield from zip([0, *edges.tolist()], [*edges.tolist(), len(values)], strict=True)


def _loops(content: Content, frame: _Frame) -> Markup:
    return joined(
        [
            tag(
                "path",
                tag("title", f"loop, off by {loop.off_mm:.0f} mm"),
                class_="loop",
                d=f"M{x:.3f} {y:.3f}h0",
            )
            for loop in content.loops or ()
            if not loop.why_not
            for x, y in frame.at(np.array([[loop.x_m, loop.y_m]])).tolist()
        ]
    )


def _ticks(low_m: float, size_m: float, step_m: float) -> list[float]:
    first, last = math.ceil(low_m / step_m), math.floor((low_m + size_m) / step_m)
    return [k * step_m for k in range(first, last + 1)]


def _grid(frame: _Frame, step_m: float) -> str:
    x_m = [
        f"M{x - frame.x_min_m:.3f} 0v{frame.height_m:.3f}"
        for x in _ticks(frame.x_min_m, frame.width_m, step_m)
    ]
    top_m = frame.y_min_m + frame.height_m
    y_m = [f"M0 {top_m - y:.3f}h{frame.width_m:.3f}" for y in _ticks(frame.y_min_m, frame.height_m, step_m)]
    return "".join((*x_m, *y_m))


def _coordinates(frame: _Frame, step_m: float) -> list[Markup]:
    """Coordinates of the grid lines, along the top and the left edge."""
    return [
        tag("span", f"{x:g}", class_="tick x", style=f"left:{100 * (x - frame.x_min_m) / frame.width_m:.3f}%")
        for x in _ticks(frame.x_min_m, frame.width_m, step_m)
    ] + [
        tag(
            "span",
            f"{y:g}",
            class_="tick y",
            style=f"bottom:{100 * (y - frame.y_min_m) / frame.height_m:.3f}%",
        )
        for y in _ticks(frame.y_min_m, frame.height_m, step_m)
    ]


def _legend(content: Content) -> Markup:
    entries = []
    if content.trajectory is not None:
        ends = ["0", *(f"{100 * end:g}" for end in CLASSES_M)]
        words = [f"{low} to {high} cm" for low, high in pairwise(ends)]
        words = [f"below {ends[1]} cm", *words[1:], f"above {ends[-1]} cm"]
        entries += [_entry(f"path s{k}", text) for k, text in enumerate(words)]
        entries += [_entry("halo degraded", "degraded"), _entry("halo lost", "lost")]
        entries += [_entry("mark begin", "begin"), _entry("mark end", "end")]
    if any(not loop.why_not for loop in content.loops or ()):
        entries.append(_entry("loop", "loop closed here"))
    return tag("figcaption", tag("b", "sigma of the position"), entries)


def _entry(name: str, text: str) -> Markup:
    is_line = name.startswith(("path", "halo"))
    line = tag("svg", tag("path", class_=name, d="M0 7h26" if is_line else "M13 7h0"), view_box="0 0 26 14")
    return tag("span", line, text, class_="entry")


def _points(at: Sequence[Sequence[float]] | Floats) -> str:
    return " ".join(f"{x:.3f},{y:.3f}" for x, y in np.asarray(at).tolist())
