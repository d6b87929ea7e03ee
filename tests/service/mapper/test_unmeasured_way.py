"""All devices are silent for 5 s while the vehicle is driven on, or lifted and carried."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import Frame, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.profiles import build_mapper, mapping_config
from tests.service.mapper.offices import through
from tests.simulated import FORWARD, Drive

PAUSE_NS = 5_000_000_000
S = 1_000_000_000


def paused(made: Drive, at_ns: int, is_carried: bool) -> Drive:
    """Odometry counts the way, or nothing of it where the vehicle is carried."""
    left = [frame for frame in made.frames if not at_ns <= frame.arrived_ns < at_ns + PAUSE_NS]
    if is_carried:
        odometry = [frame for frame in left if isinstance(frame, OdometrySample)]
        before = next(f for f in reversed(odometry) if f.arrived_ns < at_ns)
        after = next(f for f in odometry if f.arrived_ns >= at_ns)
        left = [moved(frame, pose_of(before) @ pose_of(after).inverse(), at_ns) for frame in left]
    return replace(made, frames=left)


def moved(frame: Frame, by: SE2, from_ns: int) -> Frame:
    if not isinstance(frame, OdometrySample) or frame.arrived_ns < from_ns:
        return frame
    pose = by @ pose_of(frame)
    return replace(frame, x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad)


def pose_of(sample: OdometrySample) -> SE2:
    return SE2(sample.x_m, sample.y_m, sample.theta_rad)


def states_after(made: Drive, at_ns: int) -> tuple[list[str], np.ndarray, np.ndarray, list[str]]:
    """State, m off, s since the pause and reason of each pose after it; results come at once."""
    mapper = build_mapper(mapping_config(), {"front": FORWARD})
    outputs = []
    for frame in made.frames:
        output = mapper.process(frame)
        while mapper.graph.waiting:
            mapper.apply_result()
        if output is not None and output.stamp_ns > at_ns:
            outputs.append(output)
    away = [made.truth[output.stamp_ns].inverse() @ output.pose_map_base for output in outputs]
    return (
        [output.state for output in outputs],
        np.array([np.hypot(pose.x_m, pose.y_m) for pose in away]),
        np.array([(output.stamp_ns - at_ns - PAUSE_NS) / S for output in outputs]),
        [output.reason for output in outputs],
    )


@pytest.mark.parametrize(("world", "at_s"), [("office", 10), ("library", 22)])
def test_who_drove_on_is_found_where_odometry_leads_on_ground_that_is_known_in_part(world, at_s):
    made = paused(through(world, at_s + 6.5, 2), at_s * S, is_carried=False)
    states, off_m, since_s, reasons = states_after(made, at_s * S)
    assert states[0] == "lost"
    assert reasons[0].startswith("neither laser nor odometry measured the motion for 5.0 s")
    found = states.index("ok")
    assert since_s[found] < 0.5
    assert off_m[found:].max() < 0.05


@pytest.mark.parametrize(("world", "at_s"), [("office", 10), ("library", 22)])
def test_who_was_carried_to_walls_that_look_alike_is_never_ok_in_a_wrong_place(world, at_s):
    made = paused(through(world, at_s + 5.8, 2), at_s * S, is_carried=True)
    states, off_m, _, reasons = states_after(made, at_s * S)
    assert off_m[0] > 3.0
    assert "the vehicle may have been carried" in reasons[0]
    assert not any(state != "lost" and off > 0.3 for state, off in zip(states, off_m, strict=True))
