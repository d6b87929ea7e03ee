"""The truth: walls that reflect, people who walk, and the drive of the vehicle through them.

A world's frame is the pose of the base before it starts, so the truth compares directly with a map whose
frame is the first pose. Time is seconds since the drive began; people have positions at negative times too.
"""

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2
from service.kernels.raycast import cast_rays, index_segments
from simulators.trajectory import Floats, Trajectory

CELL_M = 1.0  # of the grid that finds walls near a ray
PERSON_RADIUS_M, PERSON_REFLECTIVITY = 0.25, 0.4
POST_CORNERS = 8

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Walk:
    """A person who walks a round of points, stopping at each, again and again with a fixed period; before
    time 0 the person stands at the first.
    """

    times_s: tuple[float, ...]  # rising from 0 to the period
    places: tuple[Point, ...]  # m, where the person is at these times; the last is the first
    radius_m: float = PERSON_RADIUS_M
    from_s: float = -math.inf  # the person is absent before, and
    to_s: float = math.inf  # from then on

    @property
    def period_s(self) -> float:
        return self.times_s[-1]

    def place(self, time_s: float) -> Point:
        phase_s = max(time_s, 0.0) % self.period_s
        k = min(bisect_right(self.times_s, phase_s), len(self.times_s) - 1)
        (x0, y0), (x1, y1) = self.places[k - 1], self.places[k]
        share = (phase_s - self.times_s[k - 1]) / (self.times_s[k] - self.times_s[k - 1])
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0)

    def later(self, wait_s: float) -> "Walk":
        """The same round with a wait of wait_s at the first point, each time."""
        times_s = (0.0, *(time_s + wait_s for time_s in self.times_s))
        return replace(
            self,
            times_s=times_s,
            places=(self.places[0], *self.places),
            from_s=self.from_s + wait_s,
            to_s=self.to_s + wait_s,
        )

    def seen_from(self, frame: SE2) -> "Walk":
        places = tuple((float(x), float(y)) for x, y in _seen_from(frame, np.array(self.places)))
        return replace(self, places=places)


def walk(
    points: Sequence[Point],
    period_s: float,
    speed_mps: float = 1.0,
    pause_s: float | Sequence[float] = 2.0,
    begin_s: float = 0.0,
) -> Walk:
    """A round through `points` and back to the first, begun `begin_s` into each period, with a pause (or one
    for each) at the points after the first, where the person waits until it is time again.
    Raises ValueError where the round takes longer than the period.
    """
    pauses_s = [pause_s] * (len(points) - 1) if isinstance(pause_s, int | float) else pause_s
    times_s, places = [0.0], [points[0]]
    now_s = begin_s
    for here, there, rest_s in zip(points, [*points[1:], points[0]], [*pauses_s, 0.0], strict=True):
        for path_s, place in ((0.0, here), (math.dist(here, there) / speed_mps, there), (rest_s, there)):
            now_s += path_s
            if now_s > times_s[-1]:
                times_s.append(now_s)
                places.append(place)
    if now_s > period_s:
        raise ValueError(f"walk from {points[0]} takes {now_s:.1f} s, its period is {period_s:.1f} s")
    if period_s > now_s:
        times_s.append(period_s)
        places.append(points[0])
    return Walk(tuple(times_s), tuple(places))


@dataclass(frozen=True, eq=False)
class Mover:
    """A rigid thing with flat faces on its path: a train, the line where a tilted laser meets the floor."""

    faces: Floats  # (F, 4) x0, y0, x1, y1 in its own frame, m
    path: (
        Floats  # (N, 4) time s, rising, and x m, y m, theta rad (unwrapped) of its frame; straight in between
    )
    from_s: float  # absent before, and
    to_s: float  # from then on
    reflectivity: float = 0.5
    sensor: str | None = None  # the only one that it returns the beams of; None: all

    def ends(self, time_s: float) -> Floats:
        """(F, 4) of its faces at that time, m."""
        x, y, theta = (np.interp(time_s, self.path[:, 0], column) for column in self.path[:, 1:].T)
        c, s = math.cos(theta), math.sin(theta)
        turned: Floats = self.faces.reshape(-1, 2) @ np.array([[c, s], [-s, c]]) + (x, y)
        return turned.reshape(-1, 4)

    def later(self, wait_s: float) -> "Mover":
        path = self.path + np.array([wait_s, 0.0, 0.0, 0.0])
        return replace(self, path=path, from_s=self.from_s + wait_s, to_s=self.to_s + wait_s)


@dataclass(frozen=True, eq=False)
class World:
    """All objects, in the frame of the vehicle's start."""

    name: str
    segments: Floats  # (S, 4) x0, y0, x1, y1, m
    reflectivity: Floats  # (S,) 0..1, share of the light that returns from a white (1) wall at a right angle
    people: tuple[Walk, ...]
    drive: Trajectory
    grid_frame: Floats
    cell_span: npt.NDArray[np.int32]
    cell_items: npt.NDArray[np.int32]
    glass: npt.NDArray[np.bool_]  # (S,) returns only beams at about a right angle; others pass
    cabinet: npt.NDArray[np.bool_]  # (S,) glass with objects close behind it: see truth.CABINET_LOST
    movers: tuple[Mover, ...] = ()

    @cached_property
    def without_glass(self) -> "World":
        """The same without the panes."""
        segments = self.segments.copy()
        segments[self.glass, 2:] = segments[self.glass, :2]  # without a length no beam hits it
        return replace(self, segments=segments)

    def discs(self, time_s: float, span_s: float) -> Floats:
        """(D, 5) place, velocity and radius of each person there at time_s, straight from then for span_s."""
        people = [person for person in self.people if person.from_s <= time_s < person.to_s]
        discs = np.zeros((len(people), 5))
        for disc, person in zip(discs, people, strict=True):
            here, there = person.place(time_s), person.place(time_s + span_s)
            disc[:] = *here, (there[0] - here[0]) / span_s, (there[1] - here[1]) / span_s, person.radius_m
        return discs

    def faces(self, time_s: float, span_s: float, sensor: str) -> Floats:
        """(F, 9) of each face of a mover that this sensor sees: its ends at time_s (m), their velocities
        (m/s, straight from then for span_s), its reflectivity.
        """
        seen = [
            mover
            for mover in self.movers
            if mover.from_s <= time_s < mover.to_s and mover.sensor in (None, sensor)
        ]
        faces = [np.empty((0, 9))]
        for mover in seen:
            here, there = mover.ends(time_s), mover.ends(time_s + span_s)
            light = np.full((len(here), 1), mover.reflectivity)
            faces.append(np.hstack([here, (there - here) / span_s, light]))
        return np.vstack(faces)

    def cast(self, rays: Floats, discs: Floats, range_max_m: float) -> tuple[Floats, npt.NDArray[np.int32]]:
        """Range (m, inf for none) and what was hit of each ray; see kernels.raycast.cast_rays."""
        range_m, hit = cast_rays(
            rays, self.segments, discs, self.grid_frame, self.cell_span, self.cell_items, range_max_m
        )
        return range_m, hit


def make_world(name: str, plan: "Plan", people: Sequence[Walk], drive: Trajectory) -> World:
    """A world from a plan, people and a drive that share one frame of the author's choice."""
    start = drive.start
    ends = _seen_from(start, np.array(plan.segments).reshape(-1, 2))
    # Walls tend to be at integer metres: keep them off the cells' borders.
    low = ends.min(axis=0) - 0.37 * CELL_M
    columns, rows = np.ceil((ends.max(axis=0) + 0.01 - low) / CELL_M).astype(int)
    segments = np.ascontiguousarray(ends.reshape(-1, 4))
    grid_frame = np.array([*low, CELL_M])
    cell_span, cell_items = index_segments(segments, grid_frame, int(rows), int(columns))
    return World(
        name,
        segments,
        np.array(plan.reflectivity),
        tuple(person.seen_from(start) for person in people),
        drive.seen_from(start),
        grid_frame,
        cell_span,
        cell_items,
        np.array(plan.glass, dtype=np.bool_),
        np.array(plan.cabinet, dtype=np.bool_),
    )


def _seen_from(frame: SE2, points: Floats) -> Floats:
    origin = frame.inverse()
    c, s = math.cos(origin.theta_rad), math.sin(origin.theta_rad)
    seen: Floats = points @ np.array([[c, s], [-s, c]]) + (origin.x_m, origin.y_m)
    return seen


class Plan:
    """Plan of walls and furniture. Lengths in metres, angles in degrees."""

    def __init__(self) -> None:
        self.segments: list[tuple[float, float, float, float]] = []
        self.reflectivity: list[float] = []
        self.glass: list[bool] = []
        self.cabinet: list[bool] = []

    def line(
        self, *points: Point, reflectivity: float = 0.6, glass: bool = False, cabinet: bool = False
    ) -> None:
        """Thin surfaces from point to point; of glass they return only beams at about a right angle.

        cabinet: the front of a glass cabinet, of which most beams do not return and many from behind.
        """
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            self.segments.append((x0, y0, x1, y1))
            self.reflectivity.append(reflectivity)
            self.glass.append(glass)
            self.cabinet.append(cabinet)

    def box(self, centre: Point, size: Point, turn_deg: float = 0.0, reflectivity: float = 0.4) -> None:
        """A rectangular object: a cabinet, a desk's leg, a crate."""
        c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        half = [(size[0] * u / 2, size[1] * v / 2) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
        corners = [(centre[0] + c * x - s * y, centre[1] + s * x + c * y) for x, y in half]
        self.line(*corners, reflectivity=reflectivity)

    def post(self, centre: Point, radius: float, reflectivity: float = 0.4) -> None:
        """A round object: a column, a plant pot."""
        angles = [2 * math.pi * k / POST_CORNERS for k in range(POST_CORNERS + 1)]
        rim = [(centre[0] + radius * math.cos(a), centre[1] + radius * math.sin(a)) for a in angles]
        self.line(*rim, reflectivity=reflectivity)

    def table(self, centre: Point, size: Point, turn_deg: float = 0.0) -> None:
        """Four thin metal legs: the returns of a table at the height of a laser."""
        c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            x, y = size[0] * u / 2, size[1] * v / 2
            self.box((centre[0] + c * x - s * y, centre[1] + s * x + c * y), (0.05, 0.05), turn_deg, 0.3)

    def wall(
        self, begin: Point, end: Point, gaps: Sequence[tuple[float, float]] = (), thickness: float = 0.12
    ) -> None:
        """A wall with two faces around its centre line; gaps are (from, to) along it, measured from begin."""
        length = math.dist(begin, end)
        c, s = (end[0] - begin[0]) / length, (end[1] - begin[1]) / length
        edges = [0.0, *(edge for gap in sorted(gaps) for edge in gap), length]
        for low, high in zip(edges[::2], edges[1::2], strict=True):
            if high - low > 1e-6:
                middle = (low + high) / 2
                centre = (begin[0] + c * middle, begin[1] + s * middle)
                turn_deg = math.degrees(math.atan2(s, c))
                self.box(centre, (high - low, thickness), turn_deg, 0.6)

    def sunk_doors(
        self, begin: Point, end: Point, doors: Sequence[float], depth: float = 0.25, width: float = 0.9
    ) -> None:
        """One face of a wall with door niches: each begins that far from `begin` and recedes to the left (a
        negative depth: to the right).
        """
        length = math.dist(begin, end)
        c, s = (end[0] - begin[0]) / length, (end[1] - begin[1]) / length
        outline = [(0.0, 0.0)]
        for at in sorted(doors):
            outline += [(at, 0.0), (at, depth), (at + width, depth), (at + width, 0.0)]
        outline.append((length, 0.0))
        points = [(begin[0] + c * u - s * v, begin[1] + s * u + c * v) for u, v in outline]
        self.line(*points)

    def door(self, hinge: Point, closed_deg: float, open_deg: float = 0.0, width: float = 0.9) -> None:
        """A door leaf: a board that hangs at `hinge`; closed_deg is its direction when shut."""
        turn_deg = closed_deg + open_deg
        c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        self.box((hinge[0] + c * width / 2, hinge[1] + s * width / 2), (width, 0.04), turn_deg, 0.5)
