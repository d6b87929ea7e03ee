"""The graph of track points and virtual landmarks, updated by closed sub-maps and by requests.

Zhang et al. 2016: a track point every few metres, odometry terms between them, and landmark terms to points
that two sub-maps share. Landmarks come from aligning sub-maps with each other, or from pairs of points set by
the operator.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2, wrap_angle
from service.mapper.components import MapRenderer, RenderedMap, ScanToRender
from service.mapper.graph.model.graph_picture import draw
from service.mapper.graph.model.point_clouds import PointCloud, SurfelSet
from service.mapper.graph.model.pose_graph import Edges, GraphError, PoseGraph, Sightings, to_g2o
from service.mapper.graph.model.pose_graph_solver import solve
from service.mapper.matchers.covariances import diagonal, in_base_axes
from service.mapper.papers.submap_graph.counted_submaps import ClosedSubmap
from service.mapper.papers.submap_graph.graph.submap_match import (
    Found,
    SubmapMatchConfig,
    WallPoints,
    about_origin,
    extract_walls,
    find,
    is_seen,
)
from service.mapper.papers.submap_graph.graph.submap_realignment import (
    SubmapRealignment,
    align_cloud,
    cloud_of,
)
from service.mapper.papers.submap_graph.key_scan import InsertedScan, KeptScan
from service.outputs import GraphPicture

SURFEL_POINTS = 2000  # of a sub-map, aligned with the surfels of another
MAX_WALLS = 8  # sub-maps whose walls are cached: they take two to four times as much memory as their scans


Ints = npt.NDArray[np.int64]


class LandmarkGraphConfig(Section):
    """Which sub-maps are aligned with each other, and the noise of odometry between track points."""

    match: SubmapMatchConfig = SubmapMatchConfig()
    # Least share of inliers when a scan or a sub-map is aligned again.
    least_on_surfels: float = Field(default=0.4, ge=0.0, le=1.0)
    node_spacing_m: float = Field(default=2.0, gt=0.0)  # between track points
    drift_m_per_sqrt_m: float = Field(default=0.005, gt=0.0)
    drift_rad_per_sqrt_m: float = Field(default=0.001, gt=0.0)
    # Sub-maps whose paths are closer than this are aligned with each other.
    neighbour_m: float = Field(default=6.0, gt=0.0)
    most_neighbours: int = Field(default=3, ge=1)
    search_m: float = Field(default=0.5, gt=0.0)  # to each side of the neighbour's pose by the graph
    search_per_m: float = Field(default=0.01, ge=0.0)  # added for each metre of path between the two
    most_search_m: float = Field(default=3.0, gt=0.0)
    search_rad: float = Field(default=0.08, gt=0.0)
    kernel_width: float = Field(default=1.0, ge=0.0)  # Cauchy, in sigmas, of a match
    pair_sigma_m: float = Field(default=0.02, gt=0.0)  # of a point set by the operator
    # The published map is rendered again if a track point moved this far.
    render_again_m: float = Field(default=0.03, ge=0.0)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two points of the published map that are the same point, each observed by a sub-map."""

    number: int
    submaps: tuple[int, int]
    xy_map: tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """A task of the back end. `pair` goes with "add" and "remove"."""

    what: Literal["submap", "add", "remove", "undo", "optimize", "finish"]
    closed: ClosedSubmap | None = None
    pair: Pair | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """The result of a batch.

    stamps, poses   (K,) int64 and (K, 3): every key scan so far, in the map frame
    pose_map_odom   of the newest
    links           pairs of sub-maps connected by automatic landmarks
    residual_m      by number of the pair: present distance of its two points
    rms_m           the same of all landmarks
    g2o, keyframes  after the last batch: the graph as text, and the number of its poses of the path
    fault         why nothing was solved; "" else
    """

    submaps: int
    stamps: npt.NDArray[np.int64]
    poses: Floats
    pose_map_odom: SE2
    links: int
    landmarks: int
    residual_m: dict[int, float]
    rms_m: float
    rendered_map: RenderedMap | None
    fault: str
    g2o: str = ""
    keyframes: int = 0
    picture: GraphPicture | None = None


@dataclass(slots=True, eq=False)
class _Submap:
    closed: ClosedSubmap  # realigned, of kept scans
    end_odom: Floats  # (3,) of its last scan, by the particle
    begin_m: float  # path length before it
    border: Floats  # (4, 2) corners around its walls, as inserted
    nodes: list[int] = field(default_factory=list)  # own nodes in the graph
    behind: list[int] = field(default_factory=list)  # for each own scan the last node up to it

    @property
    def own(self) -> slice:
        return slice(self.closed.carried, None)


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """A sub-map aligned with another. Its error is common to all landmarks found in it.

    submaps      the new one and the old one
    middle       (3,) of the landmarks, in the frame of the new one
    there        (3,) its matched pose, in the frame of the old one
    covariance   (3, 3) of that, in its own axes
    """

    submaps: tuple[int, int]
    middle: Floats
    there: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Landmark:
    """A point that two sub-maps share: its position in the frame of each, and its sigma in either."""

    submaps: tuple[int, int]
    xy: tuple[Floats, Floats]
    sigma_m: float
    match: int | None = None  # the match that gave its position in the second
    pair: int | None = None  # the pair of the operator


@dataclass(slots=True, eq=False)
class LandmarkBackEnd:
    """BackEnd. Track points are in two frames: `odom_poses` in odom, with realigned scans; `poses` in map."""

    config: LandmarkGraphConfig
    renderer: MapRenderer | None
    submaps: list[_Submap] = field(default_factory=list)
    odom_poses: list[Floats] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    path_length_m: list[float] = field(default_factory=list)
    matches: list[_Match] = field(default_factory=list)
    landmarks: list[_Landmark] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)
    tried: set[tuple[int, int]] = field(default_factory=set)
    walls: dict[int, WallPoints] = field(default_factory=dict)  # by sub-map, least recently used first
    rendered: Floats | None = None  # poses of the nodes at the last rendering of the published map
    realignment: SubmapRealignment = field(init=False)

    def __post_init__(self) -> None:
        self.realignment = SubmapRealignment(self.config.least_on_surfels)

    def work(self, batch: Batch) -> Result:
        fault = ""
        try:
            if batch.what == "submap" and batch.closed is not None:
                if self._add(batch.closed):
                    self._solve()
            elif batch.what == "finish":
                if self._tie_again():
                    self._solve()
            else:
                self._change_pairs(batch)
                self._solve()
        except GraphError as error:
            fault = str(error)
        return self._result(fault, is_last=batch.what == "finish")

    def _add(self, closed: ClosedSubmap) -> bool:
        """Add a sub-map; returns whether landmarks were found in others."""
        begin_m = self.path_length_m[-1] if self.path_length_m else 0.0
        aligned = self.realignment.realign(closed)
        scans: tuple[InsertedScan, ...] = tuple(KeptScan.of(scan) for scan in closed.scans[closed.carried :])
        if closed.carried:  # shared with the previous sub-map: stored once
            scans = self.submaps[-1].closed.scans[-closed.carried :] + scans
        submap = _Submap(replace(aligned, scans=scans), closed.track[-1], begin_m, _corners(aligned))
        self.submaps.append(submap)
        for pose in aligned.track[submap.own]:
            away_m = math.dist(pose[:2], self.odom_poses[-1][:2]) if self.odom_poses else 0.0
            if not self.odom_poses:
                self._add_node(submap, pose, pose, 0.0)
            elif away_m >= self.config.node_spacing_m or not submap.nodes:
                moved = se2.compose(self.poses[-1], se2.between(self.odom_poses[-1], pose))
                self._add_node(submap, pose, moved, self.path_length_m[-1] + away_m)
            submap.behind.append(len(self.odom_poses) - 1)
        return self._tie(len(self.submaps) - 1, widely=True)

    def _add_node(self, submap: _Submap, odom_poses: Floats, pose: Floats, path_length_m: float) -> None:
        submap.nodes.append(len(self.odom_poses))
        self.odom_poses.append(odom_poses)
        self.poses.append(pose)
        self.path_length_m.append(path_length_m)

    def _tie_again(self) -> bool:
        """Align sub-maps that are near each other by now and were not aligned yet."""
        ties = [self._tie(k, widely=False) for k in range(len(self.submaps))]
        return any(ties)

    def _tie(self, new: int, widely: bool) -> bool:
        """Find landmarks of a sub-map in earlier ones, the nearest first."""
        config = self.config
        tied = False
        for away_m, old in self._neighbours(new)[: config.most_neighbours]:
            if away_m > config.neighbour_m or (old, new) in self.tried:
                continue
            reach_m = config.search_m
            if widely:
                driven_m = self.submaps[new].begin_m - self.submaps[old].begin_m
                reach_m = min(reach_m + config.search_per_m * driven_m, config.most_search_m)
            found = find(
                self._walls(new),
                self._walls(old),
                self._guess(new, old),
                (reach_m, config.search_rad),
                config.match,
            )
            found = found and self._on_surfels(new, old, found)
            if found is None:
                continue
            self.tried.add((old, new))
            tied = True
            self._keep(new, old, found.pose, found.covariance, found.landmarks)
        return tied

    def _on_surfels(self, new: int, old: int, found: Found) -> Found | None:
        """The same, refined point to line; None where too few of the common points are inliers."""
        config = self.config
        cloud, other = self._cloud(new), self._walls(old)
        common = is_seen(other, se2.points_from(found.pose, cloud.xy))
        shared = PointCloud(cloud.xy[common], cloud.normals[common], cloud.sigma_m[common])
        fit, shift = align_cloud(shared, SurfelSet(self._cloud(old)), found.pose, SURFEL_POINTS)
        if fit.share < config.least_on_surfels:
            return None
        covariance = config.match.match_covariance_scale * np.linalg.inv(fit.information + 1e-2 * np.eye(3))
        at_origin = about_origin(np.asarray(covariance, np.float64), fit.pose, shift)
        return replace(found, pose=shift, covariance=at_origin, share=fit.share)

    def _walls(self, number: int) -> WallPoints:
        """The walls of a sub-map, recomputed from its scans if not cached."""
        walls = self.walls.pop(number, None)
        if walls is None:
            walls = extract_walls(self.submaps[number].closed, self.config.match)
        self.walls[number] = walls
        if len(self.walls) > MAX_WALLS:
            del self.walls[next(iter(self.walls))]
        return walls

    def _cloud(self, number: int) -> PointCloud:
        closed = self.submaps[number].closed
        return cloud_of(closed.scans, closed.track)

    def _keep(self, new: int, old: int, shift: Floats, covariance: Floats, landmarks: Floats) -> None:
        config = self.config.match
        middle = np.array([*landmarks.mean(axis=0), 0.0])
        there = se2.compose(shift, middle)
        known = in_base_axes(about_origin(covariance, shift, there), float(there[2]))
        known = known + diagonal(config.match_sigma_m, config.match_sigma_rad)
        self.matches.append(_Match((new, old), middle, there, known))
        for xy in landmarks:
            ends = xy, se2.points_from(shift, xy)
            self.landmarks.append(
                _Landmark((new, old), ends, config.landmark_sigma_m, match=len(self.matches) - 1)
            )

    def _neighbours(self, new: int) -> list[tuple[float, int]]:
        poses = np.array(self.poses)
        mine = poses[self.submaps[new].nodes, :2]
        found = []
        for old in range(new - 1):  # the previous one shares scans, so it adds nothing to odometry
            theirs = poses[self.submaps[old].nodes, :2]
            apart = np.hypot(*(mine[:, None] - theirs[None]).transpose(2, 0, 1))
            found.append((round(float(apart.min()), 6), old))
        return sorted(found)

    def _guess(self, new: int, old: int) -> Floats:
        """Pose of the frame of `new` in that of `old`, by the graph, at their closest nodes."""
        poses = np.array(self.poses)
        mine, theirs = self.submaps[new].nodes, self.submaps[old].nodes
        apart = np.hypot(*(poses[mine, None, :2] - poses[None, theirs, :2]).transpose(2, 0, 1))
        a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
        new_node, old_node = mine[int(a)], theirs[int(b)]
        between = se2.between(poses[old_node], poses[new_node])
        there = se2.compose(self.odom_poses[old_node], between)
        origin = np.zeros(3)
        return se2.compose(there, se2.between(self.odom_poses[new_node], origin))

    def _change_pairs(self, batch: Batch) -> None:
        if batch.what == "add" and batch.pair is not None:
            self.pairs.append(batch.pair)
            first, second = (
                self._in_drawing(submap, np.array(xy))
                for submap, xy in zip(batch.pair.submaps, batch.pair.xy_map, strict=True)
            )
            sigma_m, number = self.config.pair_sigma_m, batch.pair.number
            self.landmarks.append(_Landmark(batch.pair.submaps, (first, second), sigma_m, pair=number))
        elif batch.what in ("remove", "undo") and batch.pair is not None:
            number = batch.pair.number
            self.pairs = [pair for pair in self.pairs if pair.number != number]
            self.landmarks = [mark for mark in self.landmarks if mark.pair != number]

    def _in_drawing(self, submap: int, xy_map: Floats) -> Floats:
        """A point of the map in the frame of a sub-map, by its nearest track point."""
        nodes = self.submaps[submap].nodes
        node = min(nodes, key=lambda k: math.dist(self.poses[k][:2], xy_map))
        return se2.points_from(self.odom_poses[node], se2.points_seen(self.poses[node], xy_map))

    def _nearest(self, submap: int, xy: Floats) -> int:
        """The track point of a sub-map that is nearest to a point of its frame."""
        return min(self.submaps[submap].nodes, key=lambda node: math.dist(self.odom_poses[node][:2], xy[:2]))

    def _graph(self) -> PoseGraph:
        """The pose graph; after the track points one pose for each match: that of its landmarks' centre.

        The landmarks are observed from there and from the new sub-map, so that the error of the match is
        common to all of them.
        """
        odom_poses, poses = np.array(self.odom_poses), np.array(self.poses)
        count = len(odom_poses)
        measured = se2.between(odom_poses[:-1], odom_poses[1:])
        path_length_m = np.maximum(np.diff(self.path_length_m), 0.1)
        covariance = np.zeros((count - 1, 3, 3))
        covariance[:, 0, 0] = covariance[:, 1, 1] = self.config.drift_m_per_sqrt_m**2 * path_length_m
        covariance[:, 2, 2] = self.config.drift_rad_per_sqrt_m**2 * path_length_m
        edges = Edges(np.arange(count - 1), np.arange(1, count), measured, covariance, np.zeros(count - 1))
        if self.matches:
            holds = np.array([self._nearest(match.submaps[1], match.there) for match in self.matches])
            aligned = se2.between(odom_poses[holds], np.array([match.there for match in self.matches]))
            known = np.array([match.covariance for match in self.matches])
            widths = np.full(len(holds), self.config.kernel_width)
            edges = edges.followed_by(Edges(holds, count + np.arange(len(holds)), aligned, known, widths))
            poses = np.concatenate((poses, se2.compose(poses[holds], aligned)))
        of, seen, guess = [], [], []
        for mark in self.landmarks:
            for side in (0, 1):
                if side and mark.match is not None:
                    node = count + mark.match
                    xy = se2.points_seen(self.matches[mark.match].middle, mark.xy[0])
                else:
                    node = self._nearest(mark.submaps[side], mark.xy[side])
                    xy = se2.points_seen(odom_poses[node], mark.xy[side])
                of.append(node)
                seen.append(xy)
            guess.append(se2.points_from(poses[of[-1]], seen[-1]))
        variances = np.repeat([mark.sigma_m**2 for mark in self.landmarks], 2)
        sightings = Sightings(
            np.array(of, np.int64),
            np.repeat(np.arange(len(self.landmarks)), 2),
            np.array(seen).reshape(-1, 2),
            variances.reshape(-1, 1, 1) * np.eye(2),
            np.zeros(len(of)),
        )
        return PoseGraph(poses, edges, np.array(guess).reshape(-1, 2), sightings)

    def _solve(self) -> None:
        if len(self.odom_poses) < 2:
            return
        self.poses = list(solve(self._graph()).poses[: len(self.odom_poses)])

    def _key_poses(self) -> tuple[npt.NDArray[np.int64], Floats]:
        """Stamps and map poses of all key scans, interpolated between the track points on both sides."""
        closed = [submap.closed for submap in self.submaps]
        stamps = [scan.stamp_ns for one in closed for scan in one.scans[one.carried :]]
        odom_poses = np.concatenate([one.track[one.carried :] for one in closed])
        before = np.array([node for submap in self.submaps for node in submap.behind], np.int64)
        after = np.minimum(before + 1, len(self.odom_poses) - 1)
        poses = _bent(np.array(self.poses), np.array(self.odom_poses), before, after, odom_poses)
        return np.array(stamps, np.int64), poses

    def _result(self, fault: str, is_last: bool) -> Result:
        if not self.submaps:
            none = np.empty(0, np.int64), np.empty((0, 3))
            return Result(0, *none, SE2(), 0, 0, {}, 0.0, None, fault)
        stamps, poses = self._key_poses()
        map_odom = se2.compose(poses[-1], se2.between(self.submaps[-1].end_odom, np.zeros(3)))
        nodes = np.array(self.poses)
        before = np.array(self.odom_poses) if self.rendered is None else self.rendered
        moved_m = float(np.hypot(*(nodes[: len(before)] - before[: len(nodes)]).T[:2]).max())
        rendered_map = None
        if self.renderer is not None and moved_m > (0.0 if is_last else self.config.render_again_m):
            self.rendered = nodes
            rendered_map = self.renderer.render(self._scans_to_render(poses))
        apart_m = [self._apart_m(mark) for mark in self.landmarks]
        residuals = {
            mark.pair: apart
            for mark, apart in zip(self.landmarks, apart_m, strict=True)
            if mark.pair is not None
        }
        return Result(
            len(self.submaps),
            stamps,
            poses,
            SE2(*map_odom.tolist()),
            len(self.tried),
            len(self.landmarks),
            residuals,
            math.sqrt(sum(apart * apart for apart in apart_m) / max(len(apart_m), 1)),
            rendered_map,
            fault,
            to_g2o(self._graph()) if is_last and len(self.odom_poses) > 1 else "",
            len(self.odom_poses),
            self._picture(int(stamps[-1])),
        )

    def _picture(self, stamp_ns: int) -> GraphPicture:
        """Track points, connected sub-maps and their borders."""
        nodes = np.array(self.poses)
        middle = [submap.nodes[len(submap.nodes) // 2] for submap in self.submaps]
        borders = [
            se2.points_from(nodes[k], se2.points_seen(self.odom_poses[k], submap.border))
            for k, submap in zip(middle, self.submaps, strict=True)
        ]
        ties = sorted(self.tried | {pair.submaps for pair in self.pairs})
        links = np.array([(middle[old], middle[new]) for old, new in ties], np.int64).reshape(-1, 2)
        none = np.empty((0, 2), np.int64)
        return draw(stamp_ns, nodes[:, :2], np.zeros(len(nodes), np.int64), links, none, borders)

    def _scans_to_render(self, poses: Floats) -> Sequence[ScanToRender]:
        scans = [scan for submap in self.submaps for scan in submap.closed.scans[submap.own]]
        return [
            ScanToRender(scan.xy_base, scan.sensor_xy_m, SE2(*pose.tolist()))
            for scan, pose in zip(scans, poses, strict=True)
        ]

    def _apart_m(self, mark: _Landmark) -> float:
        """Distance of the two positions of a landmark in the map."""
        ends = []
        for side in (0, 1):
            node = self._nearest(mark.submaps[side], mark.xy[side])
            ends.append(
                se2.points_from(self.poses[node], se2.points_seen(self.odom_poses[node], mark.xy[side]))
            )
        return math.dist(*ends)


def _corners(closed: ClosedSubmap) -> Floats:
    """(4, 2) of the bounding box of a sub-map's scans, along the axes of its frame."""
    seen = [
        se2.points_from(pose, scan.xy_base.astype(np.float64))
        for scan, pose in zip(closed.scans, closed.track, strict=True)
    ]
    xy = np.concatenate([closed.track[:, :2], *seen])
    (x0, y0), (x1, y1) = xy.min(axis=0), xy.max(axis=0)
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _bent(map_nodes: Floats, odom_nodes: Floats, a: Ints, b: Ints, poses: Floats) -> Floats:
    """Poses (K, 3) between two track points each, moved by the mean of their corrections, by distance."""
    ends = [se2.compose(map_nodes[k], se2.between(odom_nodes[k], poses)) for k in (a, b)]
    to_a, to_b = (np.hypot(*(odom_nodes[k, :2] - poses[:, :2]).T) for k in (a, b))
    share = np.divide(to_a, to_a + to_b, out=np.zeros(len(poses)), where=to_a + to_b > 0.0)
    apart = ends[1] - ends[0]
    apart[:, 2] = wrap_angle(apart[:, 2])
    bent: Floats = ends[0] + share[:, None] * apart
    return bent
