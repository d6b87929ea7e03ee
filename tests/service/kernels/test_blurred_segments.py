import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.kernels.blurred_segments import NO_SEGMENT, segments_along

LIMITS = np.array([0.06, 1.0])


def found(xy, limits=LIMITS, least_points=20, gap_m=0.2):
    segment = np.full((len(xy), 2), 7, np.int32)
    counts = [
        segments_along(xy, axis, np.full(len(xy), gap_m), limits, least_points, segment) for axis in (0, 1)
    ]
    return segment, counts


def wall(begin, end, count, sigma_m=0.0, seed=1):
    line = np.linspace(begin, end, count)
    return line + sigma_m * np.random.default_rng(seed).standard_normal(line.shape)


def test_walls_along_either_axis_are_found_and_clutter_is_not():  # B20 B22
    south, west = wall((0, 0), (4, 0), 100, 0.01), wall((0, 0.3), (0, 3), 80, 0.01, seed=2)
    clutter = np.random.default_rng(3).uniform((1, 1), (4, 3), (60, 2))
    segment, counts = found(np.vstack([south, west, clutter]))
    assert counts == [1, 1]
    assert (segment[:100, 0] == 0).mean() > 0.98
    assert (segment[100:180, 1] == 0).mean() > 0.98
    assert (segment[180:] == NO_SEGMENT).all()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 400),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.01, 0.1, 5.0]),
    st.integers(1, 30),
    st.floats(0.0, 1.5),
)
def test_any_cloud_ends_with_segments_that_keep_the_rules(count, seed, grain, least_points, length_m):  # B20
    noise = np.random.default_rng(seed)
    xy = noise.normal(0.0, 2.0, (count, 2))
    if grain:
        xy = np.round(xy / grain) * grain  # many equal coordinates
    segment, counts = found(xy, np.array([0.06, length_m]), least_points, gap_m=0.3)
    for axis in (0, 1):
        assert set(segment[:, axis]) <= set(range(-1, counts[axis]))
        for number in range(counts[axis]):
            members = xy[segment[:, axis] == number]
            assert np.ptp(members[:, 1 - axis]) <= 0.06 + 1e-12
            assert np.ptp(members[:, axis]) > length_m
            assert np.diff(np.sort(members[:, axis])).max(initial=0.0) <= 0.3


def test_a_tilted_wall_makes_no_segment_of_the_axes():  # B18
    """10 deg: a band of 6 cm holds 35 cm of it."""
    turn = np.radians(10.0)
    tilted = wall((0, 0), (5, 0), 200) @ np.array(
        [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    )
    segment, counts = found(tilted)
    assert counts == [0, 0]
    assert (segment == NO_SEGMENT).all()


@pytest.mark.parametrize(("least_points", "expected"), [(59, 1), (60, 0)])
def test_a_band_must_hold_more_than_the_least_points(least_points, expected):
    assert found(wall((0, 0), (3, 0), 60), least_points=least_points)[1][0] == expected
