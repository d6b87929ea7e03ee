"""A drive during which devices are silent for a time, and the vehicle's motion meanwhile."""

from dataclasses import replace

from drivers.frames import Frame, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from tests.simulated import Drive


def silent(made: Drive, at_ns: int, for_ns: int) -> Drive:
    """Driven on. Odometry counts on: its next pose includes the distance driven meanwhile."""
    return replace(made, frames=[f for f in made.frames if not at_ns <= f.arrived_ns < at_ns + for_ns])


def laser_silent(made: Drive, at_ns: int, for_ns: int) -> Drive:
    """Driven on; the other sensors go on."""
    left = [
        f for f in made.frames if not (isinstance(f, LaserScan) and at_ns <= f.arrived_ns < at_ns + for_ns)
    ]
    return replace(made, frames=left)


def carried_on(made: Drive, at_ns: int, for_ns: int) -> Drive:
    """Lifted and carried along the path of the drive, without counts of odometry."""
    left = silent(made, at_ns, for_ns)
    before = [f for f in left.frames if f.arrived_ns < at_ns]
    after = [f for f in left.frames if f.arrived_ns >= at_ns]
    return replace(left, frames=before + _counted_on(before, after))


def carried_back(made: Drive, again: Drive, at_ns: int, for_ns: int, to_ns: int, then_ns: int) -> Drive:
    """Lifted and carried to where the drive came by before, and driven on from there.

    again     the same drive with other noise: its frames from to_ns on, for then_ns, follow
    """
    by_ns = at_ns + for_ns - to_ns
    before = [f for f in made.frames if f.arrived_ns < at_ns]
    after: list[Frame] = [
        replace(f, stamp_ns=f.stamp_ns + by_ns, arrived_ns=f.arrived_ns + by_ns)
        for f in again.frames
        if f.stamp_ns >= to_ns and f.arrived_ns <= to_ns + then_ns
    ]
    truth = {stamp_ns: pose for stamp_ns, pose in made.truth.items() if stamp_ns < at_ns}
    truth |= {stamp_ns + by_ns: pose for stamp_ns, pose in again.truth.items() if stamp_ns >= to_ns}
    return replace(made, frames=before + _counted_on(before, after), truth=truth)


def _counted_on(before: list[Frame], after: list[Frame]) -> list[Frame]:
    """The frames after, with odometry that goes on from its last pose before."""
    last = next(f for f in reversed(before) if isinstance(f, OdometrySample))
    first = next(f for f in after if isinstance(f, OdometrySample))
    by = _pose(last) @ _pose(first).inverse()
    return [_moved(f, by) if isinstance(f, OdometrySample) else f for f in after]


def _moved(sample: OdometrySample, by: SE2) -> OdometrySample:
    pose = by @ _pose(sample)
    return replace(sample, x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad)


def _pose(sample: OdometrySample) -> SE2:
    return SE2(sample.x_m, sample.y_m, sample.theta_rad)
