"""Where a path bends: the heading found from scan to scan, against a path whose loops are closed."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2, wrap_angle
from service.offline.replay.replay import ReplayOptions, replay
from service.offline.score.trajectory import Trajectory
from service.recording.mcap_source import open_session

JUMP_DEG = 3.0
Poses = Mapping[int, SE2]  # by stamp in ns


@dataclass(frozen=True)
class Bend:
    """Errors of the heading, in deg, over some scans."""

    steps: int
    sum_deg: float
    rms_deg: float
    jumps: int  # steps of more than JUMP_DEG

    @staticmethod
    def of(errors_deg: npt.NDArray[np.float64]) -> "Bend":
        rms_deg = math.sqrt(float((errors_deg**2).mean())) if len(errors_deg) else 0.0
        jumps = int((np.abs(errors_deg) > JUMP_DEG).sum())
        return Bend(len(errors_deg), float(errors_deg.sum()), rms_deg, jumps)


def bends(path: Poses, reference: Poses, until_s: float) -> tuple[Bend, Bend]:
    """Up to a moment after the first scan of both, and behind it."""
    stamps = sorted(path.keys() & reference.keys())
    errors_deg = np.array(
        [
            math.degrees(wrap_angle(_turn(path, before, at) - _turn(reference, before, at)))
            for before, at in itertools.pairwise(stamps)
        ]
    )
    is_early = np.array([(at - stamps[0]) * 1e-9 < until_s for at in stamps[1:]])
    return Bend.of(errors_deg[is_early]), Bend.of(errors_deg[~is_early])


def path_of(profile: str, recording: Path) -> Poses:
    """As a profile has it in the end."""
    done = replay([recording], ReplayOptions(profile=profile))
    return dict(zip((output.stamp_ns for output in done.outputs), done.poses_map_base, strict=True))


def path_of_wheels(recording: Path, stamps_ns: list[int]) -> Poses:
    frames = open_session([recording]).frames()
    said = {f.stamp_ns: (f.x_m, f.y_m, f.theta_rad) for f in frames if isinstance(f, OdometrySample)}
    path = Trajectory(np.array(list(said)), np.array(list(said.values())))
    return {at: SE2(*pose) for at, pose in zip(stamps_ns, path.at(np.array(stamps_ns)).tolist(), strict=True)}


def _turn(path: Poses, before: int, at: int) -> float:
    return path[at].theta_rad - path[before].theta_rad
