"""MultiEchoLaserScan: which echo of a beam counts."""

import numpy as np
import pytest

from service.conversion import scan_of_echoes
from service.errors import InputError
from tests.service.conversion.messages import STAMP_NS, echoes

BEAMS = [[1.0, 2.0, 3.0], [], [0.01, 5.0], [np.nan, 6.0], [4.0, 30.0], [7.0]]
STRENGTH = [[10.0, 30.0, 20.0], [], [90.0, 1.0], [90.0, 1.0], [5.0, 90.0], [1.0]]


def payload(ranges, intensities, range_max=25.0):
    return echoes(ranges, intensities, (-0.5, 0.5, 0.2, 0.001, 0.1, 0.05, range_max))


@pytest.mark.parametrize(
    ("echo", "intensities", "expected"),
    [
        ("strongest", STRENGTH, [2.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
        ("strongest", [], [1.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
        ("strongest", STRENGTH[:-1], [1.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
        ("first", STRENGTH, [1.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
        ("last", STRENGTH, [3.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
        ("last", [], [3.0, np.nan, 5.0, 6.0, 4.0, 7.0]),
    ],
)
def test_of_the_echoes_within_range_one_counts(echo, intensities, expected):
    scan = scan_of_echoes(payload(BEAMS, intensities), "front", STAMP_NS + 5, echo)
    np.testing.assert_array_equal(scan.range_m, np.array(expected, np.float32))
    assert (scan.sensor, scan.stamp_ns, scan.arrived_ns) == ("front", STAMP_NS, STAMP_NS + 5)
    assert (scan.beam_interval_ns, scan.first_angle_rad) == (1_000_000, -0.5)


def test_of_equally_strong_echoes_the_first_counts_and_without_a_range_max_all_are_left():
    scan = scan_of_echoes(payload([[1.0, 2.0, 3.0]] * 3, [[5.0, 9.0, 9.0]] * 3, 0.0), "front", STAMP_NS)
    assert scan.range_m.tolist() == [2.0] * 3
    assert scan.intensity.tolist() == [9.0] * 3


def test_a_scan_without_beams_is_not_used_and_other_bytes_are_refused():
    assert scan_of_echoes(payload([], []), "front", STAMP_NS) is None
    with pytest.raises(InputError, match="bytes cannot be read as a sensor_msgs/msg/MultiEchoLaserScan"):
        scan_of_echoes(payload(BEAMS, [])[:70], "front", STAMP_NS)
