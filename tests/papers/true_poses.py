"""Scans at their true poses: errors of a map of them are not those of a matcher."""

import itertools
from collections.abc import Iterator

import numpy as np

from drivers.frames import LaserScan
from service.estimator.motion import Motion
from service.mapper.components import Match, Points
from service.mapper.filters.deskew import BeamsConfig, DeskewByTwist
from tests.simulated import FORWARD, Drive


def true_scans(what: Drive, beams: BeamsConfig, every: int = 1) -> Iterator[tuple[Points, Match]]:
    """Every so many scans of a drive, deskewed with the true speed; the last one is left out."""
    deskew = DeskewByTwist(beams, {"front": FORWARD})
    scans = [frame for frame in what.frames if isinstance(frame, LaserScan)]
    pairs = list(itertools.pairwise(scans))
    for scan, after in pairs[::every]:
        pose = what.truth[scan.stamp_ns]
        step = (pose.inverse() @ what.truth[after.stamp_ns]).log()
        forward, left, turn = (rate / ((after.stamp_ns - scan.stamp_ns) * 1e-9) for rate in step)
        motion = Motion(pose, (forward, left, turn), np.eye(3))
        points = deskew(scan, motion)
        yield points, Match(motion, points, 1.0)
