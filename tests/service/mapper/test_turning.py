"""A vehicle that begins to turn: sweeps that take time must not turn its heading."""

from dataclasses import replace

import numpy as np

from service.mapper.profiles import mapping_config
from simulators.worlds import WORLDS
from tests.simulated import LMS100_50HZ, Wheels, drives, run

FROM_S, SECONDS = 14.0, 10.0  # up to the first corner of the ring, which is turned within 1.4 s


def test_the_heading_does_not_run_ahead_while_a_turn_begins() -> None:
    """Each sweep takes 30 ms, and the rate of turn grows by 4.7 rad/s2."""
    laser = replace(LMS100_50HZ, rate_hz=25.0)
    (made,) = drives(WORLDS["ring"](), laser, SECONDS, [2], Wheels(), stand_s=-FROM_S)
    outputs = run(mapping_config(), made).outputs
    true_rad = np.unwrap([made.truth[output.stamp_ns].theta_rad for output in outputs])
    off_rad = np.unwrap([output.pose_odom_base.theta_rad for output in outputs]) - true_rad
    begins = int(np.flatnonzero(np.abs(np.diff(true_rad)) > 1e-3)[0])
    ahead_rad = np.sign(true_rad[-1]) * (off_rad - off_rad[begins - 10 : begins].mean())
    # 1.0 mrad with a steady twist and the pose of the first beam
    assert abs(ahead_rad[begins : begins + 10].mean()) < 5e-4
