"""Clouds as planar and 3-D lasers send them, and the scans that become of them."""

import math

import numpy as np
import pytest

from service import encoding
from service.conversion import CloudConverter, ConversionConfig
from service.errors import InputError
from tests.service.conversion.messages import STAMP_NS, STORE, cloud

LOG_NS = STAMP_NS + 120_000_000
LEVEL = np.eye(4)
ANY = ConversionConfig()


def ranges(angle_rad):
    """Of a room that is no circle."""
    return 3.0 + np.sin(2.0 * angle_rad) + 0.3 * np.cos(5.0 * angle_rad)


def planar(count=541, fov_deg=270.0):
    """Columns of the points of a planar laser, and their angles and ranges."""
    angle = np.radians(np.linspace(-fov_deg / 2, fov_deg / 2, count))
    r = ranges(angle)
    return {"x": r * np.cos(angle), "y": r * np.sin(angle), "z": np.zeros(count)}, angle, r


LAYOUTS = {
    "as they come": {},
    "float64": {"formats": dict.fromkeys("xyz", "f8")},
    "big-endian": {"big_endian": True},
    "padded": {"padding": 3},
    "organised, with rows padded": {"height": 7, "row_padding": 5},
    "big-endian, padded, organised": {"big_endian": True, "padding": 1, "height": 7, "row_padding": 9},
}


@pytest.mark.parametrize("shuffled", [False, True], ids=["in order", "unordered"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_planar_lasers_cloud_gives_its_beams_back(layout, shuffled):
    columns, angle, r = planar(539)
    order = np.random.default_rng(1).permutation(539) if shuffled else np.arange(539)
    payload = cloud({name: values[order] for name, values in columns.items()}, **LAYOUTS[layout])
    scan = CloudConverter(ANY, LEVEL).scan(payload, "front", LOG_NS)
    assert (scan.sensor, scan.stamp_ns, scan.arrived_ns) == ("front", STAMP_NS, LOG_NS)
    assert scan.range_m.dtype == np.float32
    assert scan.range_m.size == 539
    assert scan.first_angle_rad == pytest.approx(angle[0], abs=1e-5)
    assert scan.angle_step_rad == pytest.approx(angle[1] - angle[0], abs=1e-7)
    np.testing.assert_allclose(scan.range_m, r, atol=1e-5)


def test_points_that_came_back_from_nowhere_are_beams_without_return():
    columns, _, r = planar(181, 180.0)
    for k, nowhere in ((3, math.nan), (4, math.inf), (5, 0.0)):
        columns["x"][k] = columns["y"][k] = nowhere
    scan = CloudConverter(ANY, LEVEL).scan(cloud(columns), "front", LOG_NS)
    assert np.flatnonzero(np.isnan(scan.range_m)).tolist() == [3, 4, 5]
    came = np.isfinite(scan.range_m)
    np.testing.assert_allclose(scan.range_m[came], r[came], atol=1e-5)


def test_a_planar_laser_upside_down_is_turned_back():
    columns, angle, r = planar(181, 180.0)
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    scan = CloudConverter(ANY, over).scan(cloud(columns), "front", LOG_NS)
    assert scan.first_angle_rad == pytest.approx(-angle[-1], abs=1e-5)
    np.testing.assert_allclose(scan.range_m, r[::-1], atol=1e-5)


def spinning(direction, rings_deg=(-2.0, 0.0, 2.0), columns=720, period_s=0.1, start_rad=1.0):
    """Points of a 3-D laser that turns once, in the order of time: columns, and time of each, s."""
    at = np.repeat(np.arange(columns) / columns, len(rings_deg))
    azimuth = start_rad + direction * 2.0 * math.pi * at
    elevation = np.tile(np.radians(rings_deg), columns)
    r = ranges(azimuth)
    points = {"x": r * np.cos(azimuth), "y": r * np.sin(azimuth), "z": r * np.tan(elevation)}
    return points, period_s * at


TIMES = {  # field, its type, and what stands in it
    "ns since the stamp": ("t", "u4", lambda s: s * 1e9),
    "us since the stamp": ("offset_time", "u4", lambda s: s * 1e6),
    "s since the stamp": ("time", "f4", lambda s: s),
    "s before the stamp": ("time", "f4", lambda s: s - 0.1),
    "us as float": ("time", "f4", lambda s: s * 1e6),
    "s since 1970": ("timestamp", "f8", lambda s: STAMP_NS / 1e9 + s),
    "ns since 1970": ("timestamp", "f8", lambda s: STAMP_NS + s * 1e9),
    "s since power-on": ("timestamp", "f8", lambda s: 5000.0 + s),
}


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["counter-clockwise", "clockwise"])
@pytest.mark.parametrize("times", TIMES)
def test_times_of_points_give_first_ray_direction_and_beam_interval(times, direction):
    points, seconds = spinning(direction)
    name, kind, made = TIMES[times]
    order = np.random.default_rng(2).permutation(len(seconds))  # organised by rings, say
    columns = {axis: values[order] for axis, values in points.items()} | {name: made(seconds)[order]}
    scan = CloudConverter(ANY, LEVEL @ shifted(0.5)).scan(cloud(columns, {name: kind}), "lidar", LOG_NS)
    before_s = 0.1 if times == "s before the stamp" else 0.0
    assert scan.stamp_ns == pytest.approx(STAMP_NS - before_s * 1e9, abs=2e5)
    assert scan.first_angle_rad == pytest.approx(1.0, abs=math.radians(0.3))
    assert scan.angle_step_rad == pytest.approx(direction * math.radians(0.25))
    assert scan.beam_interval_ns == pytest.approx(0.1e9 / 1440, rel=1e-3)
    assert scan.scan_period_ns == pytest.approx(0.1e9, rel=0.01)
    angle = scan.first_angle_rad + scan.angle_step_rad * np.arange(scan.range_m.size)
    came = np.isfinite(scan.range_m)
    assert came.mean() > 0.4  # two bins of a quarter degree for each column
    np.testing.assert_allclose(scan.range_m[came], ranges(angle[came]), atol=0.02)


def test_times_of_a_laser_that_does_not_rotate_give_the_stamp_of_their_median():
    points, seconds = spinning(1.0)
    seconds = np.random.default_rng(3).permutation(seconds)
    payload = cloud(points | {"time": seconds})
    scan = CloudConverter(ANY, shifted(0.5)).scan(payload, "lidar", LOG_NS)
    assert scan.stamp_ns == pytest.approx(STAMP_NS + 0.05e9, abs=1e6)
    assert scan.beam_interval_ns == 0


@pytest.mark.parametrize("span", [0.0, 1e-5, 1e12, math.nan], ids=str)
def test_times_that_make_no_sweep_are_not_used(span):
    points, seconds = spinning(1.0)
    seconds = 10.0 * seconds * span
    scan = CloudConverter(ANY, shifted(0.5)).scan(cloud(points | {"time": seconds}), "lidar", LOG_NS)
    assert (scan.stamp_ns, scan.beam_interval_ns) == (STAMP_NS, 0)
    assert np.isfinite(scan.range_m).sum() > 500


def shifted(z_m, pitch_rad=0.0, yaw_rad=0.0):
    """matrix_base_sensor of a device at that height, looking down by pitch."""
    c, s = math.cos(pitch_rad), math.sin(pitch_rad)
    pitch = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    matrix = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ pitch
    matrix[2, 3] = z_m
    return matrix


def test_the_nearest_point_of_the_height_band_in_the_base_frame_is_the_beam():
    """Ahead: the ground at 1 m, a wall at 4 m from the ground up, a lamp at 2 m above; a bumper at 0.1 m."""
    base = np.array(
        [[1.0, 0.0, 0.0], [4.0, 0.0, 0.5], [4.1, 0.0, 1.0], [2.0, 0.0, 1.9], [0.1, 0.0, 0.5], [0.0, 3.0, 0.8]]
    )
    matrix = shifted(0.6, math.radians(25.0), math.radians(40.0))
    xyz = (base - matrix[:3, 3]) @ matrix[:3, :3]
    payload = cloud(dict(zip("xyz", xyz.T, strict=True)), dict.fromkeys("xyz", "f8"))

    def seen(**settings):
        scan = CloudConverter(ConversionConfig(**settings), matrix).scan(payload, "lidar", LOG_NS)
        angle = scan.first_angle_rad + scan.angle_step_rad * np.arange(scan.range_m.size)
        came = np.isfinite(scan.range_m)
        heading_deg = np.degrees(angle[came]) + 40.0
        return dict(zip(heading_deg.round().tolist(), scan.range_m[came].round(3).tolist(), strict=True))

    assert seen() == {0.0: 4.0, 90.0: 3.0}
    assert seen(z_max_m=3.0) == {0.0: 2.0, 90.0: 3.0}
    assert seen(z_min_m=0.9) == {0.0: pytest.approx(4.1)}
    assert seen(z_min_m=-0.1) == {0.0: 1.0, 90.0: 3.0}
    assert seen(min_range_m=0.0) == {0.0: pytest.approx(0.1), 90.0: 3.0}


def test_a_cloud_needs_x_and_y_and_is_planar_without_z():
    columns, _, r = planar()
    for axis in "xy":
        rest = {name: values for name, values in columns.items() if name != axis}
        assert CloudConverter(ANY, LEVEL).scan(cloud(rest), "front", LOG_NS) is None
    flat = cloud({name: columns[name] for name in "xy"})
    scan = CloudConverter(ANY, LEVEL).scan(flat, "front", LOG_NS)
    np.testing.assert_allclose(scan.range_m, r, atol=1e-5)


def test_an_empty_cloud_is_a_scan_without_return():
    for nothing in ({"x": [], "y": [], "z": []}, dict.fromkeys("xyz", [math.nan] * 4)):
        scan = CloudConverter(ANY, LEVEL).scan(cloud(nothing), "front", LOG_NS)
        assert np.isnan(scan.range_m).all()


def test_a_cloud_with_less_data_than_it_claims_is_not_used_and_bytes_are_refused_in_words():
    payload = cloud(planar()[0])
    content = STORE.deserialize_cdr(payload, encoding.POINT_CLOUD)
    whole = {"width": 541, "height": 1, "point_step": 12, "row_step": 541 * 12}
    for change in (
        *(
            {name: value}
            for name, value in (("width", 600), ("height", 2), ("point_step", 4), ("point_step", 0))
        ),
        {"row_step": 7, "height": 3},
    ):
        for name, value in (whole | change).items():
            setattr(content, name, value)
        damaged = bytes(STORE.serialize_cdr(content, encoding.POINT_CLOUD))
        assert CloudConverter(ANY, LEVEL).scan(damaged, "front", LOG_NS) is None, change
    with pytest.raises(InputError, match="bytes cannot be read as a sensor_msgs/msg/PointCloud2"):
        CloudConverter(ANY, LEVEL).scan(payload[:100], "front", LOG_NS)
