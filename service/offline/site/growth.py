"""A site grows: sessions are found in it, tied to what it has by loops, and all is solved as one graph."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.errors import CorridorError
from service.geometry import poses as se2
from service.geometry.geo_reference import GeoReference
from service.geometry.poses import Floats
from service.mapper.components import MapRenderer, RenderedMap
from service.mapper.graph.edit.editing import only, optimised
from service.mapper.graph.edit.merging import MIN_MERGE_LOOPS, together
from service.mapper.graph.loops.stored_graph import to_render
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, loop_arrays
from service.mapper.saved_graph import SavedGraph
from service.offline.cluster.engines import Engine
from service.offline.cluster.tasks import AnyTask, program_digest
from service.offline.site.anchors import StoredAnchors
from service.offline.site.changes import (
    MIN_LOG_ODDS,
    PLACE_M,
    Comparison,
    Layers,
    in_words,
    log_odds_elsewhere,
    seen_by,
)
from service.offline.site.kept import Seen
from service.offline.site.sessions import Session
from service.offline.site.tasks import Find, FindLoops, keep_graph

VIEWS = 6  # directions; of each spot and direction one key frame is used
SHOWN_SPOT_M, SEARCHED_SPOT_M = 0.5, 1.0  # in the shown map, and where a session is searched
# Up to FEW sessions are searched at once; of more as many as the site has, and FIRST_SEARCHED at least.
FEW, FIRST_SEARCHED = 16, 4
MAX_PARTNERS, TIMES_COVERED = 4, 1  # sessions that one is tied to, at most; of each of its places
# By fixes alone a session is known well enough to look for loops: EXPECTED_WINDOW of the search at 3 sigma.
MAX_GEO_SIGMA_M, MAX_GEO_SIGMA_RAD = 0.5, 0.06
Pair = tuple[int, int]  # numbers of sessions: members, and behind them those that are new
Progress = Callable[[float, str, str], None]  # share; the phase; as text


@dataclass(frozen=True, slots=True)
class Member:
    """A session of the site: its key frames stand behind those of the members before.

    stamps_ns   of its first and last key frame
    """

    name: str
    digest: str
    keyframes: int
    stamps_ns: tuple[int, int]
    geo: GeoReference | None = None


@dataclass(slots=True, eq=False)
class Site:
    """State of a site.

    elsewhere   of those left out, whom the newest state contradicts as another place would: in which words
    """

    members: list[Member]
    graph: SavedGraph
    cell_m: float
    geo: GeoReference | None = None
    contradicted: int = 0  # loops that the rest contradicts
    left_out: dict[str, str] = field(default_factory=dict)  # name -> why
    elsewhere: dict[str, str] = field(default_factory=dict)
    kept: dict[str, Seen] = field(default_factory=dict)  # by name of the member
    _layers: tuple[Layers, dict[int, Comparison]] | None = None  # of this solution

    @property
    def begins(self) -> list[int]:
        """Number of the first key frame of each member; at the end that of all."""
        return [0, *accumulate(one.keyframes for one in self.members)]

    def graph_of(self, k: int) -> SavedGraph:
        """The key frames of a member, in the map of the site."""
        number = np.arange(len(self.graph))
        return only(self.graph, (number >= self.begins[k]) & (number < self.begins[k + 1]))

    def seen(self, k: int) -> RenderedMap:
        """Map of a member by itself."""
        name, poses = self.members[k].name, self.graph.map[self.begins[k] : self.begins[k + 1]]
        if name not in self.kept or not self.kept[name].is_of(poses):
            self.kept[name] = Seen(seen_by(self.graph_of(k), self.cell_m), poses)
        return self.kept[name].rendered

    def in_time(self) -> list[int]:
        """The members by their dates."""
        return sorted(range(len(self.members)), key=lambda k: self.members[k].stamps_ns)

    def layers(self) -> tuple[Layers, dict[int, Comparison]]:
        """Changes from member to member; and each member compared with those before it in time."""
        if self._layers is None:
            self.compare(self.in_time(), lambda k, compared: True)
            assert self._layers is not None
        return self._layers

    def compare(self, order: Sequence[int], is_of_site: Callable[[int, Comparison], bool]) -> None:
        """Members, each against those before it in an order; and whether each is of the site."""
        layers, compared, of_site = Layers(self.cell_m), dict[int, Comparison](), []
        for k in order:
            compared[k] = layers.compare(self.seen(k))
            if is_of_site(k, compared[k]):
                layers.add(k, self.seen(k), compared[k])
                of_site.append(k)
        if of_site == self.in_time():
            self._layers = layers, compared

    def anchors(self) -> StoredAnchors:
        of = {
            begin: one.geo
            for begin, one in zip(self.begins, self.members, strict=False)
            if one.geo is not None
        }
        return StoredAnchors(of, self.graph.map)

    def members_of_loops(self) -> npt.NDArray[np.int64]:
        """(L, 2) numbers of the members that each loop joins."""
        return np.asarray(np.searchsorted(self.begins, self.graph.loop_ends, side="right") - 1)

    def solve(self) -> None:
        anchors, loops = self.anchors(), len(self.graph.loop_ends)
        self.graph, self.geo = optimised(self.graph, anchors), anchors.reference
        self.contradicted += loops - len(self.graph.loop_ends)
        self._layers = None

    def rendered(self, renderer: MapRenderer) -> RenderedMap:
        """The shown map, of the newest key frames of each spot and direction."""
        return renderer.render(to_render(KeyframeList(self.graph), seen_enough(self.graph, 0, SHOWN_SPOT_M)))


def member_of(session: Session) -> Member:
    stamps = session.graph.stamp_ns
    return Member(session.name, session.digest, len(stamps), (int(stamps[0]), int(stamps[-1])), session.geo)


def grow(
    site: Site,
    sessions: Sequence[Session],
    engine: Engine,
    folder: Path,
    progress: Progress,
    known: Mapping[str, int] | None = None,
    joined: Collection[str] = (),
) -> None:
    """Add the sessions that fit, in rounds, for one may fit to another one only; `left_out` names the others.
    In a small part of the site most of many sessions would be searched without a result, which takes ten
    times as long as a search with one: of more than FEW a round searches as many as the site has.

    folder   for what tasks read; it is there, and on a cluster on a shared disk
    known    members that sessions were searched in before, by name: the first so many
    joined   names of those that are of this place, whatever the others give
    """
    waiting, looked = list(sessions), dict(known or {})
    refused: dict[str, int] = {}  # by name: members that it was searched in
    while True:
        members = len(site.members)
        left = [one for one in waiting if one.name not in refused and looked.get(one.name, 0) < members]
        if len(left) > FEW:
            left = left[: max(FIRST_SEARCHED, members)]
        if not left:  # what refused them may be that a small part of the site has a place like theirs
            left = [one for one in waiting if refused.get(one.name, members) < members]
            looked |= dict.fromkeys((one.name for one in left), 0)
        if not left:
            break
        for one in left:
            site.elsewhere.pop(one.name, None)
        with TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as kept:
            round_ = _Round(site, left, engine, Path(kept), progress, joined)
            added = round_.add(round_.find(looked))
        looked |= dict.fromkeys((one.name for one in left), members)
        refused |= {one.name: members for one in left if one.name in {*refused, *site.elsewhere}}
        waiting = [one for one in waiting if one.name not in added]
    names = {one.name for one in site.members}
    site.left_out = {one.name: site.left_out[one.name] for one in sessions if one.name not in names}


@dataclass(slots=True, eq=False)
class _Round:
    """One round: sessions are searched in the members that are new to them, and tied to all."""

    site: Site
    waiting: Sequence[Session]
    engine: Engine
    folder: Path
    progress: Progress
    joined: Collection[str]

    def find(self, known: Mapping[str, int]) -> dict[str, Floats]:
        """Poses of sessions in the site, (3,) each, by name; searched where they were not yet."""
        site, found = self.site, dict[str, Floats]()
        firsts: dict[int, Path] = {}
        requested, tasks = [], []
        for k, session in enumerate(self.waiting):
            if (pose := self._by_fixes(session)) is not None:
                found[session.name] = pose
                continue
            members = known.get(session.name, 0)
            if members not in firsts:
                seen = seen_enough(site.graph, site.begins[members], SEARCHED_SPOT_M)
                firsts[members] = keep_graph(only(site.graph, seen), self.folder / f"from_{members}")
            own = keep_graph(session.graph, self.folder / f"own_{k}")
            requested.append(session)
            tasks.append(Find(session.name, (firsts[members],), own, program_digest()))
        for one, outcome in zip(requested, self._run(tasks, "looking for sessions"), strict=True):
            if "pose_first_second" in outcome:
                found[one.name] = np.array(outcome["pose_first_second"])
            else:
                site.left_out[one.name] = outcome["why"]
        return found

    def _by_fixes(self, session: Session) -> Floats | None:
        """(3,) of its map frame in the site's, where fixes determine it well enough."""
        geo, anchors = session.geo, self.site.anchors()
        if geo is None or anchors.reference is None:
            return None
        xy = session.graph.map[:, :2] - session.graph.map[0, :2]
        sigma_rad = np.hypot(geo.yaw_sigma_rad, anchors.reference.yaw_sigma_rad)
        sigma_m = np.hypot(geo.position_sigma_m, anchors.reference.position_sigma_m)
        sigma_m += sigma_rad * np.hypot(*xy.T).max()
        if sigma_m > MAX_GEO_SIGMA_M or sigma_rad > MAX_GEO_SIGMA_RAD:
            return None
        first = se2.between(session.graph.map[0], np.zeros(3))
        pose: Floats = se2.compose(anchors.pose_map_of(geo), first)
        return pose

    def add(self, found: Mapping[str, Floats]) -> set[str]:
        """Tie the sessions that were found to the site and to each other, and solve all; who is added."""
        site, count = self.site, len(self.site.members)
        new = {k: one for k, one in enumerate((s for s in self.waiting if s.name in found), count)}
        if not new:
            return set()
        placed = {k: one.placed(found[one.name]) for k, one in new.items()}
        paths = [site.graph.map[a:b, :2] for a, b in pairwise(site.begins)]
        pairs = _pairs([*paths, *(graph.map[:, :2] for graph in placed.values())], count)
        loops = self._loops_of(pairs, placed)
        anchored = [k for k, one in new.items() if one.geo is not None and self._by_fixes(one) is not None]
        kept: dict[int, SavedGraph] = {}
        for k in new:  # that enough loops tie to members, or to others that they tie; or fixes
            tied = sum(len(of) for (a, b), of in loops.items() if b == k and (a < count or a in kept))
            if tied >= MIN_MERGE_LOOPS or k in anchored:
                kept[k] = placed[k]
        joined = self._joined(kept, new, loops, anchored)
        site.members, site.graph, site.geo = joined.members, joined.graph, joined.geo
        site.contradicted, site._layers = joined.contradicted, joined._layers
        for k, one in new.items():
            if k not in kept and one.name not in site.elsewhere:
                x_m, y_m, theta_rad = found[one.name].tolist()
                count = sum(len(of_pair) for pair, of_pair in loops.items() if k in pair)
                site.left_out[one.name] = (
                    f"it looks as if its map lay at ({x_m:.1f}, {y_m:.1f}) m, {np.degrees(theta_rad):.0f} "
                    f"deg, but of {counted(count, 'loop')} found fewer than {MIN_MERGE_LOOPS} hold it there; "
                    "add a drive that connects it to the others"
                )
        return {new[k].name for k in kept}

    def _loops_of(self, pairs: Sequence[Pair], placed: Mapping[int, SavedGraph]) -> dict[Pair, list[Loop]]:
        site = self.site
        folders = {}
        for k in sorted({k for pair in pairs for k in pair}):
            graph = placed[k] if k in placed else site.graph_of(k)
            folders[k] = keep_graph(graph, self.folder / f"graph_{k}")
        others = {to: [of for of, other in pairs if other == to] for _, to in pairs}
        tasks = [
            FindLoops(
                f"session {to} of the site", tuple(folders[k] for k in of), folders[to], program_digest()
            )
            for to, of in others.items()
        ]
        outcomes = self._run(tasks, "looking for loops between sessions")
        return {
            (k, to): loops
            for (to, of), outcome in zip(others.items(), outcomes, strict=True)
            for k, loops in zip(of, outcome["loops"], strict=True)
        }

    def _joined(
        self,
        kept: dict[int, SavedGraph],
        new: Mapping[int, Session],
        loops: Mapping[Pair, Sequence[Loop]],
        anchored: Collection[int],
    ) -> Site:
        """The site with those that are kept, solved. Those of which too few loops are left then are kept no
        more, and it is solved without them.
        """
        site, count = self.site, len(self.site.members)
        site._layers = None  # 100 MB for 12 000 m2, and of the solution before
        while kept:
            members = [*site.members, *(member_of(new[k]) for k in kept)]
            joined = Site(
                members,
                together(site.graph, *kept.values()),
                site.cell_m,
                contradicted=site.contradicted,
                kept=site.kept,
            )
            number = dict(zip([*range(count), *kept], joined.begins, strict=False))
            between = [
                replace(loop, of=number[of] + loop.of, to=number[to] + loop.to)
                for (of, to), found in loops.items()
                if of in number and to in number
                for loop in found
            ]
            added: dict[str, Any] = {
                name: np.concatenate((getattr(joined.graph, name), array))
                for name, array in loop_arrays(between).items()
            }
            joined.graph = replace(joined.graph, **added)
            joined.solve()
            ends = joined.members_of_loops()
            left = np.bincount(ends[ends[:, 0] != ends[:, 1]].ravel(), minlength=len(members))[count:]
            weak = [k for k, loops_left in zip(kept, left, strict=True) if loops_left < MIN_MERGE_LOOPS]
            weak = [k for k in weak if k not in anchored] or self._of_elsewhere(joined, list(kept))
            if not weak:
                return joined
            for k in weak:
                del kept[k]
        return site

    def _of_elsewhere(self, joined: Site, added: Sequence[int]) -> list[int]:
        """Of those added behind the members: whom these, and those added before it in time, contradict as
        another place would. `left_out` gives the reason.
        """
        count, found = len(self.site.members), list[int]()

        def is_of_site(k: int, compared: Comparison) -> bool:
            name, log_odds = joined.members[k].name, log_odds_elsewhere(**compared.counts)
            if k < count or name in self.joined or log_odds < MIN_LOG_ODDS:
                return True
            self.site.elsewhere[name] = in_words(**compared.counts)
            self.site.left_out[name] = (
                f"{self.site.elsewhere[name]}: another floor of the same plan, or much was moved; "
                f"--join {name} adds it"
            )
            found.append(added[k - count])
            return False

        joined.compare(sorted(joined.in_time(), key=lambda k: k >= count), is_of_site)
        return found

    def _run(self, tasks: Sequence[AnyTask], phase: str) -> list[dict[str, Any]]:
        """Outcomes in the order of the tasks. Raises CorridorError."""
        outcomes: dict[int, dict[str, Any]] = {}
        for k, done in self.engine(tasks):
            if isinstance(done.outcome, CorridorError):
                raise done.outcome
            outcomes[k] = done.outcome
            self.progress(len(outcomes) / len(tasks), phase, f", {len(outcomes)} of {len(tasks)}")
        return [outcomes[k] for k in range(len(tasks))]


def seen_enough(graph: SavedGraph, begin: int, spot_m: float) -> npt.NDArray[np.bool_]:
    """(N,) key frames from `begin` on that show what there is: of each spot and direction the newest one, so
    that a site of bounded size is looked through in bounded time.
    """
    usable = begin + np.flatnonzero(((graph.point_count > 0) & ~graph.is_lost)[begin:])[::-1]
    view = np.floor(graph.map[usable, 2] / (2.0 * np.pi) * VIEWS).astype(np.int64) % VIEWS
    spots = np.column_stack((np.floor(graph.map[usable, :2] / spot_m).astype(np.int64), view))
    seen = np.zeros(len(graph), np.bool_)
    seen[usable[np.unique(spots, axis=0, return_index=True)[1]]] = True
    return seen


def _pairs(paths: Sequence[Floats], first_new: int) -> list[Pair]:
    """Sessions (of, to) between which loops are searched: each new one with some before it, with which it
    has most places in common, one of them of the site as it was.

    paths   (N, 2) m in the map, of each session
    """
    places = [set(map(tuple, np.floor(path / PLACE_M).astype(np.int64).tolist())) for path in paths]
    pairs = []
    for to in range(first_new, len(paths)):
        left = Counter(dict.fromkeys(places[to], TIMES_COVERED))
        chosen: list[int] = []
        while len(chosen) < MAX_PARTNERS:
            among = [of for of in range(to if chosen else first_new) if of not in chosen]
            gain = {of: sum(left[place] > 0 for place in places[of] & places[to]) for of in among}
            if not gain or max(gain.values()) == 0:
                break
            chosen.append(max(gain, key=lambda of: gain[of]))
            left.subtract(places[chosen[-1]] & places[to])
        pairs += [(of, to) for of in sorted(chosen)]
    return pairs
