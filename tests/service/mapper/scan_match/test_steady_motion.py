"""Where a vehicle would be had it gone on as before."""

import pytest

from service.geometry.se2 import SE2
from service.mapper.scan_match.moving_scene import SteadyMotion

MS = 1_000_000
STEP = SE2.exp(0.1, 0.01, 0.05)  # of 100 ms


def driven(*stamps_ms: int) -> SteadyMotion:
    motion = SteadyMotion()
    for stamp_ms in stamps_ms:
        motion.matched(stamp_ms * MS, at(stamp_ms))
    return motion


def at(stamp_ms: float) -> SE2:
    steps = stamp_ms / 100.0
    return SE2(3.0, -2.0, 2.0) @ SE2.exp(0.1 * steps, 0.01 * steps, 0.05 * steps)


def apart(one: SE2, two: SE2) -> tuple[float, float, float]:
    return (one.inverse() @ two).log()


@pytest.mark.parametrize("stamp_ms", [220, 300, 700])
def test_it_goes_on_with_the_twist_between_the_last_two_matches(stamp_ms: int) -> None:
    motion = driven(0, 100, 200)
    motion_pose = motion.pose_at(stamp_ms * MS)
    assert motion_pose is not None
    assert apart(motion_pose, at(stamp_ms)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_two_lasers_one_right_behind_the_other_make_no_step() -> None:
    motion = driven(0, 100)
    motion.matched(103 * MS, at(103) @ SE2(0.01, 0.0, 0.0))  # 1 cm apart within 3 ms is noise, not 3 m/s
    motion_pose = motion.pose_at(200 * MS)
    assert motion_pose is not None
    forward_m, _, _ = apart(motion_pose, at(200))
    assert abs(forward_m) < 0.025
