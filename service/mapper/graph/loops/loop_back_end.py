"""Back end of the default profile: joins segments, closes loops, optimises the graph, bounds its memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.mapper.components import Correction, EditAnswer, MapRenderer, PlaceUpdate, RenderedMap
from service.mapper.edit_requests import ONLY_LOCALISED, EditError, LiveChange
from service.mapper.graph.gnss.anchoring import Anchoring
from service.mapper.graph.gnss.fix_track import PlacedFix
from service.mapper.graph.loops.live_edits import AppliedEdit, LiveEdits, keyframes_near
from service.mapper.graph.loops.loop_search import LoopSearch
from service.mapper.graph.loops.loop_set import LoopSet, SolutionDue
from service.mapper.graph.loops.old_passes import OldPasses, Renumbering
from service.mapper.graph.loops.picture_schedule import PictureSchedule
from service.mapper.graph.loops.stored_graph import (
    Placement,
    anchor_loop,
    graph_on_fixed,
    landmarks_of_pairs,
    saved_graph,
    to_render,
)
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, LoopsConfig, thinned
from service.mapper.graph.model.loops import Loop, as_edges
from service.mapper.graph.model.odometry_edges import edges_in_hindsight, known_pose, odometry_edges
from service.mapper.graph.model.path_drift import PathDrift
from service.mapper.graph.model.pose_graph import Edges, PoseGraph, to_g2o
from service.mapper.graph.model.pose_graph_solver import solve
from service.mapper.graph.relocalise.detached_search import MAX_STATIONARY, DetachedSearch
from service.mapper.graph.relocalise.place_search import EXPECTED_WINDOW
from service.mapper.known_pose import KnownPose
from service.mapper.saved_graph import KeepGraph, KeptGraph, SavedGraph
from service.outputs import GraphPicture

VERIFY_WITHIN_M = 2.0  # distance from a key frame of the stored map at which a new session is verified
MAX_SESSION = 600  # key frames, 180 m of path: then a session that only localises drops half of them


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Key frames and fixes since the last batch, and a request."""

    frames: Sequence[KeyFrame]
    request: str = ""  # "optimize", "undo", "checkpoint", "set_pose", "edit_map", "set_mode"
    pose: Sequence[float] = ()  # (x m, y m, theta rad) in the map, of set_pose
    is_last: bool = False
    fixes: Sequence[PlacedFix] = ()  # of key frames in this batch and before
    change: LiveChange | None = None  # of edit_map
    is_localizing: bool = False  # of set_mode


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """newest: as KeyframeList.newest_by_segment, if anything moved; all: every one, after the last batch.

    g2o         after the last batch: the graph as text
    keyframes   after the last batch and set_mode: number of key frames; after set_mode with the removed ones
    geo, fixes  geographic reference of the map, None if not known; fixes by outcome
    """

    loops: int  # number of accepted ones
    disabled: int  # number of disabled ones
    joined: int | None = None  # number of the segment that was joined to the map; None: none
    newest: Mapping[int, Correction] = field(default_factory=dict)
    known: KnownPose | None = None  # newest key frame with a known place; None: unchanged
    rendered_map: RenderedMap | None = None
    all: Sequence[Correction] = ()
    g2o: str = ""
    keyframes: int = 0
    geo: GeoReference | None = None
    fixes: Mapping[str, int] = field(default_factory=dict)
    saved: SavedGraph | KeptGraph | None = None  # at a checkpoint and at the end
    place: PlaceUpdate = field(default_factory=PlaceUpdate)
    picture: GraphPicture | None = None  # if due
    edited: EditAnswer | None = None  # answer to a change or another mode
    is_localizing: bool | None = None  # from now on; None: unchanged


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
        self._drift = PathDrift(self.keyframes, config.keyframe_distance_m)
        self.loops = LoopSet(config, self.keyframes, self._drift, stored)
        self._search = LoopSearch(config, self.keyframes, self.loops, self._drift, self._usable)
        self._searched_m = float(self.keyframes.path_length_m[-1]) if stored is not None else 0.0
        self._due = SolutionDue(config, self._searched_m)
        self._joined = {0} if stored is None else set(self.keyframes.segment.tolist())  # placed segments
        self.detached_search = DetachedSearch(config, self.keyframes)
        self._is_merging = self._is_across = False  # as of begin_session_at
        self._placement = Placement(stored is not None)
        self._old_passes = OldPasses(config, self.keyframes)
        self._edits = LiveEdits(self.keyframes, self.loops.refusals)
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
                self.keyframes, self._known(), self.loops.accepted, self.loops.refusals, is_asked
            ),
        )
        if batch.is_last or batch.request == "checkpoint":
            saved = self.saved()
            result = replace(result, saved=self._keep_graph(saved) if self._keep_graph else saved)
        return result

    def saved(self) -> SavedGraph:
        """The key frames with a known place in the map, and the loops between them."""
        is_known = self._known()
        if self._is_switched:
            is_known[self._fixed_count :] = False
        return saved_graph(self.keyframes, self.loops.accepted, is_known, self.loops.refusals)

    def _place(self) -> PlaceUpdate:
        detached = self.detached_search
        possible = detached.possible if self._is_detached() else ()
        return PlaceUpdate(
            self._placement.state, possible, detached.operator_pose.refused, detached.unconfirmed_place
        )

    def _work(self, batch: Batch) -> Result:
        for frame in batch.frames:
            self._append(frame)
        removed_count = self._old_passes.removed_count  # indices of fixes do not account for it
        self._anchoring.add([replace(fix, keyframe=fix.keyframe - removed_count) for fix in batch.fixes])
        if batch.request == "set_pose":
            self.detached_search.operator_pose.set(np.array(batch.pose))
        if batch.request == "set_mode":
            return self._set_mode(batch.is_localizing)
        joined = self._search_detached() if self._is_detached() else None
        every_m = self._config.keyframe_distance_m if batch.is_last else self._config.search_every_m
        moved = joined is not None or (batch.change is None and self._search_loops(every_m))
        moved |= self._anchoring.is_due and self._find_anchors()
        if batch.request == "undo":
            moved |= self.loops.undo()
        has_pairs = len(self.keyframes.by_hand.pair_ends) > 0
        applied, edited = self._edit(batch.change)
        moved |= applied is not None and applied.is_bent
        if batch.request == "optimize" and (self.loops.accepted or self._anchoring.reference or has_pairs):
            moved = True
        if batch.is_last:
            return self._finish()
        if self._fixed_count:
            self._forget_session()
        elif not self._is_detached():  # a detached segment adds nothing to the map
            loops = self.loops.accepted
            self._old_passes.forget(loops)
            taken_back = [(loop.of, loop.to) for loop in self.loops.refusals.by_hand(loops)]
            needed = self._anchoring.keyframes, self.keyframes.by_hand.pair_ends, taken_back
            if not self._is_merging and (new := self._old_passes.renumbering(needed)) is not None:
                self._renumber(new)
        if not moved:
            rendered = None if applied is None else self.render(applied.about)
            return Result(*self.loops.counts, rendered_map=rendered, edited=edited)
        before = self.keyframes.map.copy()
        _, disabled = self.loops.counts
        self.solve()
        if applied is not None:
            edited = self._edits.answer(applied, self._known(), before, self.loops.counts[1] - disabled)
        graph = self._to_solve(is_in_hindsight=True)
        known = known_pose(self.keyframes, self._known(), graph, self._fixed_count)
        if joined is not None or batch.request:
            self._due.require_rendering()
        rendered = self.render() if self._due.take_rendering() else None
        newest = self.keyframes.newest_by_segment()
        return Result(*self.loops.counts, joined, newest, known, rendered, edited=edited)

    def _set_mode(self, is_localizing: bool) -> Result:
        """Fix the poses of all placed key frames, or release them."""
        known, counts = self._known(), self.loops.counts
        fixed_count = int(known.sum())
        if is_localizing and not self._fixed_count and (not fixed_count or not known[:fixed_count].all()):
            error = (
                "a part of the map is not joined to the rest yet" if fixed_count else "there is no map yet"
            )
            return Result(*counts, edited=EditAnswer(error=error))
        self._fixed_count = (self._fixed_count or fixed_count) if is_localizing else 0
        self._is_switched = is_localizing
        self.loops.drop_candidates()
        if is_localizing:
            self.loops.drop_undo()  # it would change the stored map
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
            applied, self.loops.accepted = self._edits.make(change, self._known(), self.loops.accepted)
        except EditError as error:
            return None, EditAnswer(error=str(error))
        self.loops.drop_candidates()
        self._search.submaps.clear()
        self.detached_search.forget_map()
        return applied, self._edits.answer(applied, self._known(), self.keyframes.map)

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
        self.loops.accept(loops)
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
        self.loops.add(self._loops_from(keyframes.count - 1), self._searched_m)
        return self._due.is_due(keyframes, self.loops.accepted)

    def _verify_placement(self) -> None:
        """Check the place of the session in the stored map; revoke it if the map contradicts it."""
        keyframes, last = self.keyframes, self.keyframes.count - 1
        if self._placement.state != "unproven":
            return
        stored = np.flatnonzero(self._usable()[: keyframes.stored])
        away_m = np.hypot(*(keyframes.map[stored, :2] - keyframes.map[last, :2]).T)
        if not len(stored) or away_m.min() > VERIFY_WITHIN_M:
            return
        agrees = self._search.agrees(last, int(stored[np.argmin(away_m)]))
        if self._placement.seen(float(keyframes.path_length_m[last]), agrees):
            self._revoke_placement(int(keyframes.segment[last]))

    def _revoke_placement(self, segment: int) -> None:
        """Detach a segment again, whose place was wrong."""
        self._due.require_rendering()
        self._joined.discard(segment)
        self.loops.remove_segment(segment)

    def _loops_from(self, last: int, window: tuple[float, float] | None = None) -> list[Loop]:
        """As LoopSearch.find, at key frames that this session may be compared with."""
        before = self._fixed_count or (self.keyframes.stored if self._is_across else None)
        return self._search.find(last, window, before, self._is_across)

    def graph(self, is_in_hindsight: bool = False) -> PoseGraph:
        """Pose graph: key frames, then the ENU frame if fixes anchor the map."""
        edges = self._steps(is_in_hindsight).followed_by(as_edges(self.loops.accepted))
        pairs = landmarks_of_pairs(self.keyframes)
        if self._anchoring.reference is None:
            return PoseGraph(self.keyframes.map.copy(), edges, *pairs)
        poses = np.vstack((self.keyframes.map, self._anchoring.pose_map_enu))
        return PoseGraph(poses, edges.followed_by(self._anchoring.edges(self.keyframes)), *pairs)

    def _to_solve(self, is_in_hindsight: bool = False) -> PoseGraph:
        """The graph, or its part that is not fixed, after one pose for the fixed part."""
        if not self._fixed_count:
            return self.graph(is_in_hindsight)
        steps, loops = self._steps(is_in_hindsight), self.loops.accepted
        return graph_on_fixed(self.keyframes, steps, loops, self._fixed_count)

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
            if not self.loops.disable_refuted():
                break
        self._due.solved(float(self.keyframes.path_length_m[-1]), before, self.keyframes.map)

    def _finish(self) -> Result:
        keyframes = self.keyframes
        if keyframes.count == keyframes.stored:
            return Result(*self.loops.counts)
        if self._anchoring.has_changes:
            self._find_anchors()
        if (self.loops.accepted or self._anchoring.reference) and not self._is_merging:
            self.solve()
        if not self._fixed_count:
            self.search_again()
        if self.loops.accepted:
            self.solve()
        return Result(
            *self.loops.counts,
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

        done = set(map(spots, self.loops.accepted))
        new = []
        for last in self._search.stretches():
            for loop in self._loops_from(last, EXPECTED_WINDOW):
                if spots(loop) not in done and loop.of < loop.to:
                    done.add(spots(loop))
                    new.append(loop)
        self.loops.add_of_finish(new)
        self._search.submaps.clear()  # 100 MB, which a cycle would keep

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
        self.loops.accepted.append(anchor_loop(keyframes, fixed_count))

    def _renumber(self, new: Renumbering) -> None:
        """Keep only some of the key frames."""
        self._edits.renumber(new)
        self.keyframes.keep(new.is_kept)
        self.loops.renumber(new)
        self._anchoring.renumber(new.number)
        self._search.submaps.keep_before(int(np.argmin(new.is_kept)))
        self._drift.forget()
        self.detached_search.forget_numbers()
