"""Key frames and fixes of a drive outdoors, as the mapper makes them, without scans: what a graph gets."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from drivers.frames import GnssFix
from service.geometry.geo_reference import LocalFrame
from service.geometry.poses import compose
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.fix_track import FixTrack
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.keyframe_list import KeyFrame, LoopsConfig
from service.offline.score.score import align
from tests.gnss_receiver import GnssModel, Receiver
from tests.service.mapper.graph.key_frames import key_frame

STEP_M = 0.3
SPEED_MPS = 1.5
ANTENNA = (-0.4, 0.1)
ORIGIN = LocalFrame(60.161, 24.546, 51.7)
YAW_RAD = 0.7  # of the first key frame against east
NO_SEARCH = LoopsConfig(search_every_m=1e9)
BATCH = 20


@dataclass(frozen=True)
class Outing:
    """truth: of the key frames, seen from the first."""

    frames: list[KeyFrame]
    truth: list[SE2]
    fixes: list[GnssFix]


def rectangle(
    path_length_m: float, length_m: float = 600.0, width_m: float = 400.0, radius_m: float = 20.0
) -> SE2:
    """Round a rectangle of 2 km with round corners, from the middle of its lower side."""
    half_m, side_m, arc_m = length_m / 2 - radius_m, width_m - 2 * radius_m, 0.5 * math.pi * radius_m
    pose, left_m = SE2(), path_length_m
    for leg_m in (half_m, side_m, 2 * half_m, side_m):
        if left_m <= leg_m:
            break
        pose, left_m = pose @ SE2(leg_m, 0.0, 0.0), left_m - leg_m
        if left_m <= arc_m:
            return pose @ SE2.exp(left_m, 0.0, left_m / radius_m)
        pose, left_m = pose @ SE2.exp(arc_m, 0.0, 0.5 * math.pi), left_m - arc_m
    return pose @ SE2(left_m, 0.0, 0.0)


def outing(
    path_length_m: float = 2000.0,
    seed: int = 0,
    model: GnssModel | None = None,
    turn_walk_rad: float = 0.0006,
    speed_mps: float = SPEED_MPS,
    route: Callable[[float], SE2] = rectangle,
) -> Outing:
    """A drive whose odometry errs by 2 mm and turn_walk_rad a step of 0.3 m."""
    noise = np.random.default_rng(seed)
    receiver = Receiver(model or GnssModel(), seed, ORIGIN)
    start = SE2(0.0, 0.0, YAW_RAD)
    covariance = np.diag([2e-3**2, 2e-3**2, turn_walk_rad**2])
    frames, truth, accepted = [], [], SE2()
    step_ns = round(STEP_M / speed_mps * 1e9)
    for k in range(int(path_length_m / STEP_M) + 1):
        pose = route(k * STEP_M)
        if k:
            step = truth[-1].inverse() @ pose
            off = noise.standard_normal(3) * (2e-3, 2e-3, turn_walk_rad)
            accepted = accepted @ SE2(step.x_m + off[0], step.y_m + off[1], step.theta_rad + off[2])
        truth.append(pose)
        frames.append(key_frame(k * step_ns, accepted, covariance=covariance))
    fixes = []
    for stamp_ns in range(0, frames[-1].stamp_ns, receiver.period_ns):
        antenna = start @ route(stamp_ns * 1e-9 * speed_mps) @ SE2(*ANTENNA)
        fixes.append(receiver.fix("imu", stamp_ns, (antenna.x_m, antenna.y_m)))
    return Outing(frames, truth, fixes)


def batches(drive: Outing) -> Iterable[Batch]:
    """As LoopClosing makes them of one scan a key frame."""
    track, fixes = FixTrack(), list(reversed(drive.fixes))
    for first in range(0, len(drive.frames), BATCH):
        frames = drive.frames[first : first + BATCH]
        for k, frame in enumerate(frames, start=first):
            while fixes and fixes[-1].arrived_ns <= frame.stamp_ns:
                track.add_fix(fixes.pop(), ANTENNA)
            track.add_scan(frame.stamp_ns, frame.pose_odom_base, k)
        yield Batch(frames, fixes=track.take())


def fed(drive: Outing) -> tuple[LoopBackEnd, list[Result]]:
    """And finished: the last result is that of the last batch."""
    back_end = LoopBackEnd(NO_SEARCH, None)
    results = [back_end.work(batch) for batch in batches(drive)]
    return back_end, [*results, back_end.work(Batch([], is_last=True))]


def with_fixes(drive: Outing, change: Callable[[GnssFix], GnssFix]) -> Outing:
    return replace(drive, fixes=[change(fix) for fix in drive.fixes])


def errors_m(result: Result, drive: Outing) -> np.ndarray:
    """(N,) m from each key frame's geo-referenced position to its true one."""
    assert result.geo is not None
    start = SE2(0.0, 0.0, YAW_RAD)
    off = []
    for true, correction in zip(drive.truth, result.all, strict=True):
        there = start @ true
        pose = correction.pose_map_base
        found = result.geo.to_geodetic(pose.x_m, pose.y_m)
        east_m, north_m, _ = ORIGIN.to_enu(*found, ORIGIN.height_m)
        off.append(math.hypot(east_m - there.x_m, north_m - there.y_m))
    return np.array(off)


def ate_m(result: Result, drive: Outing) -> float:
    """RMS after the best rigid motion: the map's shape alone."""

    found = np.array(
        [(c.pose_map_base.x_m, c.pose_map_base.y_m, c.pose_map_base.theta_rad) for c in result.all]
    )
    truth = np.array([(t.x_m, t.y_m, t.theta_rad) for t in drive.truth])
    off = compose(align(found, truth), found) - truth
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
