"""A vehicle that is switched on somewhere in a stored map: is it found, where it is, and how soon?"""

import gc
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.frames import LaserScan
from service.geometry.se2 import SE2
from service.mapper.background import BackEnd, InlineWorker
from service.mapper.maps.occupancy import rendered_of
from service.mapper.methods.corridor.graph.loop_back_end import LoopBackEnd
from service.mapper.profiles import BeginIn, build_mapper, mapping_config
from service.outputs import FREE
from simulators.trajectory import Pause, plan_drive
from simulators.world import World
from simulators.worlds import WORLDS
from tests.accuracy.buildings import FAST_MALL, LMS100_25HZ, MALL_WAY_M, seconds_for
from tests.papers.report import Row, Section
from tests.simulated import FORWARD, LMS100_50HZ, Drive, Laser, Wheels, drive, run

PLACES = 100
CLEARANCE_M = 0.4  # of a place from every wall
STAND_S, MOVE_S = 1.0, 8.0
RIGHT_M, RIGHT_DEG = 0.10, 1.0


@dataclass
class Outcome:
    """A value a place."""

    right: list[bool] = field(default_factory=list)  # at its end
    wrong: list[bool] = field(default_factory=list)  # said to be found, and is not there
    wrong_ok: list[bool] = field(default_factory=list)  # at any moment
    found_s: list[float] = field(default_factory=list)  # from the first scan on; nan: not
    cpu_s: list[float] = field(default_factory=list)  # of the scan that took longest
    off_mm: list[float] = field(default_factory=list)  # where right


def relocalisation(seeds: Sequence[int]) -> Section:
    rows = []
    worlds = {
        "office": (WORLDS["office"](), LMS100_50HZ, None),
        "library": (WORLDS["library"](), LMS100_50HZ, None),
        "floor": (WORLDS["floor"](), LMS100_50HZ, None),
        "mall": (FAST_MALL(), LMS100_25HZ, MALL_WAY_M),
    }
    for name, (world, laser, way_m) in worlds.items():
        seconds = world.drive.duration_s if way_m is None else seconds_for(world, way_m)
        begin, first = stored(world, laser, seconds, seeds[0])
        stand, move = Outcome(), Outcome()
        for number, place in enumerate(places(world, begin, first, seeds[0])):
            here = replace(world, drive=plan_drive(place, [Pause(STAND_S + 1.0)]))
            look(begin, first, drive(here, laser, STAND_S, number, Wheels(), stand_s=0.0), stand)
        for number, at_s in enumerate(np.linspace(0.0, seconds - MOVE_S, PLACES).tolist()):
            look(begin, first, drive(world, laser, MOVE_S, number, Wheels(), stand_s=-at_s), move)
        for how, one in (("standing", stand), ("moving", move)):
            count, alike = len(one.right), sum(one.alike)
            rows += [
                Row(name, f"{how}: right, of {count}", [float(sum(one.right))], "places", digits=0),
                Row(name, f"{how}: lost, likelier elsewhere", [float(alike)], "places", digits=0),
                Row(
                    name,
                    f"{how}: right, of the others",
                    [100.0 * sum(one.right) / max(count - alike, 1)],
                    "%",
                    at_least=98.0,
                    digits=0,
                ),
                Row(name, f"{how}: wrong", [float(sum(one.wrong))], "places", at_most=0.0, digits=0),
                Row(
                    name,
                    f"{how}: `ok` and wrong",
                    [float(sum(one.wrong_ok))],
                    "places",
                    at_most=0.0,
                    digits=0,
                ),
                Row(name, f"{how}: off where right", one.off_mm or [math.nan], "mm", digits=1),
                Row(name, f"{how}: found after", [s for s in one.found_s if s == s] or [math.nan], "s"),
                Row(name, f"{how}: longest search, processor", one.cpu_s, "s", at_most=1.0, by_worst=True),
            ]
    return Section(
        "Switched on in a stored map",
        f"{PLACES} places of the known free ground, at least {CLEARANCE_M} m from walls, at any heading, "
        f"standing for {STAND_S:.0f} s; and {PLACES} moments of the mapped drive, driving on for "
        f"{MOVE_S:.0f} s. Right: within {RIGHT_M} m and {RIGHT_DEG:.0f} deg at the end; wrong: placed, and "
        "farther off at the end. What is neither stays lost. Likelier elsewhere: another place of the map "
        "fits what is seen better than the true one does, of which the map holds too little.",
        rows,
    )


def stored(world: World, laser: Laser, seconds: float, seed: int) -> tuple[BeginIn, SE2]:
    """The map of one drive, as a session begins in it; and its frame in that of the world."""
    made = drive(world, laser, seconds, seed, Wheels())
    mapper = run(mapping_config(), made).mapper
    graph = mapper.finish().update.saved
    assert graph is not None
    return BeginIn(graph, rendered_of(mapper.changed_tiles())), made.world_first


def places(world: World, begin: BeginIn, first: SE2, seed: int) -> list[SE2]:
    """In the frame of the world."""
    shown, random = begin.shown, np.random.default_rng(seed)
    tile, row, column = np.nonzero(shown.evidence < FREE)
    width = shown.evidence.shape[1]
    x_m = 0.05 * (shown.tile_column[tile] * width + column + 0.5)
    y_m = 0.05 * (shown.tile_row[tile] * width + row + 0.5)
    found: list[SE2] = []
    while len(found) < PLACES:
        k = int(random.integers(len(x_m)))
        place = first @ SE2(float(x_m[k]), float(y_m[k]), float(random.uniform(-math.pi, math.pi)))
        if _clearance_m(world, place) >= CLEARANCE_M:
            found.append(place)
    return found


def _clearance_m(world: World, place: SE2) -> float:
    begin, way = world.segments[:, :2], world.segments[:, 2:] - world.segments[:, :2]
    to = np.array([place.x_m, place.y_m]) - begin
    along = np.clip((to * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-12), 0.0, 1.0)
    return float(np.hypot(*(to - along[:, None] * way).T).min())


def look(begin: BeginIn, first: SE2, made: Drive, outcome: Outcome) -> None:
    back_ends: list[LoopBackEnd] = []

    def in_place(back_end: BackEnd) -> InlineWorker:
        assert isinstance(back_end, LoopBackEnd)
        back_ends.append(back_end)
        return InlineWorker(back_end)

    config = mapping_config({"mode": "localization"})
    mapper = build_mapper(config, {"front": FORWARD}, new_worker=in_place, begin_in=begin)
    found_s, longest_s, wrong_ok, is_wrong, off_m, off_deg = math.nan, 0.0, False, False, math.inf, 0.0
    for frame in made.frames:
        began_s = time.thread_time()
        output = mapper.process(frame)
        while mapper.graph.waiting:
            mapper.apply_result()
        if not isinstance(frame, LaserScan) or output is None:
            continue
        longest_s = max(longest_s, time.thread_time() - began_s)
        true = first.inverse() @ made.world_first @ made.truth[output.stamp_ns]
        away = true.inverse() @ output.pose_map_base
        off_m, off_deg = math.hypot(away.x_m, away.y_m), abs(math.degrees(away.theta_rad))
        is_placed = output.state != "lost"
        is_wrong = is_placed and (off_m > RIGHT_M or off_deg > RIGHT_DEG)
        wrong_ok |= is_wrong and output.state == "ok"
        if is_placed and math.isnan(found_s):
            found_s = 1e-9 * (output.stamp_ns - made.frames[0].stamp_ns)
    is_right = is_placed and not is_wrong
    outcome.right.append(is_right)
    outcome.wrong.append(is_wrong)
    outcome.wrong_ok.append(wrong_ok)
    outcome.found_s.append(found_s)
    at = np.array([true.x_m, true.y_m, true.theta_rad])
    outcome.alike.append(not is_placed and back_ends[0].pieces.is_likelier_elsewhere(at))
    outcome.cpu_s.append(longest_s)
    if is_right:
        outcome.off_mm.append(1e3 * off_m)
    mapper.graph.close()
    gc.collect()
