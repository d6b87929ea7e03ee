"""Drives round a ring of corridors, each in a map frame of its own, and a site that is built of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import save_map
from service.offline.cluster.engines import in_turn
from service.offline.replay.setup import ReplayOptions
from service.offline.site.build import site_build
from tests.service.mapper.graph.loops import rings
from tests.service.mapstore.tile_makers import tile

CELL_M = 0.05
HOUR_NS = 3600 * 10**9
FRAMES = {"a": SE2(), "b": SE2(3.0, -2.0, 0.7), "c": SE2(-5.0, 1.0, -2.0), "d": SE2(0.5, 0.5, 3.0)}
FIRST = {"a": 0, "b": 40, "c": 90, "d": 10}  # key frame of the ring that each drive begins with
COUNT = 120  # key frames of each, of 153 in a round


def driven(name: str, seed: int, begin_ns: int | None = None) -> SavedGraph:
    frames, _ = rings.key_frames(1.4, seed, turn_error_radpm=0.0005)
    begin_ns = seed * HOUR_NS if begin_ns is None else begin_ns
    part = [
        replace(one, stamp_ns=begin_ns + one.stamp_ns, pose_odom_base=FRAMES[name] @ one.pose_odom_base)
        for one in frames[FIRST[name] : FIRST[name] + COUNT]
    ]
    back_end = LoopBackEnd(LoopsConfig(), None)
    return back_end.work(Batch(part, is_last=True)).saved


def store(folder: Path, graph: SavedGraph, geo: GeoReference | None = None) -> None:
    tiles = [replace(tile(0, 0, 3), cell_m=CELL_M)]
    save_map(folder, tiles, int(graph.stamp_ns.max()), {"profile": "corridor"}, geo, graph)


def build(
    sessions: Sequence[Path], out: Path, engine: Any = in_turn, joined: Sequence[str] = ()
) -> dict[str, Any]:
    return site_build(sessions, ReplayOptions(), out, engine, lambda *_: None, joined)


def names_in(report: dict[str, Any]) -> list[str]:
    return [one["session"] for one in report["sessions"]]
