from dataclasses import replace
from itertools import pairwise

import numpy as np

from service.geometry.se2 import SE2
from service.mapper.components import Correction
from service.mapper.corrections import corrected
from service.outputs import NO_REASON, MapperOutput


def output(stamp_ns: int, pose_odom_base: SE2, pose_map_odom: SE2 | None = None) -> MapperOutput:
    at = pose_map_odom or SE2()
    return MapperOutput(stamp_ns, pose_odom_base, at, (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0)


STRAIGHT = [output(k, SE2(0.1 * k, 0.0, 0.0)) for k in range(11)]


def test_without_corrections_poses_are_those_that_were_published():
    moved = output(1, SE2(1.0, 0.0, 0.0), SE2(0.0, 2.0, 0.0))
    assert corrected([moved], []) == [moved.pose_map_base]


def test_the_path_passes_the_corrected_scans_and_is_interpolated_between_them():
    start = Correction(2, SE2(0.2, 0.0, 0.0), SE2(0.2, 0.0, 0.0))
    end = Correction(8, SE2(0.8, 0.0, 0.0), SE2(0.8, 0.6, 0.0))
    poses = corrected(STRAIGHT, [start, end])
    assert (poses[2], poses[8]) == (SE2(0.2, 0.0, 0.0), SE2(0.8, 0.6, 0.0))
    rises = [b.y_m - a.y_m for a, b in pairwise(poses)]
    np.testing.assert_allclose(rises, [0.0] * 2 + [0.1] * 6 + [0.0] * 2, atol=1e-12)


def test_poses_before_a_new_segment_are_not_interpolated_towards_it():
    start = Correction(2, SE2(0.2, 0.0, 0.0), SE2(0.2, 0.0, 0.0))
    carried_to = Correction(85, SE2(0.8, 0.0, 0.0), SE2(0.8, 30.0, 0.0), begins_segment=True)  # in its sweep
    outputs = [replace(of, stamp_ns=10 * of.stamp_ns) for of in STRAIGHT]
    poses = corrected(outputs, [replace(start, stamp_ns=20), carried_to])
    np.testing.assert_allclose([pose.y_m for pose in poses], [0.0] * 8 + [30.0] * 3, atol=1e-12)
    assert corrected(outputs, [carried_to])[0].y_m == 30.0
