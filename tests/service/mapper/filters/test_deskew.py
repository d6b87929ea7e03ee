import math

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.errors import InputError
from service.estimator.motion import Motion
from service.geometry.se2 import SE2
from service.mapper.filters.deskew import BeamsConfig, DeskewByMotion, DeskewByTwist


def scan(
    range_m: list[float], sensor: str = "front", beam_ns: int = 1_000_000, step_rad: float = 0.1
) -> LaserScan:
    ranges = np.array(range_m, np.float32)
    return LaserScan(sensor, 5, 6, beam_ns, 20_000_000, 0.0, step_rad, 0.05, 20.0, ranges, NO_INTENSITY)


def moving(*twist: float) -> Motion:
    return Motion(SE2(), (twist[0], twist[1], twist[2]), np.eye(3))


def test_a_sweep_is_brought_to_its_middle() -> None:
    seen = scan([2.0, 2.0, 2.0], beam_ns=1_000_000)
    deskew = DeskewByMotion(BeamsConfig(), {"front": SE2()})
    at_ns = deskew.moment_of(seen)
    assert at_ns == seen.stamp_ns + 1_000_000
    points = deskew(seen, moving(1.0, 0.0, 0.0), at_ns)
    np.testing.assert_allclose(points.beam_time_s, [-0.001, 0.0, 0.001])
    np.testing.assert_allclose(points.xy_base - points.xy_raw, [[-0.001, 0.0], [0.0, 0.0], [0.001, 0.0]])
    assert DeskewByTwist(BeamsConfig(), {"front": SE2()}).moment_of(seen) == seen.stamp_ns


def test_a_sweep_in_the_other_direction_is_mirrored() -> None:
    deskew = DeskewByTwist(BeamsConfig(), {"front": SE2()})
    points = deskew(scan([2.0, 2.0], step_rad=-0.1), moving(0.0, 0.0, 0.0))
    np.testing.assert_allclose(points.xy_base[1], [2.0 * math.cos(0.1), -2.0 * math.sin(0.1)], atol=1e-9)


def test_a_sensor_without_a_mounting_is_named() -> None:
    with pytest.raises(InputError, match=r"left: .*known: front, rear"):
        DeskewByTwist(BeamsConfig(), {"rear": SE2(), "front": SE2()})(scan([1.0], "left"), moving(0, 0, 0))


def test_returns_from_the_vehicle_itself_are_left_out():
    """An L-shaped outline; the beams look ahead, up to a post on the vehicle and past it."""
    outline = [(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.0, -0.5), (0.0, 0.0), (0.5, 0.0)]
    deskew = DeskewByTwist(BeamsConfig(), {"front": SE2(0.0, 0.0, 0.2)}, outline)
    points = deskew(scan([0.3, 0.8, 0.2], step_rad=math.pi / 4.0), moving(0.0, 0.0, 0.0))
    seen = DeskewByTwist(BeamsConfig(), {"front": SE2(0.0, 0.0, 0.2)})(
        scan([0.3, 0.8, 0.2], step_rad=math.pi / 4.0), moving(0.0, 0.0, 0.0)
    )
    kept = [not _inside(x, y) for x, y in seen.xy_base]
    assert 0 < sum(kept) < 3
    np.testing.assert_array_equal(points.xy_base, seen.xy_base[kept])
    np.testing.assert_array_equal(points.beam, seen.beam[kept])
    np.testing.assert_array_equal(points.beam_time_s, seen.beam_time_s[kept])


def _inside(x_m: float, y_m: float) -> bool:
    """Of that outline, by its two halves."""
    return (-0.5 < x_m < 0.0 and abs(y_m) < 0.5) or (0.0 <= x_m < 0.5 and 0.0 < y_m < 0.5)
