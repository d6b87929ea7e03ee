"""Error without single rules of loop closing: each drive is mapped once, its graph once without each rule."""

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from service.geometry.se2 import SE2
from service.mapper.components import Correction
from service.mapper.corrections import corrected
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import KeyFrame, LoopsConfig
from service.mapper.graph.model.loops import agree
from service.mapper.graph.model.point_clouds import SurfelSet, cloud_with_noise
from service.offline.replay.replay import ReplayOptions, replay
from service.offline.score.trajectory import write_tum
from service.outputs import MapperOutput
from simulators.truth import LMS100
from simulators.worlds import WORLDS
from tests.accuracy import terrain
from tests.accuracy.driving import Trip, ate_m
from tests.accuracy.given import error_mm, recording_of
from tests.accuracy.sensors import GOOD_WHEELS, LUX_AHEAD
from tests.papers.report import Section
from tests.shared_data import SHARED
from tests.simulated import Drive, Imu, Run

GRAPH = "service.mapper.graph"


@dataclass(frozen=True)
class Rule:
    """Is in force unless `off` or `settings` switch it off."""

    what: str
    module: str = ""  # whose values are replaced by `off`
    off: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, float] = field(default_factory=dict)  # of LoopsConfig
    frame: Callable[[KeyFrame], KeyFrame] = lambda frame: frame

    def poses(self, outputs: Sequence[MapperOutput], received: "GraphInput") -> list[SE2]:
        """Of all scans after the finish, by a graph without the rule."""
        without = patch.multiple(self.module, **self.off) if self.off else nullcontext()
        graph = LoopBackEnd(received.config.model_copy(update=self.settings), None)
        corrections: Sequence[Correction] = []
        with without:
            for batch in received.batches:
                result = graph.work(replace(batch, frames=[*map(self.frame, batch.frames)]))
                corrections = result.all or corrections
        return corrected(outputs, corrections)


@dataclass
class GraphInput:
    """The input of the graph of one drive."""

    config: LoopsConfig
    batches: list[Batch] = field(default_factory=list)


@contextmanager
def listening() -> Iterator[list[GraphInput]]:
    """All graphs made meanwhile; that of the drive is the one with most input."""
    received: dict[int, GraphInput] = {}
    found: list[GraphInput] = []
    init, work = LoopBackEnd.__init__, LoopBackEnd.work

    def begun(graph: LoopBackEnd, config: LoopsConfig, *arguments: Any, **named: Any) -> None:
        received[id(graph)] = GraphInput(config)
        found.append(received[id(graph)])
        init(graph, config, *arguments, **named)

    def worked(graph: LoopBackEnd, batch: Batch) -> Any:
        received[id(graph)].batches.append(batch)
        return work(graph, batch)

    with patch.multiple(LoopBackEnd, __init__=begun, work=worked):
        yield found


def of_drive(found: Sequence[GraphInput]) -> GraphInput:
    return max(found, key=lambda received: sum(len(batch.frames) for batch in received.batches))


def unmatched_unknown(frame: KeyFrame) -> KeyFrame:
    return replace(frame, motion_covariance=None) if frame.is_lost else frame


RULES = (
    Rule("nothing"),
    Rule("several loops, over 5 m of path", settings={"consensus_span_m": 1e-9}),
    Rule("one loop where the path leads to it", f"{GRAPH}.model.path_drift", {"CHI2_99_OF_3": -1.0}),
    Rule("limit of drift", f"{GRAPH}.model.path_drift", {"MAX_DRIFT_CHI2": math.inf}),
    Rule("unmatched steps as the motion model says", frame=unmatched_unknown),
    Rule(
        "errors that points of one cell share",
        "service.mapper.graph.model.point_clouds.SurfelSet",
        {"align_with_shared_errors": SurfelSet.align},
    ),
    Rule("less what chance gives ([22])", f"{GRAPH}.model.candidate_submap", {"CHANCE_CHI2": 0.0}),
    Rule(
        "open directions as expected",
        f"{GRAPH}.model.candidate_submap.CandidateSubmap",
        {"align_about": lambda submap, cloud, pose, *_: submap.align(cloud, pose)},
    ),
    Rule(
        "noise of the laser itself",
        f"{GRAPH}.model.candidate_submap",
        {"cloud_with_noise": lambda xy, normals, _: cloud_with_noise(xy, normals, LMS100.sigma_m)},
    ),
    Rule("unknown ground neutral", f"{GRAPH}.model.candidate_submap", {"LOOP_UNKNOWN_LIKELIHOOD": 0.0}),
    Rule("points in free space count", f"{GRAPH}.loops.loop_search", {"MIN_AGREEMENT_FAR": -2.0}),
    Rule("least inlier ratio", f"{GRAPH}.loops.loop_search", {"MIN_SHARE_ON_MAP": 0.0}),
    Rule("contradicted loops disabled", f"{GRAPH}.loops.loop_set", {"JUMP_CHI2": math.inf}),
    Rule(
        "tolerance that grows with the path",
        f"{GRAPH}.loops.loop_set",
        {"agree": lambda keyframes, a, b, base, _: agree(keyframes, a, b, base, (0.0, 0.0))},
    ),
    Rule("more passes than the nearest", f"{GRAPH}.loops.loop_search", {"PASSES": 1}),
    Rule("wide search at the finish", f"{GRAPH}.loops.loop_back_end", {"EXPECTED_WINDOW": (0.01, 0.01)}),
)
WORLD_NAMES = ("corridor100d_s1", "ring_s3", "ring_bias_s1", "office300_s1", "office2000_kidnap_s1")
REAL = ("fr079", "intel", "csail", "aces", "fhw")


def lux_corridor(seed: int) -> tuple[Drive, Run]:
    trip = Trip(WORLDS["corridor100"], LUX_AHEAD, wheels=GOOD_WHEELS, imu=Imu())
    return next(trip.runs([seed]))


def in_place(name: str) -> Callable[[int], tuple[Drive, Run]]:
    places = (*terrain.COARSE_PLACES, *terrain.OTHER_PLACES)
    (place,) = (place for place in places if place.name == name)
    return lambda seed: terrain.driven(place, seed)


DRIVES: dict[str, Callable[[int], tuple[Drive, Run]]] = {
    "corridor100, LUX": lux_corridor,
    "shelves": in_place("shelves"),
    "vines": in_place("vines"),
}


def loop_rules(seeds: Sequence[int]) -> Section:
    columns: dict[str, list[str]] = {name: cells_of_drive(drive, seeds) for name, drive in DRIVES.items()}
    if (SHARED / "worlds").exists():
        columns |= {f"`{name}`": cells_of_recording(name) for name in WORLD_NAMES + REAL}
    lines = ["| switched off | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for k, rule in enumerate(RULES):
        lines.append(f"| {rule.what} | " + " | ".join(cells[k] for cells in columns.values()) + " |")
    return Section(
        "Error without single rules of the graph",
        "Each drive is mapped once, and the input of its graph is given to one without the rule. Error after "
        "the finish in mm, median (worst) of the seeds; given recordings have one run each: RMS against the "
        "truth, or the mean of the relations for real ones.",
        tables=["\n".join(lines)],
    )


def cells_of_drive(drive: Callable[[int], tuple[Drive, Run]], seeds: Sequence[int]) -> list[str]:
    errors_mm: list[list[float]] = [[] for _ in RULES]
    for seed in seeds:
        with listening() as found:
            made, done = drive(seed)
            done.mapper.finish()
        for rule, errors in zip(RULES, errors_mm, strict=True):
            errors.append(1e3 * ate_m(made, done, rule.poses(done.outputs, of_drive(found))))
    return [f"{sorted(errors)[len(errors) // 2]:.1f} ({max(errors):.1f})" for errors in errors_mm]


def cells_of_recording(name: str) -> list[str]:
    with listening() as found:
        done = replay([recording_of(name)], ReplayOptions())
    stamps = [output.stamp_ns for output in done.outputs]
    cells = []
    with tempfile.TemporaryDirectory() as out:
        path = Path(out) / "trajectory.tum"
        for rule in RULES:
            write_tum(path, list(zip(stamps, rule.poses(done.outputs, of_drive(found)), strict=True)))
            cells.append(f"{error_mm(name, path):.1f}")
    return cells
