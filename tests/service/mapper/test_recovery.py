"""Every profile of a paper reports when it is lost, and recovers on known ground."""

import math
from dataclasses import replace

import pytest

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2
from service.outputs import MapperOutput
from tests.service.mapper.drives import ROOM, Drive, drive, eased, mapper_of, outputs_of, round_the_room

PROFILES = ("contour_lm", "imle", "owolm_eskf", "submap_graph")
EVERY = 5  # turns of the laser make a scan: 10 Hz
BACK_S = 2.0
NEAR_M, NEAR_RAD = 0.10, 0.03


def is_near(output: MapperOutput, truth: dict[int, SE2]) -> bool:
    away = truth[output.stamp_ns].inverse() @ output.pose_map_base
    return math.hypot(away.x_m, away.y_m) < NEAR_M and abs(away.theta_rad) < NEAR_RAD


def check(outputs: list[MapperOutput], truth: dict[int, SE2], lost_ns: int, known_ns: int) -> None:
    """Lost from one moment on, on known ground again from another."""
    before = [o for o in outputs if o.stamp_ns < lost_ns]
    assert {o.state for o in before} <= {"ok", "degraded"}
    assert all(is_near(o, truth) for o in before)
    lost = [o for o in outputs if o.state == "lost"]
    assert lost
    assert lost[0].stamp_ns == min(o.stamp_ns for o in outputs if o.stamp_ns >= lost_ns)
    assert "returns lie on the map" in lost[0].reason
    assert lost[0].reason.startswith("front: ")
    assert "Drive back to mapped ground" in lost[0].reason
    back = [o for o in outputs if o.stamp_ns >= known_ns + round(BACK_S * 1e9)]
    assert {o.state for o in back} <= {"ok", "degraded"}
    assert all(is_near(o, truth) for o in back)
    assert all(is_near(o, truth) for o in outputs if o.state == "ok")


def carried_off(time_s: float) -> SE2:
    """Stationary for a moment, then a drive that begins three metres from the end of the drive before."""
    return SE2(-1.6, -1.0, 2.2) @ SE2(0.5 * eased(time_s), 0.0, 0.0)


def one_after_the_other(first: Drive, then: Drive) -> tuple[Drive, int]:
    """Two drives as one whose wheels noticed nothing between them; and when the second begins."""
    start_ns = max(frame.stamp_ns for frame in first.frames) + 20_000_000
    later_ns = start_ns - 1_000_000_000
    wheels = [frame for frame in first.frames if isinstance(frame, OdometrySample)][-1]
    end = SE2(wheels.x_m, wheels.y_m, wheels.theta_rad)
    frames = list(first.frames)
    for frame in then.frames:
        moved = replace(frame, stamp_ns=frame.stamp_ns + later_ns, arrived_ns=frame.arrived_ns + later_ns)
        if isinstance(moved, OdometrySample):
            pose = end @ SE2(moved.x_m, moved.y_m, moved.theta_rad)
            moved = replace(moved, x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad)
        frames.append(moved)
    origin = round_the_room(0.0).inverse()
    truth = first.truth | {
        stamp_ns + later_ns: origin @ carried_off((stamp_ns - 1_000_000_000) * 1e-9)
        for stamp_ns in then.truth
    }
    return Drive(frames, truth), start_ns


@pytest.fixture(scope="module")
def carried() -> tuple[Drive, int]:
    first = drive(ROOM, round_the_room, 5.0, every=EVERY)
    return one_after_the_other(first, drive(ROOM, carried_off, 4.0, every=EVERY))


@pytest.mark.parametrize("profile", PROFILES)
def test_a_carried_vehicle_is_relocalised(profile: str, carried: tuple[Drive, int]) -> None:
    what, carried_ns = carried
    check(outputs_of(mapper_of(profile), what.frames), what.truth, carried_ns, carried_ns)
