"""Back end of the default profile: searches loop closures, accepts consistent ones, optimises the graph."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.components import EditAnswer, MapRenderer, PlaceUpdate, RenderedMap
from service.mapper.edit_requests import ONLY_LOCALISED, EditError, LiveChange
from service.mapper.graph.gnss.anchoring import Anchoring
from service.mapper.graph.loops.live_edits import AppliedEdit, LiveEdits, keyframes_near
from service.mapper.graph.loops.loop_batches import Batch, Result
from service.mapper.graph.loops.old_passes import OldPasses, Renumbering
from service.mapper.graph.loops.passes import passes_to_search, stretches_to_search
from service.mapper.graph.loops.picture_schedule import PictureSchedule
from service.mapper.graph.loops.solution_due import SolutionDue
from service.mapper.graph.loops.stored_graph import (
    Placement,
    anchor_loop,
    graph_on_fixed,
    landmarks_of_pairs,
    saved_graph,
    stored_loops,
    to_render,
)
from service.mapper.graph.loops.submap_cache import SubmapCache
from service.mapper.graph.model.candidate_submap import MIN_LOOP_SCORE, REACH_SIGMAS, cloud_of
from service.mapper.graph.model.hindsight import edges_in_hindsight, known_pose
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, thinned
from service.mapper.graph.model.loops import WITHIN_M, Loop, agree, as_edges, loop_of
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.graph.model.odometry_edges import odometry_edges
from service.mapper.graph.model.path_drift import PathDrift, lengths_from
from service.mapper.graph.model.point_clouds import Fit, PointCloud
from service.mapper.graph.model.pose_graph import Edges, PoseGraph, edge_chi2, to_g2o
from service.mapper.graph.model.pose_graph_solver import solve
from service.mapper.graph.model.refusals import Refusals
from service.mapper.graph.relocalise.detached_search import MAX_STATIONARY, DetachedSearch
from service.mapper.graph.relocalise.place_search import EXPECTED_WINDOW
from service.mapper.refused_loops import (
    BY_HAND,
    CONTRADICTED,
    IN_FREE_SPACE,
    NOT_SUPPORTED,
    TOO_FAR,
    TOO_FEW_POINTS,
)
from service.mapper.saved_graph import KeepGraph, SavedGraph

LOOP_WINDOW_M, WINDOW_RAD = 0.5, 0.06  # half a search window without drift: error of a poor match
DRIFTS = (REACH_SIGMAS, 4.0)  # sigmas of drift of position and heading added to half a window
MAX_WINDOW_M, MAX_WINDOW_RAD = 12.0, 1.6  # bounds the search time
FINISH_WINDOW = EXPECTED_WINDOW  # of the final search
MIN_SHARE_ON_MAP = 0.45  # inlier ratio of a loop, by the drive's median: half of a place may have changed
MAX_AGAINST = 0.12  # share of the points in free space of the place: doors closed, objects moved
AGREE_M, AGREE_RAD = 0.15, 0.03  # tolerance between two consistent loops, without drift
CONTRADICTION_CHI2 = 30.0  # of three degrees of freedom, 1 in 700 000: gate of a loop after a solution
VERIFY_WITHIN_M = 2.0  # distance from a key frame of the stored map at which a new session is verified
MAX_SESSION = 600  # key frames, 180 m of path: then a session that only localises drops half of them


class LoopBackEnd:
    """BackEnd. Keeps key frames, loops and poses, after those of a stored map.

    is_localizing   the poses of the stored map are fixed; new key frames are temporary
    anchoring       of the stored map; None: by the fixes of the session
    """

    def __init__(
        self,
        config: LoopsConfig,
        renderer: MapRenderer | None,
        stored: SavedGraph | None = None,
        is_localizing: bool = False,
        keep_graph: KeepGraph | None = None,
        anchoring: Anchoring | None = None,
    ) -> None:
        self._keep_graph = keep_graph
        self._config = config
        self._renderer = renderer
        self.keyframes = KeyframeList(stored)
        self._fixed_count = self.keyframes.stored if is_localizing else 0
        self._is_switched = False  # a mapping session was switched to localisation: only its map is stored
        self._loops: list[Loop] = [] if stored is None else stored_loops(stored)
        self._accepted: list[list[Loop]] = []  # in order of acceptance, for undo
        self._candidates: list[Loop] = []
        self._disabled: list[Loop] = []
        self._gone = 0, 0  # accepted and disabled loops of removed key frames
        self.refusals = Refusals(None if stored is None else stored.refused)
        self._submaps = SubmapCache(config, self.keyframes, self._usable)
        self._drift = PathDrift(self.keyframes, config.keyframe_distance_m)
        self._searched_m = float(self.keyframes.path_length_m[-1]) if stored is not None else 0.0
        self._due = SolutionDue(config, self._searched_m)
        self._joined = {0} if stored is None else set(self.keyframes.segment.tolist())  # placed segments
        self.detached_search = DetachedSearch(config, self.keyframes)
        self._is_merging = self._is_across = False  # as of begin_session_at
        self._placement = Placement(stored is not None)
        self._old_passes = OldPasses(config, self.keyframes)
        self._edits = LiveEdits(self.keyframes, self.refusals)
        self._anchoring = anchoring or Anchoring()
        self._pictures = PictureSchedule()

    def make_ready(self) -> None:
        """Build the search structures before the first scan: 1 s for 12 000 m2."""
        if self.keyframes.stored:
            self.detached_search.make_ready(np.flatnonzero(self._usable()))

    def work(self, batch: Batch) -> Result:
        result = self._work(batch)
        anchoring, is_asked = self._anchoring, batch.is_last or bool(batch.request)
        result = replace(
            result,
            geo=anchoring.reference,
            fixes=dict(anchoring.counts),
            place=self._place(),
            picture=self._pictures.picture(
                self.keyframes, self._joined, self._loops, self.refusals, is_asked
            ),
        )
        if batch.is_last or batch.request == "checkpoint":
            fixed_count = self._fixed_count if self._is_switched else None
            saved = saved_graph(self.keyframes, self._loops, self._joined, self.refusals, fixed_count)
            result = replace(result, saved=self._keep_graph(saved) if self._keep_graph else saved)
        return result

    def _place(self) -> PlaceUpdate:
        detached = self.detached_search
        possible = detached.possible if self._is_detached() else ()
        return PlaceUpdate(self._placement.state, possible, detached.pose_refused, detached.unconfirmed_place)

    def _work(self, batch: Batch) -> Result:
        for frame in batch.frames:
            self._append(frame)
        removed_count = self._old_passes.removed_count  # indices of fixes do not account for it
        self._anchoring.add([replace(fix, keyframe=fix.keyframe - removed_count) for fix in batch.fixes])
        if batch.request == "set_pose":
            self.detached_search.search_near(np.array(batch.pose))
        if batch.request == "set_mode":
            return self._set_mode(batch.is_localizing)
        joined = self._search_detached() if self._is_detached() else None
        every_m = self._config.keyframe_distance_m if batch.is_last else self._config.search_every_m
        moved = joined is not None or (batch.change is None and self._search_loops(every_m))
        moved |= self._anchoring.is_due and self._find_anchors()
        if batch.request == "undo" and self._accepted:
            gone = self._accepted.pop()
            self._loops = [loop for loop in self._loops if loop not in gone]
            self.refusals.add(gone, BY_HAND)
            moved = True
        has_pairs = len(self.keyframes.by_hand.pair_ends) > 0
        applied, edited = self._edit(batch.change)
        moved |= applied is not None and applied.is_bent
        if batch.request == "optimize" and (self._loops or self._anchoring.reference or has_pairs):
            moved = True
        if batch.is_last:
            return self._finish()
        if self._fixed_count:
            self._forget_session()
        elif not self._is_detached():  # a detached segment adds nothing to the map
            self._old_passes.forget(self._loops)
            taken_back = [(loop.of, loop.to) for loop in self.refusals.by_hand(self._loops)]
            needed = self._anchoring.keyframes, self.keyframes.by_hand.pair_ends, taken_back
            if not self._is_merging and (new := self._old_passes.renumbering(needed)) is not None:
                self._renumber(new)
        if not moved:
            rendered = None if applied is None else self.render(applied.about)
            return Result(*self._counts, rendered_map=rendered, edited=edited)
        before = self.keyframes.map.copy()
        disabled = len(self._disabled)
        self.solve()
        if applied is not None:
            edited = self._edits.answer(applied, self._known(), before, len(self._disabled) - disabled)
        graph = self._to_solve(is_in_hindsight=True)
        known = known_pose(self.keyframes, self._joined, graph, self._fixed_count)
        if joined is not None or batch.request:
            self._due.require_rendering()
        rendered = self.render() if self._due.take_rendering() else None
        newest = self.keyframes.newest_by_segment()
        return Result(*self._counts, joined, newest, known, rendered, edited=edited)

    def _set_mode(self, is_localizing: bool) -> Result:
        """Fix the poses of all placed key frames, or release them."""
        known, counts = self._known(), self._counts
        fixed_count = int(known.sum())
        if is_localizing and not self._fixed_count and (not fixed_count or not known[:fixed_count].all()):
            error = (
                "a part of the map is not joined to the rest yet" if fixed_count else "there is no map yet"
            )
            return Result(*counts, edited=EditAnswer(error=error))
        self._fixed_count = (self._fixed_count or fixed_count) if is_localizing else 0
        self._candidates, self._is_switched = [], is_localizing
        self._accepted = [] if is_localizing else self._accepted  # an undo would change the stored map
        reply = {"mode": "localization" if is_localizing else "mapping", "keyframes": self.keyframes.count}
        count = self.keyframes.count + self._old_passes.removed_count
        return Result(*counts, edited=EditAnswer(reply), is_localizing=is_localizing, keyframes=count)

    def _edit(self, change: LiveChange | None) -> tuple[AppliedEdit | None, EditAnswer | None]:
        """Apply a manual change and answer it; None: there is none, or it was refused."""
        if change is None:
            return None, None
        try:
            if self._fixed_count:
                raise EditError(ONLY_LOCALISED)
            applied, self._loops = self._edits.make(change, self._known(), self._loops)
        except EditError as error:
            return None, EditAnswer(error=str(error))
        self._candidates = []
        self._submaps.clear()
        self.detached_search.forget_map()
        return applied, self._edits.answer(applied, self._known(), self.keyframes.map)

    @property
    def _counts(self) -> tuple[int, int]:
        """Number of loops accepted and disabled, including those of removed key frames."""
        return len(self._loops) + self._gone[0], len(self._disabled) + self._gone[1]

    @property
    def loops(self) -> Sequence[Loop]:
        """The accepted loops."""
        return self._loops

    def begin_session_at(self, k: int, is_across: bool = False) -> None:
        """Treat key frames from k on as this session's; is_across: search loops to those before k only."""
        self.keyframes.stored, self._is_merging, self._is_across = k, True, is_across

    def _is_detached(self) -> bool:
        """Whether the newest key frame is in a detached segment."""
        return bool(self.keyframes.count) and int(self.keyframes.segment[-1]) not in self._joined

    def _find_anchors(self) -> bool:
        """Whether fixes make a solution worth while."""
        is_known = ~self.keyframes.is_lost & self._known()
        return self._anchoring.find(self.keyframes, self._steps().covariance, is_known)

    def _known(self) -> npt.NDArray[np.bool_]:
        """(N,) key frames with a known place in the map."""
        return np.isin(self.keyframes.segment, list(self._joined))

    def _usable(self) -> npt.NDArray[np.bool_]:
        """(N,) key frames to align with: matched, with points, and with a known place."""
        return self.keyframes.is_usable & self._known()

    def _search_detached(self) -> int | None:
        """Search the newest segment; returns its number if its place was found, else None."""
        if (loops := self.detached_search.find(np.flatnonzero(self._usable()))) is None:
            return None
        segment = int(self.keyframes.segment[-1])
        self._joined.add(segment)
        self._placement.found(float(self.keyframes.path_length_m[-1]))
        self._loops += loops
        self._accepted.append([*loops])
        return segment

    def _append(self, frame: KeyFrame) -> None:
        keyframes = self.keyframes
        keyframes.append(frame, keyframes.place_of(frame), thinned(frame, self._config.thin_m))
        if self._is_detached():
            keyframes.forget_stationary(MAX_STATIONARY, self._config)

    def _search_loops(self, every_m: float) -> bool:
        """Search loops if due; whether an accepted one makes a solution worth while."""
        keyframes = self.keyframes
        if not keyframes.count or keyframes.path_length_m[-1] - self._searched_m < every_m:
            return False
        self._searched_m = float(keyframes.path_length_m[-1])
        self._verify_placement()
        for found in self._search(keyframes.count - 1):
            self._candidates.append(found)
            self.refusals.add([found], NOT_SUPPORTED)
            self._accept(found)
        oldest_m = self._searched_m - 2.0 * WITHIN_M
        self._candidates = [loop for loop in self._candidates if keyframes.path_length_m[loop.to] >= oldest_m]
        return self._due.is_due(keyframes, self._loops)

    def _verify_placement(self) -> None:
        """Check the place of the session in the stored map; revoke it if the map contradicts it."""
        keyframes, last = self.keyframes, self.keyframes.count - 1
        if self._placement.state != "unproven":
            return
        stored = np.flatnonzero(self._usable()[: keyframes.stored])
        away_m = np.hypot(*(keyframes.map[stored, :2] - keyframes.map[last, :2]).T)
        if not len(stored) or away_m.min() > VERIFY_WITHIN_M:
            return
        submap = self._submaps.about(int(stored[np.argmin(away_m)]))
        cloud = cloud_of(keyframes, [last], last)
        expected = se2.between(keyframes.map[submap.reference], keyframes.map[last])
        fit = submap.align(cloud, expected)
        is_near = math.dist(fit.pose[:2], expected[:2]) < LOOP_WINDOW_M
        agrees = self._is_good(fit) and is_near and submap.against(cloud, fit.pose) < MAX_AGAINST
        if self._placement.seen(float(keyframes.path_length_m[last]), agrees):
            self._revoke_placement(int(keyframes.segment[last]))

    def _revoke_placement(self, segment: int) -> None:
        """Detach a segment again, whose place was wrong."""
        self._due.require_rendering()
        self._joined.discard(segment)
        of_segment = self.keyframes.segment == segment
        self._loops = [loop for loop in self._loops if not (of_segment[loop.of] or of_segment[loop.to])]
        self._candidates, self._accepted = [], []

    def _search(self, last: int, window: tuple[float, float] | None = None) -> list[Loop]:
        """Loops from the query that ends at key frame `last`. window: m, rad; None: by path length."""
        config, keyframes = self._config, self.keyframes
        path_length_m = keyframes.path_length_m
        first = int(np.searchsorted(path_length_m, path_length_m[last] - config.place_m))
        usable = self._usable()
        members = [k for k in range(first, last + 1) if usable[k]]
        if len(members) < 3:
            return []
        reference = members[len(members) // 2]
        length_m = lengths_from(self.keyframes, self._loops, reference)
        if window is None:
            reach_m = np.minimum(LOOP_WINDOW_M + DRIFTS[0] * config.drift * length_m, MAX_WINDOW_M)
            reach_rad = np.minimum(WINDOW_RAD + DRIFTS[1] * config.drift_radpm * length_m, MAX_WINDOW_RAD)
        else:
            reach_m, reach_rad = np.full(keyframes.count, window[0]), np.full(keyframes.count, window[1])
        away_m = np.hypot(*(keyframes.map[:, :2] - keyframes.map[reference, :2]).T)
        apart = np.abs(path_length_m - path_length_m[reference]) >= config.apart_m + config.place_m
        if window is None:
            apart &= path_length_m < path_length_m[reference]
        near = np.flatnonzero(apart & usable & (away_m <= reach_m + 1.0))
        if self._fixed_count or self._is_across:
            near = near[near < (self._fixed_count or keyframes.stored)]
        cloud: PointCloud | None = None
        found = []
        for k in passes_to_search(path_length_m, near, away_m, reach_m, config.place_m):
            submap = self._submaps.about(k)
            if cloud is None:
                cloud = cloud_of(keyframes, members, reference)
            guess = se2.between(keyframes.map[submap.reference], keyframes.map[reference])
            reach = float(reach_m[k]), float(reach_rad[k])
            pose = submap.search(cloud, guess, *reach, MIN_LOOP_SCORE)
            if pose is None:
                continue
            fit = submap.align_about(cloud, pose, guess, *reach)
            is_good = self._is_good(fit)
            against = submap.against(cloud, fit.pose) if is_good else math.nan
            loop = loop_of(
                submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
            )
            if not against < MAX_AGAINST:
                self.refusals.add([loop], IN_FREE_SPACE if is_good else TOO_FEW_POINTS)
            elif not (self._is_across or self._drift.allows(loop)):
                self.refusals.add([loop], TOO_FAR)
            else:
                found.append(loop)
        return found

    def _is_good(self, fit: Fit) -> bool:
        return fit.share >= MIN_SHARE_ON_MAP * float(np.median(self.keyframes.score))

    def _accept(self, found: Loop) -> None:
        """Accept all candidates consistent with this loop, if they span a path or odometry confirms it."""
        config, path_length_m = self._config, self.keyframes.path_length_m
        base, growth = (AGREE_M, AGREE_RAD), (config.drift, config.drift_radpm)

        def is_consistent(loop: Loop) -> bool:
            is_near = abs(path_length_m[loop.to] - path_length_m[found.to]) <= WITHIN_M
            is_near &= abs(path_length_m[loop.of] - path_length_m[found.of]) <= 2.0 * WITHIN_M
            return is_near and agree(self.keyframes, found, loop, base, growth)

        if any(map(is_consistent, self.refusals.by_hand(self._loops))):
            self.refusals.add([found], BY_HAND)
            return
        group = [loop for loop in self._candidates if is_consistent(loop)]
        is_one_spot = np.ptp([path_length_m[loop.to] for loop in group]) < config.consensus_span_m
        if is_one_spot and not self._drift.confirms(found):
            return
        new = [loop for loop in group if loop not in self._loops and loop not in self._disabled]
        if new:
            self._loops += new
            self._accepted.append(new)

    def graph(self, is_in_hindsight: bool = False) -> PoseGraph:
        """Pose graph: key frames, then the ENU frame if fixes anchor the map."""
        edges = self._steps(is_in_hindsight).followed_by(as_edges(self._loops))
        pairs = landmarks_of_pairs(self.keyframes)
        if self._anchoring.reference is None:
            return PoseGraph(self.keyframes.map.copy(), edges, *pairs)
        poses = np.vstack((self.keyframes.map, self._anchoring.pose_map_enu))
        return PoseGraph(poses, edges.followed_by(self._anchoring.edges(self.keyframes)), *pairs)

    def _to_solve(self, is_in_hindsight: bool = False) -> PoseGraph:
        """The graph, or its part that is not fixed, after one pose for the fixed part."""
        if not self._fixed_count:
            return self.graph(is_in_hindsight)
        return graph_on_fixed(self.keyframes, self._steps(is_in_hindsight), self._loops, self._fixed_count)

    def _steps(self, is_in_hindsight: bool = False) -> Edges:
        edges_of = edges_in_hindsight if is_in_hindsight else odometry_edges
        return edges_of(self.keyframes, self._config.keyframe_distance_m)

    def solve(self) -> None:
        """Optimise the poses; disables loops beyond the chi-square gate."""
        if self.keyframes.count < 2:
            return
        before = self.keyframes.map.copy()
        for _ in range(3):
            poses = solve(self._to_solve()).poses
            moving = self.keyframes.map[self._fixed_count :]
            moving[:] = poses[self._fixed_count > 0 :][: len(moving)]
            if self._anchoring.reference is not None and not self._fixed_count:
                self._anchoring.solved(poses[-1])
            if not self._disable_refuted():
                break
        self._due.solved(float(self.keyframes.path_length_m[-1]), before, self.keyframes.map)

    def _disable_refuted(self) -> bool:
        """Disable loops beyond the gate; whether there was one."""
        is_refuted = edge_chi2(as_edges(self._loops), self.keyframes.map) > CONTRADICTION_CHI2
        go = [self._loops[k] for k in np.flatnonzero(is_refuted)]
        self._loops = [loop for loop in self._loops if loop not in go]
        self._disabled += go
        self.refusals.add(go, CONTRADICTED)
        return bool(go)

    def _finish(self) -> Result:
        keyframes = self.keyframes
        if keyframes.count == keyframes.stored:
            return Result(*self._counts)
        if self._anchoring.has_changes:
            self._find_anchors()
        if (self._loops or self._anchoring.reference) and not self._is_merging:
            self.solve()
        if not self._fixed_count:
            self.search_again()
        if self._loops:
            self.solve()
        return Result(
            *self._counts,
            newest=keyframes.newest_by_segment(),
            rendered_map=self.render(),
            all=self._old_passes.corrections(),
            g2o=to_g2o(self.graph()),
            keyframes=keyframes.count,
        )

    def search_again(self) -> None:
        """Search loops at the end of a drive, at passes that are close by only after the optimisation."""
        path_length_m = self.keyframes.path_length_m

        def spots(loop: Loop) -> tuple[int, int]:
            return round(path_length_m[loop.to] / 3.0), round(path_length_m[loop.of] / 3.0)

        done = set(map(spots, self._loops))
        self._candidates = list(self._loops)
        new = []
        for last in stretches_to_search(self.keyframes, self._loops, self._config):
            for loop in self._search(last, FINISH_WINDOW):
                if spots(loop) not in done and loop.of < loop.to:
                    done.add(spots(loop))
                    new.append(loop)
        self._candidates += new
        self.refusals.add(new, NOT_SUPPORTED)
        for loop in new:
            if loop not in self._loops:
                self._accept(loop)
        self._submaps.clear()  # 100 MB, which a cycle would keep

    def render(self, corners_map: Floats | None = None) -> RenderedMap | None:
        """The shown map, or its part within a polygon (C, 2) m; None without a renderer."""
        keyframes, renderer, known = self.keyframes, self._renderer, self._known()
        if renderer is None or self._fixed_count:
            return None
        if corners_map is None:
            return renderer.render(to_render(keyframes, known))
        near = keyframes_near(keyframes, corners_map, known)
        return renderer.render_part(to_render(keyframes, near), corners_map)

    def _forget_session(self) -> None:
        """Bound a localisation's memory: drop old key frames, or their points while detached."""
        keyframes, fixed_count = self.keyframes, self._fixed_count
        if self._is_detached():
            keyframes.forget_all(fixed_count, keyframes.count - MAX_SESSION)
            return
        if keyframes.count - fixed_count < MAX_SESSION:
            return
        last = (fixed_count + keyframes.count) // 2
        is_kept = np.ones(keyframes.count, np.bool_)
        is_kept[fixed_count:last] = False
        self._renumber(Renumbering(is_kept))
        self._loops.append(anchor_loop(keyframes, fixed_count))

    def _renumber(self, new: Renumbering) -> None:
        """Keep only some of the key frames."""
        keyframes, (loops, disabled) = self.keyframes, self._counts
        self._edits.renumber(new)
        keyframes.keep(new.is_kept)
        self._loops, self._disabled = new.loops(self._loops), new.loops(self._disabled)
        self._gone = loops - len(self._loops), disabled - len(self._disabled)
        self._candidates = new.loops(self._candidates)
        self._accepted = [kept for group in self._accepted if (kept := new.loops(group))]
        self.refusals.renumber(new.loops)
        self._anchoring.renumber(new.number)
        self._submaps.keep_before(int(np.argmin(new.is_kept)))
        self._drift = PathDrift(keyframes, self._config.keyframe_distance_m)
        self.detached_search.forget_numbers()
