"""Relocalisation of a vehicle that is switched on in a stored map: share, correctness, duration."""

import gc
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.frames import Frame, LaserScan
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.background import BackEnd, InlineWorker
from service.mapper.corrections import corrected
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.graph.relocalise.known_map import MIN_MARGIN_NATS
from service.mapper.maps.occupancy import rendered_of
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from service.outputs import FREE, MapperOutput
from service.recording.mcap_source import open_session
from simulators.trajectory import Pause, plan_drive
from simulators.world import World
from simulators.worlds import WORLDS
from tests.accuracy.buildings import FAST_MALL, LMS100_25HZ, MALL_PATH_LENGTH_M, seconds_for
from tests.papers.report import Row, Section
from tests.service.mapper.graph.relocalise.evidence_margin import evidence_margin
from tests.shared_data import SHARED
from tests.simulated import LMS100_50HZ, Laser, Wheels, begun_at, drive, heading_rad, off_walls_m

PLACES = 100  # of each kind, over all seeds; of each recording
CLEARANCE_M = 0.4  # of a place from every wall
ON_PATH_M = 2.0  # from a key frame of the map
STAND_S, MOVE_S = 1.0, 8.0
RIGHT_M, RIGHT_DEG = 0.10, 1.0
BUILDINGS: Mapping[str, tuple[Callable[[], World], Laser, float | None]] = {
    "office": (WORLDS["office"], LMS100_50HZ, None),
    "library": (WORLDS["library"], LMS100_50HZ, None),
    "floor": (WORLDS["floor"], LMS100_50HZ, None),
    "mall": (FAST_MALL, LMS100_25HZ, MALL_PATH_LENGTH_M),
}
HALVES = ("fr079", "intel", "wean1")


@dataclass(frozen=True, eq=False)
class Known:
    """A stored map, and the true poses of its key frames."""

    begin: BeginIn
    mountings: Mapping[str, SE2]
    true: Floats  # (K, 3) m, m, rad of each key frame, in any one frame

    def in_map(self, true: Floats) -> Floats:
        """A true pose (3,) in the map: relative to the nearest key frame."""
        k = int(np.argmin(self.away_m(true)))
        return se2.compose(self.begin.graph.map[k], se2.between(self.true[k], true))

    def away_m(self, true: Floats) -> Floats:
        """(K,) from each key frame."""
        away: Floats = np.hypot(*(self.true[:, :2] - true[:2]).T)
        return away


@dataclass(frozen=True)
class Start:
    """Result of one start."""

    is_right: bool  # at its end
    is_wrong: bool  # `ok` or `degraded` at another place, at its end
    was_wrong_ok: bool  # at any moment
    is_alike: (
        bool  # lost between two places that fit about as well, and one of those reported is the true one
    )
    is_likelier_elsewhere: bool  # lost, and not alike
    found_s: float  # from the first scan on; nan: not
    cpu_s: float  # of the scan that took longest
    off_mm: float  # at its end


@dataclass
class Starts:
    """All starts of one kind."""

    all: list[Start] = field(default_factory=list)

    def rows(self, case: str, how: str, cause: str = "") -> list[Row]:
        count = len(self.all)
        if not count:
            return []
        right = [start for start in self.all if start.is_right]
        lost = [start for start in self.all if not start.is_right and not start.is_wrong]
        alike = sum(start.is_alike for start in lost)
        elsewhere = sum(start.is_likelier_elsewhere for start in lost)
        wrong_ok = sum(start.was_wrong_ok for start in self.all)

        def one(what: str, value: float, unit: str, **bounds: float) -> Row:
            return Row(f"{how}: {what}", [value], unit, case, digits=0, **bounds)  # type: ignore[arg-type]

        return [
            one(f"right, of {count}", 100.0 * len(right) / count, "%"),
            Row(
                f"{how}: right, or lost between two that are alike",
                [100.0 * (len(right) + alike) / count],
                "%",
                case,
                at_least=98.0,
                cause=cause,
            ),
            one("lost", float(len(lost)), "places"),
            one("lost between two that are alike, the true one reported", float(alike), "places"),
            one("lost, and likelier elsewhere", float(elsewhere), "places"),
            one("wrong", float(sum(start.is_wrong for start in self.all)), "places", at_most=0.0),
            one("`ok` and wrong", float(wrong_ok), "places", at_most=0.0),
            Row(f"{how}: off where right", [start.off_mm for start in right] or [math.nan], "mm", case),
            Row(f"{how}: found after", [start.found_s for start in right] or [math.nan], "s", case),
            Row(
                f"{how}: longest search, processor",
                [start.cpu_s for start in self.all],
                "s",
                case,
                at_most=1.0,
                by_worst=True,
            ),
        ]


def relocalisation(seeds: Sequence[int]) -> Section:
    rows = []
    for name in BUILDINGS:
        on_path, off_path, moving = Starts(), Starts(), Starts()
        for seed in seeds:
            for starts, found in zip(
                (on_path, off_path, moving), in_building(name, seed, PLACES // len(seeds)), strict=True
            ):
                starts.all += found
            gc.collect()
        rows += on_path.rows(name, f"standing within {ON_PATH_M:.0f} m of the path")
        rows += off_path.rows(name, "standing farther off", "the map has a part of what is seen from there")
        rows += moving.rows(name, "driving on")
    for name in HALVES:
        if (SHARED / "datasets" / name).exists():
            rows += Starts(in_second_half(name, PLACES)).rows(f"{name}, second half", "driving on")
    return Section(
        "Switched on in a stored map",
        f"The map of one drive of each seed. Places of the known free ground, at least {CLEARANCE_M} m from "
        f"walls, at any heading, standing for {STAND_S:.0f} s: within {ON_PATH_M:.0f} m of where the map was "
        f"driven, and farther off, in rooms that were passed and not entered; and moments of the mapped "
        f"drive, driving on for {MOVE_S:.0f} s with another noise. Of recordings, moments of the second half "
        f"in the map of the first, within {ON_PATH_M:.0f} m of its path; the truth is the full map. "
        f"Right: at the end within {RIGHT_M} m and {RIGHT_DEG:.0f} deg of where the nearest key frame of the "
        "map has the place; wrong: placed, and farther off. What is neither stays lost. Alike: the two "
        f"likeliest places are within {MIN_MARGIN_NATS:.0f} nats, the true one is one of them, and the "
        "reason names both. Likelier elsewhere: another place of the map fits what is seen better than the "
        "true one does. A scan without any return, as where a simulated person walks over the laser, is not "
        "asked.",
        rows,
    )


def in_building(name: str, seed: int, count: int) -> tuple[list[Start], list[Start], list[Start]]:
    """Standing on the path, standing off it, driving on."""
    make, laser, path_length_m = BUILDINGS[name]
    plain = make()
    world = begun_at(plain, heading_rad(seed))
    seconds = world.drive.duration_s
    if path_length_m is not None:
        seconds += seconds_for(plain, path_length_m) - plain.drive.duration_s
    known, first = stored(world, laser, seconds, seed)
    standing: list[list[Start]] = []
    for number, of_kind in enumerate(places(world, known, first, seed, count)):
        standing.append([])
        for k, place in enumerate(of_kind):
            here = replace(world, drive=plan_drive(place, [Pause(STAND_S + 1.0)]))
            made = drive(here, laser, STAND_S, 1000 * seed + 100 * number + k, Wheels(), stand_s=0.0)
            to_first = first.inverse() @ made.world_first
            standing[-1].append(started(known, made.frames, _seen_from(to_first, made.truth)))
    moving = []
    for k, at_s in enumerate(np.linspace(0.0, seconds - MOVE_S, count).tolist()):
        made = drive(world, laser, MOVE_S, 1000 * seed + 500 + k, Wheels(), stand_s=-at_s)
        moving.append(started(known, made.frames, _seen_from(first.inverse() @ made.world_first, made.truth)))
    return standing[0], standing[1], moving


def in_second_half(name: str, count: int) -> list[Start]:
    """Of a recording: moments of its second half in the map of its first."""
    session = open_session([SHARED / "datasets" / name / f"{name}.mcap"])
    frames, mountings = list(session.frames()), session.mountings
    scans = [k for k, frame in enumerate(frames) if isinstance(frame, LaserScan)]
    middle = scans[len(scans) // 2]
    _, whole = _mapped(frames, mountings)
    begin, _ = _mapped(frames[:middle], mountings)
    known = Known(begin, mountings, _true_of(begin, whole))
    starts = [
        k
        for k in scans[len(scans) // 2 :]
        if frames[k].stamp_ns in whole
        and frames[k].stamp_ns + MOVE_S * 1e9 < frames[scans[-1]].stamp_ns
        and known.away_m(whole[frames[k].stamp_ns]).min() < ON_PATH_M
    ]
    chosen = (
        [starts[k] for k in np.unique(np.linspace(0, len(starts) - 1, count).astype(int))] if starts else []
    )
    made = []
    for k in chosen:
        until_ns = frames[k].stamp_ns + round(MOVE_S * 1e9)
        here = [frame for frame in frames[k:] if frame.stamp_ns <= until_ns]
        made.append(started(known, here, whole))
    return made


def stored(world: World, laser: Laser, seconds: float, seed: int) -> tuple[Known, SE2]:
    """The map of one drive; and the first scan's pose in the world, in whose frame the truth is."""
    made = drive(world, laser, seconds, seed, Wheels())
    mountings = {laser.name: laser.mounting}
    begin, _ = _mapped(made.frames, mountings)
    return Known(begin, mountings, _true_of(begin, _seen_from(SE2(), made.truth))), made.world_first


def _true_of(begin: BeginIn, truth: Mapping[int, Floats]) -> Floats:
    """Of its key frames, whose poses are those of the middle of their sweeps: between two scans."""
    stamps = np.array(sorted(truth))
    x_m, y_m, theta_rad = np.array([truth[stamp_ns] for stamp_ns in stamps.tolist()]).T
    at = [np.interp(begin.graph.stamp_ns, stamps, of) for of in (x_m, y_m, np.unwrap(theta_rad))]
    return np.column_stack(at)


def places(world: World, known: Known, first: SE2, seed: int, count: int) -> tuple[list[SE2], list[SE2]]:
    """In the frame of the world: near the path driven, and farther off; fewer where there is no
    ground of this kind.
    """
    shown, random = known.begin.shown, np.random.default_rng(seed)
    tile, row, column = np.nonzero(shown.evidence < FREE)
    width = shown.evidence.shape[1]
    x_m = 0.05 * (shown.tile_column[tile] * width + column + 0.5)
    y_m = 0.05 * (shown.tile_row[tile] * width + row + 0.5)
    near: list[SE2] = []
    far: list[SE2] = []
    for k in random.permutation(len(x_m)).tolist():
        at = SE2(float(x_m[k]), float(y_m[k]), float(random.uniform(-math.pi, math.pi)))
        kind = near if known.away_m(np.array([at.x_m, at.y_m, 0.0])).min() < ON_PATH_M else far
        if len(kind) < count and off_walls_m(np.array([(first @ at)[:2]]), world.segments)[0] >= CLEARANCE_M:
            kind.append(first @ at)
        if len(near) == count and len(far) == count:
            break
    return near, far


def is_reported(detached: DetachedSearch, true: Floats) -> bool:
    """Whether the true place is one of two that are reported, and neither is clearly likelier."""
    is_reported = any(math.hypot(at.x_m - true[0], at.y_m - true[1]) < RIGHT_M for at in detached.possible)
    return is_reported and abs(evidence_margin(detached, true)) < MIN_MARGIN_NATS


def started(known: Known, frames: Sequence[Frame], truth: Mapping[int, Floats]) -> Start:
    """Begin in a map with these frames.

    truth   poses (3,) by the stamp of a scan, in the frame of known.true
    """
    back_ends: list[LoopBackEnd] = []

    def in_place(back_end: BackEnd) -> InlineWorker:
        assert isinstance(back_end, LoopBackEnd)
        back_ends.append(back_end)
        return InlineWorker(back_end)

    config = mapping_config({"mode": "localization"})
    mapper = build_mapper(config, known.mountings, new_worker=in_place, begin_in=known.begin)
    found_s, longest_s, was_wrong_ok, is_placed, is_wrong = math.nan, 0.0, False, False, False
    off_m, true = math.inf, np.zeros(3)
    for frame in frames:
        began_s = time.thread_time()
        output = mapper.process(frame)
        while mapper.graph.waiting:
            mapper.apply_result()
        if not isinstance(frame, LaserScan) or output is None or output.stamp_ns not in truth:
            continue
        if not np.isfinite(frame.range_m).any():  # a person stands at the laser: it has no returns
            continue
        longest_s = max(longest_s, time.thread_time() - began_s)
        true = known.in_map(truth[output.stamp_ns])
        off_m, off_deg = _off(true, output)
        is_placed = output.state != "lost"
        is_wrong = is_placed and (off_m > RIGHT_M or off_deg > RIGHT_DEG)
        was_wrong_ok |= is_wrong and output.state == "ok"
        if is_placed and math.isnan(found_s):
            found_s = 1e-9 * (output.stamp_ns - frames[0].stamp_ns)
    detached = back_ends[0].detached_search
    is_alike = not is_placed and is_reported(detached, true)
    elsewhere = not is_placed and not is_alike and evidence_margin(detached, true) <= 0.0
    mapper.graph.close()
    is_right = is_placed and not is_wrong
    return Start(is_right, is_wrong, was_wrong_ok, is_alike, elsewhere, found_s, longest_s, 1e3 * off_m)


def _off(true: Floats, output: MapperOutput) -> tuple[float, float]:
    pose = output.pose_map_base
    away = se2.between(true, np.array(pose))
    return math.hypot(away[0], away[1]), abs(math.degrees(away[2]))


def _mapped(frames: Sequence[Frame], mountings: Mapping[str, SE2]) -> tuple[BeginIn, Mapping[int, Floats]]:
    """The map of these frames, and the final pose of each scan."""
    mapper = build_mapper(mapping_config(), mountings)
    outputs = [output for frame in frames if (output := mapper.process(frame)) is not None]
    finished = mapper.finish()
    graph = finished.update.saved
    poses = corrected(outputs, finished.corrections)
    at = {output.stamp_ns: np.array(pose) for output, pose in zip(outputs, poses, strict=True)}
    return BeginIn(graph, rendered_of(mapper.changed_tiles())), at


def _seen_from(frame: SE2, truth: Mapping[int, SE2]) -> dict[int, Floats]:
    seen = {stamp_ns: frame @ pose for stamp_ns, pose in truth.items()}
    return {ns: np.array(pose) for ns, pose in seen.items()}
