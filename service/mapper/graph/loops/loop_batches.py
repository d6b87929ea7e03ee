"""What goes to the back end of the default profile's graph, and what comes back. All can be pickled."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from service.geometry.geo_reference import GeoReference
from service.mapper.components import Correction, EditAnswer, PlaceNews, RenderedMap
from service.mapper.edit_requests import LiveChange
from service.mapper.graph.gnss.fix_track import PlacedFix
from service.mapper.graph.model.keyframe_list import KeyFrame
from service.mapper.known_pose import KnownPose
from service.mapper.saved_graph import KeptGraph, SavedGraph
from service.outputs import GraphPicture


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Key frames and fixes since the last batch, and what else is wanted."""

    frames: Sequence[KeyFrame]
    request: str = ""  # "optimize", "undo", "checkpoint", "set_pose", "edit_map", "set_mode"
    pose: Sequence[float] = ()  # (x m, y m, theta rad) in the map, of set_pose
    is_last: bool = False
    fixes: Sequence[PlacedFix] = ()  # of key frames in this batch and before
    change: LiveChange | None = None  # of edit_map
    is_localizing: bool = False  # of set_mode


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """newest: as KeyframeList.newest_by_piece, if anything moved; all: every one, after the last batch.

    g2o         after the last batch: the graph as text
    keyframes   after the last batch how many the graph has; after set_mode those taken out count, too
    geo, fixes       where the map lies on the earth, None: that is not known; fixes by what became of them
    """

    loops: int  # that are accepted now
    disabled: int  # that are not any more
    joined: int | None = None  # number of the piece that was found in the rest; None: none
    newest: Mapping[int, Correction] = field(default_factory=dict)
    known: KnownPose | None = None  # the newest whose place in the map is known; None: as before
    rendered_map: RenderedMap | None = None
    all: Sequence[Correction] = ()
    g2o: str = ""
    keyframes: int = 0
    geo: GeoReference | None = None
    fixes: Mapping[str, int] = field(default_factory=dict)
    saved: SavedGraph | KeptGraph | None = None  # where a checkpoint was asked for, and at the end
    place: PlaceNews = field(default_factory=PlaceNews)
    picture: GraphPicture | None = None  # where one was due
    edited: EditAnswer | None = None  # of a batch with a change or another mode
    is_localizing: bool | None = None  # from now on; None: as before
