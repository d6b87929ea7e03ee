"""Batches to the back end of the default profile's graph, and its results. All can be pickled."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from service.geometry.geo_reference import GeoReference
from service.mapper.components import Correction, EditAnswer, PlaceUpdate, RenderedMap
from service.mapper.edit_requests import LiveChange
from service.mapper.graph.gnss.fix_track import PlacedFix
from service.mapper.graph.model.keyframe_list import KeyFrame
from service.mapper.known_pose import KnownPose
from service.mapper.saved_graph import KeptGraph, SavedGraph
from service.outputs import GraphPicture


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
