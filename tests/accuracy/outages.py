"""What fails on a vehicle at night: silent sensors, a hung laser, a lift and carry, stamps that cannot be."""

import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.frames import Frame, LaserScan
from service.mapper.profiles import mapping_config
from simulators.world import World
from simulators.worlds import WORLDS
from tests.accuracy.scene_judge import NORMED, SIGMAS, WRONG_M, normed
from tests.accuracy.trials import ghost_cells
from tests.carried import carried_back, carried_on, laser_silent, silent
from tests.papers.pictures import end_points
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, Drive, Run, Wheels, begun_at, drives, heading_rad, run_session

MOMENTS = 12  # a world, spread over the lap
OUTAGE_NS = 5_000_000_000
ALONE_NS = (1_000_000_000, 2_000_000_000, OUTAGE_NS)  # for which a laser that is alone is silent
AFTER_NS = 6_000_000_000  # that a run goes on after the fault
FOUND_M = 0.05
# Known ground: so much of what is seen after a fault is so near to what was seen before it.
KNOWN_SHARE, KNOWN_M = 0.5, 0.1
EACH = 10  # scan of those before
OTHER_NOISE = 100  # added to a seed: the same drive once more
ONTO_NEW = "lifted, carried on for 5 s with everything off"
# what is done to a drive at a time, ns, and how long it lasts, ns
Faults = Mapping[str, tuple[Callable[[Drive, int], Drive], int]]


@dataclass
class Outcome:
    """Of the runs of one fault in one world, a value a moment."""

    wrong_ok: list[float] = field(default_factory=list)  # scans `ok` and farther off than WRONG_M or SIGMAS
    wrong_degraded: list[float] = field(default_factory=list)  # scans `degraded` and farther off than WRONG_M
    found_s: list[float] = field(default_factory=list)  # from the end of the outage to the right place
    ok_s: list[float] = field(default_factory=list)  # the same, confirmed
    end_mm: list[float] = field(default_factory=list)
    on_known_ground: list[bool] = field(default_factory=list)
    ghosts: list[float] = field(default_factory=list)  # more than in the drive without the fault

    def add(self, done: Run, after_ns: int, ghosts: int, on_known_ground: bool) -> None:
        off_m = np.hypot(*done.errors[:, :2].T)
        ok = np.array([output.state == "ok" for output in done.outputs])
        stamp_ns = np.array([output.stamp_ns for output in done.outputs])
        is_beyond = (normed(done.errors, done.outputs) > NORMED) & (off_m > FOUND_M)
        self.wrong_ok.append(float(np.sum(ok & ((off_m > WRONG_M) | is_beyond))))
        degraded = np.array([output.state == "degraded" for output in done.outputs])
        self.wrong_degraded.append(float(np.sum(degraded & (off_m > WRONG_M))))
        right = (off_m < FOUND_M) & (stamp_ns >= after_ns)
        self.found_s.append(_first_s(stamp_ns[right & (ok | degraded)], after_ns))
        self.ok_s.append(_first_s(stamp_ns[right & ok], after_ns))
        self.end_mm.append(1e3 * float(off_m[-1]))
        self.on_known_ground.append(on_known_ground)
        self.ghosts.append(float(ghosts))

    def rows(self, where: str, has_to_be_found: bool) -> list[Row]:
        """has_to_be_found: on known ground, that is. Without odometry, similar places count as known
        and need not be distinguished.
        """
        rows = [
            Row("`ok` and wrong", self.wrong_ok, "scans", where, at_most=0.0, by_worst=True),
            Row(f"`degraded` and {WRONG_M} m off", self.wrong_degraded, "scans", where),
        ]
        for is_known, ground in ((True, "known ground"), (False, "new ground")):
            moments = [k for k, on_known in enumerate(self.on_known_ground) if on_known == is_known]
            bounds = (2.0, 50.0) if is_known and has_to_be_found else (None, None)
            if moments:
                rows += self._found_rows(where, f"{ground} ({len(moments)} moments)", moments, *bounds)
        rows.append(Row("ghost cells added", self.ghosts, "cells", where, at_most=20.0, by_worst=True))
        return rows

    def _found_rows(
        self, where: str, on: str, moments: list[int], found_s: float | None, end_mm: float | None
    ) -> list[Row]:
        """Of these moments; the latter two are bounds."""
        found, ok, end = ([of[k] for k in moments] for of in (self.found_s, self.ok_s, self.end_mm))
        return [
            Row(f"{on}: found again after", found, "s", where, at_most=found_s, by_worst=True),
            Row(f"{on}: `ok` again after", ok, "s", where),
            Row(f"{on}: off at the end", end, "mm", where, at_most=end_mm, by_worst=True),
        ]


def is_on_known_ground(made: Drive, at_ns: int, after_ns: int) -> bool:
    """Whether the walls of the first scan after a fault were mapped before it, by the true poses."""
    all_scans = [f for f in made.frames if isinstance(f, LaserScan) and f.stamp_ns in made.truth]
    scans = [scan for scan in all_scans if scan.stamp_ns <= scan.arrived_ns]  # not the one with a wrong stamp
    before = [scan for scan in scans if scan.arrived_ns < at_ns][::EACH]
    after = next(scan for scan in scans if scan.stamp_ns >= after_ns)
    seen, now = (
        np.vstack([end_points(scan, made.truth[scan.stamp_ns] @ LMS100_50HZ.mounting) for scan in of])
        for of in (before, [after])
    )
    return bool(np.mean(cKDTree(seen).query(now)[0] < KNOWN_M) >= KNOWN_SHARE)


def _first_s(stamp_ns: npt.NDArray[np.int64], after_ns: int) -> float:
    return 1e-9 * float(stamp_ns[0] - after_ns) if len(stamp_ns) else np.inf


def outages(seeds: Sequence[int]) -> Section:
    rows = []
    for name in ("office", "library"):
        world = begun_at(WORLDS[name](), heading_rad(seeds[0]))
        both = [seeds[0], seeds[0] + OTHER_NOISE]
        made, again = drives(world, LMS100_50HZ, world.drive.duration_s, both, Wheels())
        for what, outcome in _outcomes(world, made, _faults(again, seeds[0])).items():
            rows += outcome.rows(f"{name}, {what}", has_to_be_found=what != ONTO_NEW)
    return Section(
        "Outages",
        f"Each fault at {MOMENTS} moments of a lap; median and worst are over the moments. Each run ends "
        f"{AFTER_NS * 1e-9:.0f} s after the fault. LMS-100 at 50 Hz, odometry; what the graph finds comes "
        f"back half a second later. Carried on: most of what lies ahead is not mapped yet, so that nothing "
        "can be found there, and in places it looks like what is mapped. Known ground: "
        f"{100 * KNOWN_SHARE:.0f} % or more of what the first scan after the fault sees is within "
        f"{KNOWN_M} m of what was seen before it, by the true poses. `ok` and wrong: farther off than "
        f"{WRONG_M} m, or than {SIGMAS:.0f} sigma and {FOUND_M} m. Found again: `ok` or `degraded` within "
        f"{FOUND_M} m of the truth. Ghost cells: more than without the fault.",
        rows,
    )


def outages_alone(seeds: Sequence[int]) -> Section:
    rows = []
    for name in ("office", "library"):
        world = begun_at(WORLDS[name](), heading_rad(seeds[0]))
        (made,) = drives(world, LMS100_50HZ, world.drive.duration_s, [seeds[0]], None)
        faults: Faults = {
            f"silent for {ns * 1e-9:.0f} s": (partial(laser_silent, for_ns=ns), ns) for ns in ALONE_NS
        }
        for what, outcome in _outcomes(world, made, faults).items():
            rows += outcome.rows(f"{name}, {what}", has_to_be_found=False)
    return Section(
        "Outages of a laser alone",
        f"As above, without odometry and IMU: the distance driven is not measured in the outage. {MOMENTS} "
        "moments of a lap; in most of them what lies ahead is not mapped yet. The bookcases of the "
        "library stand 4 m apart and look the same: after 2 s more lies on the map one aisle back than "
        "on the next one, which is not mapped yet.",
        rows,
    )


def _outcomes(world: World, made: Drive, faults: Faults) -> dict[str, Outcome]:
    """Of each fault at each moment of a drive."""
    outcomes = {what: Outcome() for what in faults}
    for share in (np.arange(MOMENTS) + 0.5) / MOMENTS:
        at_ns = round((0.1 + 0.7 * share) * world.drive.duration_s * 1e9)
        until = _until(made, at_ns + OUTAGE_NS + AFTER_NS)
        clean = ghost_cells(world, until, run_session(mapping_config(), until))
        for what, (fault, lasts_ns) in faults.items():
            faulty, after_ns = fault(until, at_ns), at_ns + lasts_ns
            done = run_session(mapping_config(), faulty)
            ghosts = ghost_cells(world, faulty, done) - clean
            outcomes[what].add(done, after_ns, ghosts, is_on_known_ground(faulty, at_ns, after_ns))
            gc.collect()
    return outcomes


def _faults(again: Drive, seed: int) -> Faults:
    """again: the same drive with other noise."""
    places = np.random.default_rng(seed)

    def back(made: Drive, at_ns: int) -> Drive:
        to_ns = round(places.uniform(0.1, 0.7) * at_ns)
        return carried_back(made, again, at_ns, OUTAGE_NS, to_ns, AFTER_NS)

    last = {
        "laser and odometry silent for 5 s, driven on": lambda made, at_ns: silent(made, at_ns, OUTAGE_NS),
        "laser silent for 5 s": lambda made, at_ns: laser_silent(made, at_ns, OUTAGE_NS),
        "one scan repeated for 5 s": _hung,
        "lifted, carried back within 5 s with everything off": back,
        ONTO_NEW: lambda made, at_ns: carried_on(made, at_ns, OUTAGE_NS),
    }
    return {what: (fault, OUTAGE_NS) for what, fault in last.items()} | {
        f"one stamp {by_s} s ahead": (partial(_ahead, by_ns=by_s * 10**9), 0) for by_s in (5, 1000)
    }


def _until(made: Drive, end_ns: int) -> Drive:
    return replace(
        made,
        frames=[frame for frame in made.frames if frame.arrived_ns <= end_ns],
        truth={stamp_ns: pose for stamp_ns, pose in made.truth.items() if stamp_ns <= end_ns},
    )


def _within(frame: Frame, at_ns: int) -> bool:
    return at_ns <= frame.arrived_ns < at_ns + OUTAGE_NS


def _hung(made: Drive, at_ns: int) -> Drive:
    """The laser goes on sending the ranges of one scan under new stamps."""
    repeated = next(f for f in made.frames if isinstance(f, LaserScan) and f.arrived_ns >= at_ns)
    return replace(
        made,
        frames=[
            replace(f, range_m=repeated.range_m) if isinstance(f, LaserScan) and _within(f, at_ns) else f
            for f in made.frames
        ],
    )


def _ahead(made: Drive, at_ns: int, by_ns: int) -> Drive:
    frames = list(made.frames)
    k = next(k for k, f in enumerate(frames) if isinstance(f, LaserScan) and f.arrived_ns >= at_ns)
    stamp_ns = frames[k].stamp_ns + by_ns
    frames[k] = replace(frames[k], stamp_ns=stamp_ns)
    return replace(made, frames=frames)
